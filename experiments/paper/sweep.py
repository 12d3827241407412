# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
A sweep over the paper's runs: collect what they need, train and score those that are not done.

Recordings and trainings go on from where they were; the result of a run appears when it is
complete.
"""

from dataclasses import asdict, dataclass
import json
from pathlib import Path

from experiments.paper.past_settings import todays_settings
from experiments.paper.recordings import RECORDINGS
from experiments.paper.runs import SCALE
from sim_bridge.collect import collect, SETTINGS_FILE
from tap_ros.base.engines import LOCAL, run_tasks, Work
from tap_ros.base.errors import TapError
from tap_ros.base.files import write_atomically
from tap_ros.base.options import Folder
from tap_ros.base.progress import Progress
from tap_ros.training.run_config import FREE


@dataclass(frozen=True)
class Places:
    """
    Where things are; on a cluster, folders that all its machines share.

    :param recordings: folder of the recordings, each under its name.
    :param runs: folder of the trainings.
    :param results: folder of the data and figures; in it runs/small/, a JSON file for each run.
    """

    recordings: Folder = 'bags/paper'
    runs: Folder = 'runs/paper'
    results: Folder = 'runs/results'

    def recording(self, name):
        """Return the Path of a recording."""
        return Path(self.recordings, name)

    def result(self, run):
        """Return the Path of the result of a PaperRun."""
        return Path(self.results, 'runs', SCALE, f'{run.name}.json')


def find_result(run, places):
    """Return what the file of a PaperRun holds; None unless it is done, with today's settings."""
    try:
        result = json.loads(places.result(run).read_text())
    except (OSError, ValueError):
        return None
    settings, wanted = json.loads(json.dumps([  # no tuples
        todays_settings(result['config']),
        asdict(run.config(places.recordings, places.runs))]))
    same = all(settings.get(name) == wanted.get(name)
               for name in {**settings, **wanted} if name not in FREE)
    return result if same else None


def sweep(runs, places, engine=LOCAL):
    """Do all PaperRuns that are not done, in their order; return {name: why it failed}."""
    waiting = [run for run in runs if find_result(run, places) is None]
    for name in dict.fromkeys(name for run in waiting for name in (run.task, *run.shifted)):
        folder = places.recording(name)
        # One that `collect` did not make stays as it is.
        if not folder.exists() or (folder / SETTINGS_FILE).exists():
            collect(folder, RECORDINGS[name], engine)
    tasks, failed = [Work(run.name, perform, (run, places)) for run in waiting], {}
    with Progress(total=len(tasks), desc='paper', unit='run') as bar:
        for task, get in run_tasks(tasks, engine):
            try:
                get()
            except TapError as error:
                failed[task.name] = error
                bar.write(f'{task.name} failed: {error}')
            bar.update()
    return failed


def perform(run, places):
    """Train a PaperRun, or go on with it, score it and write its result."""
    from experiments.paper.score import score  # torch takes seconds, a list does without
    from tap_ros.training.predictor import train

    config = run.config(places.recordings, places.runs)
    weights = train(config, progress=False)
    write_atomically(
        places.result(run), json.dumps(score(run, config, weights, places)) + '\n')
