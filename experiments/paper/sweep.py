# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
A resumable sweep over the paper's runs, several processes at a time.

What is done is left as it is, what was begun goes on. Recordings are made when the first run needs
them.
"""

from contextlib import contextmanager
from dataclasses import asdict, dataclass, replace
import json
import math
import os
from pathlib import Path
import signal
import subprocess
import sys
import time

from experiments.paper.job import BUSY, DONE, UNFINISHED
from experiments.paper.places import is_collected, read_json, recording_hash
from experiments.paper.runs import PaperRun
from tap_ros.learning.checkpoints import FREE
from tap_ros.prediction.training_config import DEFAULTS
from tqdm import tqdm

_ENDS = {DONE: 'done', BUSY: 'busy', UNFINISHED: 'unfinished', -signal.SIGTERM: 'unfinished'}
_POLL = 0.5  # s
_SHOW = (60, 1)  # s between looks of the progress bar, in a file and on a terminal
_GRACE = 20  # s that a process has to end when asked to


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
    :param log: Path of what it printed.
    """

    name: str
    kind: str
    log: Path

    @property
    def reason(self):
        """The last line of the log."""
        lines = self.log.read_text(errors='replace').strip().splitlines()
        return lines[-1] if lines else 'it printed nothing'


@dataclass(frozen=True)
class _Job:
    """A process that is running; run is None where it collects."""

    task: str
    run: PaperRun | None
    process: subprocess.Popen
    log: Path


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


def sweep(runs, places, jobs=1, minutes=None, fresh=False, collect_only=False, on_done=None,
          progress=True):
    """
    Do all runs that are not done.

    :param runs: PaperRuns, the most important first.
    :param places: Places.
    :param jobs: processes at a time.
    :param minutes: begin nothing after so many, and let trainings stop then; None: never.
    :param fresh: begin runs anew that were begun with other settings or recordings.
    :param collect_only: make the recordings only.
    :param on_done: called after each run that is done.
    :param progress: whether to show a progress bar.
    :return: list of Ends of all that was tried.
    """
    deadline = time.monotonic() + 60 * (minutes or math.inf)
    hashes = data_hashes(runs, places)
    states = {run: find_state(run, places, hashes) for run in runs}
    waiting = [run for run in runs if states[run].kind != 'done']
    if collect_only:
        waiting = list(runs)
    active, ends, failed, undone = [], [], set(), set()
    bar = tqdm(desc='paper', unit='step', total=sum(run.num_steps for run in waiting),
               initial=sum(states[run].steps for run in waiting),
               disable=not progress or collect_only)

    def begin():
        """Start the first job that can be; return whether there was one."""
        collecting = {job.task for job in active if job.run is None}
        for run in list(waiting):
            missing = [task for task in run.training_tasks if task not in hashes]
            if (not failed.isdisjoint(run.training_tasks) or run.before in undone
                    or (collect_only and not missing)):
                waiting.remove(run)
            elif run.before in [*waiting, *(job.run for job in active if job.run)] and (
                    not collect_only):
                continue
            elif not missing:
                waiting.remove(run)
                active.append(_start_run(
                    run, places, deadline, fresh and states[run].kind != 'partial'))
                return True
            elif not collecting.issuperset(missing):
                task = next(task for task in missing if task not in collecting)
                active.append(_start_collecting(task, runs, places, jobs))
                return True
        return False

    def end(job, status):
        """Take note of how a job ended."""
        active.remove(job)
        kind = _ENDS.get(status, 'failed')
        ends.append(End(job.run.name if job.run else job.task, kind, job.log))
        if progress:
            bar.write(f'{ends[-1].name}: {kind}')
            _show(bar, states, [job], places)
        if job.run is None and kind == 'done':
            hashes[job.task] = recording_hash(places.recording(job.task))
        elif job.run is None:
            failed.add(job.task)
        elif kind != 'done':
            undone.add(job.run)  # what begins with its weights has to wait for another sweep
        elif on_done:
            on_done()

    shown = -math.inf
    with _stoppable(active), bar:
        while True:
            while len(active) < jobs and time.monotonic() < deadline and begin():
                pass
            if not active:
                return ends
            time.sleep(_POLL)
            for job in list(active):
                if job.run is None and time.monotonic() > deadline:
                    _signal_group(job.process, signal.SIGTERM)  # it goes on file by file
                status = job.process.poll()
                if status is not None:
                    end(job, status)
            if progress and time.monotonic() > shown + _SHOW[sys.stderr.isatty()]:
                shown = time.monotonic()
                _show(bar, states, active, places)


def _start_run(run, places, deadline, fresh):
    """Start a process that trains and scores."""
    left = deadline - time.monotonic()
    job = {'run': asdict(run), 'minutes': None if math.isinf(left) else max(left, 1) / 60,
           'fresh': fresh}
    return _Job(run.task, run, *_start(job, places, run.folder(places.runs) / 'log.txt'))


def _start_collecting(task, runs, places, jobs):
    """Start a process that collects the recording of a task, for all runs that need it."""
    episodes = max(replace(run, task=task).num_episodes
                   for run in runs if task in run.training_tasks)
    job = {'collect': task, 'episodes': episodes,
           'workers': max(1, len(os.sched_getaffinity(0)) // jobs)}
    return _Job(task, None, *_start(job, places, Path(places.runs) / f'collect-{task}.txt'))


def _start(job, places, log):
    """Start a process of its own group; return (Popen, log)."""
    log.parent.mkdir(parents=True, exist_ok=True)
    with open(log, 'w') as file:
        process = subprocess.Popen(
            [sys.executable, '-m', 'experiments.paper.job',
             json.dumps({'places': asdict(places), **job})],
            stdin=subprocess.DEVNULL, stdout=file, stderr=file, start_new_session=True)
    return process, log


@contextmanager
def _stoppable(active):
    """End all processes when this one is interrupted, told to end, or fails."""
    def interrupt(*_):
        raise KeyboardInterrupt
    signals = [number for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
               if signal.getsignal(number) != signal.SIG_IGN]  # as under nohup
    before = {number: signal.signal(number, interrupt) for number in signals}
    try:
        yield
    finally:
        for number in signals:
            signal.signal(number, signal.SIG_IGN)
        for job in active:
            _signal_group(job.process, signal.SIGTERM)
        patience = time.monotonic() + _GRACE
        for job in active:
            try:
                job.process.wait(max(0, patience - time.monotonic()))
            except subprocess.TimeoutExpired:
                _signal_group(job.process, signal.SIGKILL)
                job.process.wait()
        for number, handler in before.items():
            signal.signal(number, handler)


def _signal_group(process, number):
    """Send a signal to a process and its children, as far as they are alive."""
    try:
        os.killpg(process.pid, number)
    except ProcessLookupError:
        pass


def _show(bar, states, active, places):
    """Bring the progress bar up to date."""
    for job in active:
        if job.run is not None:
            about = read_json(job.run.folder(places.runs) / 'run.json') or {'steps': 0}
            bar.n += max(0, about['steps'] - states[job.run].steps)
            states[job.run] = State('partial', max(about['steps'], states[job.run].steps))
    bar.set_postfix_str(', '.join(job.run.name if job.run else f'collecting {job.task}'
                                  for job in active))
