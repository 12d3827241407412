# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""A method on the scenes of a task; planning.runs keeps what comes of it and goes on there."""

from dataclasses import dataclass
from datetime import date
import os
import platform
import time

from experiments.planning.runs import digest, load_predictor, load_simulator
from experiments.stacking.episode import run_episode
from experiments.stacking.methods import Method
from sim_bridge.world.looks import DEFAULT_LOOK
import torch


@dataclass(frozen=True)
class Job:
    """A method on a task, ready to be run on any scene."""

    task: str
    method: Method
    predictor: str = ''  # weights file; '' when nothing is predicted
    device: str = 'cpu'
    look: str = DEFAULT_LOOK  # of the world
    command: str = ''  # that makes the numbers again

    def settings(self):
        """Return as a dict all that changes results; weights by what is in them."""
        return {
            'task': self.task, 'look': self.look, 'method': self.method.name,
            'device': self.device, 'object_places': 'ground_truth',
            'predictor_weights': digest(self.predictor) if self.predictor else None}

    @property
    def about(self):
        """Return as a dict what is stored beside the settings and changes no result."""
        return {'command': self.command, 'date': date.today().isoformat(),
                'machine': f'{platform.machine()}, {os.cpu_count()} CPUs',
                'version': f'torch {torch.__version__}'}


def run_scene(job, seed):
    """
    Run a job on one scene.

    :return: dict of seed, success, first_right, moves, final_cm (mean over objects), objects_cm,
        steps (control periods) and seconds.
    """
    begin = time.perf_counter()
    run = make_episode(job, seed)
    centimetres = 100 * run.distances
    return {
        'seed': int(seed), 'success': run.success, 'first_right': run.first_right,
        'moves': len(run.moves), 'final_cm': round(float(centimetres.mean()), 3),
        'objects_cm': centimetres.round(3).tolist(), 'steps': len(run.frames) - 1,
        'seconds': round(time.perf_counter() - begin, 2)}


def make_episode(job, seed):
    """Run a job on one scene; return the StackedEpisode."""
    torch.set_num_threads(1)  # with more, the predictor's last digits differ
    predictor = load_predictor(job.predictor, job.device) if job.predictor else None
    return run_episode(load_simulator(job.task, job.look), job.method, seed, predictor)
