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
import sys
import time

from experiments.paper.job import collect_task, DONE, FAILED, logged
from experiments.paper.places import is_collected, read_json, recording_hash
from tap_ros.engines import LOCAL, run_tasks, Work
from tap_ros.errors import EngineError, TapError
from tap_ros.prediction.methods import todays_settings
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
        is taken as it is; where one with another hash is, it is not done with that recording.
    :return: State.
    """
    recorded = (hashes or {}).get(run.task)
    config, folder = run.config(places.recordings, places.runs), run.folder(places.runs)
    result = read_json(places.result(run))
    if (result is not None and _same(result['config'], config)
            and recorded in (None, result['data']['hash'])
            and all((hashes or {}).get(name) in (None, result['data']['shifted'].get(name))
                    for name in run.shifted)):
        return State('done', config.steps, result)
    about = read_json(folder / 'run.json')
    if about is not None:
        if (_same(read_json(folder / 'config.json') or {}, config)
                and recorded in (None, about['data_hash'])):
            return State('partial', about['steps'])
        return State('other')
    return State('missing' if result is None else 'other')


def _same(settings, config):
    """Compare settings of a run, all that training depends on; new ones count as the default."""
    from tap_ros.training.settings import FREE  # torch takes seconds, --help does without
    wanted = json.loads(json.dumps(asdict(config)))
    settings = {**DEFAULTS, **todays_settings(settings)}
    return all(settings.get(name) == wanted.get(name)
               for name in {**settings, **wanted} if name not in FREE)


def data_hashes(runs, places):
    """
    Read the recordings that are at hand, complete.

    :param runs: PaperRuns.
    :param places: Places.
    :return: dict from tasks to hashes.
    """
    return {task: recording_hash(places.recording(task))
            for task, episodes in _needed(runs).items()
            if is_collected(places.recording(task), episodes)}


def _needed(runs):
    """Return the recordings that runs need: name -> how many episodes."""
    wanted = {}
    for run in runs:
        for name in (run.task, *run.shifted):
            wanted[name] = max(replace(run, task=name).num_episodes, wanted.get(name, 0))
    return wanted


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
    chosen = {} if collect_only else {
        run.name: run for run in waiting if missing.isdisjoint((run.task, *run.shifted))}
    tasks = [Work(run.name, logged, (run, places, deadline, fresh
                                     and states[run].kind != 'partial'))
             for run in chosen.values()]
    with tqdm(desc='paper', unit='step', total=sum(run.num_steps for run in chosen.values()),
              initial=sum(states[run].steps for run in chosen.values()),
              disable=not progress) as bar:
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
    ends, episodes = [], _needed(runs)
    for task in _needed(waiting):
        if task in hashes or time.time() > deadline:
            continue
        try:
            kind = collect_task(task, episodes[task], places, engine, deadline, progress)
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
