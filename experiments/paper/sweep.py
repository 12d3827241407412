# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
A resumable sweep over the paper's runs.

What is done is left as it is, what was begun goes on. Recordings are made when the first run needs
them.
"""

from dataclasses import asdict, dataclass, replace
import json
import math
from pathlib import Path
import sys
import time

from experiments.paper.job import collect_task, DONE, FAILED, logged
from experiments.paper.places import is_collected, read_json, recording_hash
from tap_ros.engines.run import run_tasks
from tap_ros.engines.task import LOCAL, Task
from tap_ros.errors import EngineError, TapError
from tap_ros.prediction.training_config import DEFAULTS
from tqdm import tqdm

_SHOW = (60, 1)  # s between looks of the progress bar, in a file and on a terminal


@dataclass(frozen=True)
class State:
    """
    How far a run is.

    :param kind: 'done', 'partial', 'missing', or 'other': done or begun, but with other settings
        or recordings.
    :param steps: training steps done.
    :param result: what the run's JSON file holds, if it is done.
    """

    kind: str
    steps: int = 0
    result: dict | None = None


@dataclass(frozen=True)
class End:
    """
    How a job ended.

    :param name: of the run, or of the task that was to be collected.
    :param kind: 'done', 'unfinished', 'busy' (another sweep is at it) or 'failed'.
    :param reason: the last line of what it printed.
    :param place: the file with all of that, or the folder of the recording.
    """

    name: str
    kind: str
    reason: str
    place: str


def find_state(run, places, hashes=None):
    """
    Find out how far a run is.

    :param run: PaperRun.
    :param places: Places.
    :param hashes: of data_hashes. Where the recording is not at hand a run that was done elsewhere
        is taken as it is.
    :return: State.
    """
    hashes = hashes or {}
    scored = hashes.get(run.task)
    config, folder = run.config(places.recordings, places.runs), run.folder(places.runs)
    result = read_json(places.result(run))
    if (result is not None and _same(result['config'], config)
            and scored in (None, result['data']['hash'])
            and _training_hash(run, places, hashes) in (None, trained_on(result))):
        return State('done', config.steps, result)
    about = read_json(folder / 'run.json')
    if about is not None:
        if (_same(read_json(folder / 'config.json') or {}, config)
                and _training_hash(run, places, hashes) in (None, about['data_hash'])):
            return State('partial', about['steps'])
        return State('other')
    return State('missing' if result is None else 'other')


def trained_on(result):
    """Return the hash of the recordings that the run of a result was trained on."""
    return result['data'].get('trained_on', result['data']['hash'])


def _training_hash(run, places, hashes):
    """Return the hash of what a run is trained on; None where not all of it is at hand."""
    if any(task not in hashes for task in run.training_tasks):
        return None
    if len(run.training_tasks) == 1:
        return hashes[run.task]
    return recording_hash(*map(places.recording, run.training_tasks))


def trained_steps(run, places):
    """
    Find out for how many steps a run is trained, whatever its recording.

    :param run: PaperRun.
    :param places: Places.
    :return: 0 too where it was trained with other settings.
    """
    folder, config = run.folder(places.runs), run.config(places.recordings, places.runs)
    about = read_json(folder / 'run.json')
    if about is None or not _same(read_json(folder / 'config.json') or {}, config):
        return 0
    return about['steps']


def _same(settings, config):
    """Compare settings of a run, all that training depends on; new ones count as the default."""
    from tap_ros.learning.checkpoints import FREE  # torch takes seconds, --help does without
    wanted = _comparable(json.loads(json.dumps(asdict(config))))
    settings = _comparable({**DEFAULTS, **settings})
    return all(settings[name] == value for name, value in wanted.items() if name not in FREE)


def _comparable(settings):
    """Name the weights to begin with by their run alone, wherever the folder of runs is."""
    return {**settings, 'initial_weights': Path(settings['initial_weights']).parent.name}


def data_hashes(runs, places):
    """
    Read the recordings that are at hand, complete.

    :param runs: PaperRuns.
    :param places: Places.
    :return: dict from tasks to hashes.
    """
    wanted = {}
    for run in runs:
        for task in run.training_tasks:
            wanted[task] = max(replace(run, task=task).num_episodes, wanted.get(task, 0))
    return {task: recording_hash(places.recording(task)) for task, episodes in wanted.items()
            if is_collected(places.recording(task), episodes)}


def sweep(runs, places, engine=LOCAL, minutes=None, fresh=False, collect_only=False,
          on_done=lambda: None, progress=True):
    """
    Do all runs that are not done: collect what they need, train and score.

    :param runs: PaperRuns, the most important first.
    :param places: Places; on a cluster, folders that all its machines share.
    :param engine: Engine.
    :param minutes: begin nothing after so many, and let trainings stop then; None: never.
    :param fresh: begin runs anew that were begun with other settings or recordings.
    :param collect_only: make the recordings only.
    :param on_done: called after each run that is done.
    :param progress: whether to show a progress bar.
    :return: list of Ends of all that was tried.
    """
    deadline = time.time() + 60 * (minutes or math.inf)
    hashes = data_hashes(runs, places)
    states = {run: find_state(run, places, hashes) for run in runs}
    waiting = [run for run in runs if collect_only or states[run].kind != 'done']
    ends = _collect_missing(waiting, runs, places, hashes, engine, deadline, progress)
    missing = {end.name for end in ends if end.kind != 'done'}
    waiting = [] if collect_only else [
        run for run in waiting if missing.isdisjoint(run.training_tasks)]
    with tqdm(desc='paper', unit='step', total=sum(run.num_steps for run in waiting),
              initial=sum(states[run].steps for run in waiting), disable=not progress) as bar:
        # Those that begin with the weights of others come when these are done.
        for later in (False, True):
            undone = {end.name for end in ends if end.kind != 'done'}
            chosen = {run.name: run for run in waiting if later == (run.before in waiting)
                      and (run.before is None or run.before.name not in undone)}
            tasks = [Task(run.name, logged, (run, places, deadline, fresh
                                             and states[run].kind != 'partial'))
                     for run in chosen.values()]
            for task, get in run_tasks(
                    tasks, engine, lambda: time.time() > deadline,
                    _Shower(bar, states, chosen.values(), places) if progress else lambda: None):
                ends.append(_end(task.name, get, chosen[task.name].folder(places.runs)))
                if progress:
                    bar.write(f'{task.name}: {ends[-1].kind}')
                if ends[-1].kind == DONE:
                    on_done()
    return ends


def _collect_missing(waiting, runs, places, hashes, engine, deadline, progress):
    """Collect the recordings that runs wait for, and note their hashes; return the Ends."""
    ends = []
    for task in dict.fromkeys(task for run in waiting for task in run.training_tasks):
        if task in hashes or time.time() > deadline:
            continue
        episodes = max(replace(run, task=task).num_episodes
                       for run in runs if task in run.training_tasks)
        try:
            kind = collect_task(task, episodes, places, engine, deadline, progress)
            reason = ''
        except TapError as error:
            kind, reason = FAILED, f'error: {error}'
        ends.append(End(task, kind, reason, str(places.recording(task))))
        if kind == DONE:
            hashes[task] = recording_hash(places.recording(task))
    return ends


def _end(name, get, folder):
    """Return the End of a run whose task has ended."""
    log = folder / 'log.txt'
    try:
        kind = get()
        lines = log.read_text(errors='replace').strip().splitlines()
    except (EngineError, OSError) as error:
        kind, lines = FAILED, [f'error: {error}']
    return End(name, kind, lines[-1] if lines else 'it printed nothing', str(log))


class _Shower:
    """Brings the progress bar up to date now and then, from what trainings leave."""

    def __init__(self, bar, states, runs, places):
        self._bar, self._runs, self._places = bar, list(runs), places
        self._states, self._shown = states, -math.inf

    def __call__(self):
        if time.monotonic() < self._shown + _SHOW[sys.stderr.isatty()]:
            return
        self._shown = time.monotonic()
        for run in self._runs:
            about = read_json(run.folder(self._places.runs) / 'run.json') or {'steps': 0}
            self._bar.update(max(0, about['steps'] - self._states[run].steps))
            self._states[run] = State('partial', max(about['steps'], self._states[run].steps))
