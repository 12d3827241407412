# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Benchmark of training: what each method costs, and what makes it faster than the first row.

A CPU second is one of one core, all threads of the process together: what else the machine does
matters little.
"""

from dataclasses import dataclass, replace
import tempfile
import time
from typing import Annotated

from experiments.bench.rows import Row
from experiments.paper.methods import method_fields
from tap_ros.base.options import Bags
from tap_ros.training.predictor import train
from tap_ros.training.predictor_config import TrainingConfig
from tap_ros.weights.devices import has_bfloat16, pick_device, pick_precision
import torch
from tyro import conf

METHODS = ('genmin-wo-gan', 'genmin', 'genmin-vae', 'genmin-vae-gan')
# One change after the other; `auto` is bfloat16 where that is faster.
LADDER = (
    {'gan': True, 'precision': 'float32'}, {'precision': 'float32'},
    {'precision': 'float32', 'decoder': 'shared'},
    {'precision': 'float32', 'decoder': 'shared', 'skips': True},
    {'decoder': 'shared'}, {'decoder': 'shared', 'skips': True})

SAME = 3  # the row of the ladder that is its last one in float32
AIM = 3.2  # times the first row, of the ladder's last one where there is bfloat16


@dataclass(frozen=True)
class Options:
    """
    Options of this benchmark.

    :param recordings: to train on.
    :param methods: further rows: methods by their names in results, in the precision `auto`.
    :param steps: how many to time.
    :param base_width: as for train.
    :param batch_size: as for train.
    :param threads: as for train.
    :param device: as for train.
    """

    recordings: Bags = ('bags/sample_push2',)
    methods: Annotated[tuple[str, ...], conf.arg(metavar='METHOD [METHOD ...]')] = METHODS
    steps: int = 30
    base_width: int = TrainingConfig.base_width
    batch_size: int = TrainingConfig.batch_size
    threads: int = TrainingConfig.threads
    device: str = TrainingConfig.device


@dataclass(frozen=True)
class Cost:
    """Seconds that pass in a step of training, and those of all cores together."""

    seconds: float
    cpu_seconds: float


def run(args):
    """Train in each way for some steps, and say how fast that was."""
    device = pick_device(args.device)
    if args.threads:
        torch.set_num_threads(args.threads)
    efficiencies = []
    for row in (*LADDER, *map(method_fields, args.methods)):
        with tempfile.TemporaryDirectory() as folder:
            config = TrainingConfig(**{
                'recordings': tuple(args.recordings), 'out': folder, 'new_pixels': True,
                'selection': 'absolute', 'margin': 0, 'goal_picture': 'last', 'start_crop': 0.0,
                'decoder': 'separate', 'skips': False, 'base_width': args.base_width,
                'batch_size': args.batch_size, 'device': args.device, 'threads': args.threads,
                'save_every': 10 ** 9, **row})
            cost = time_step(config, args.steps)
        efficiencies.append(args.batch_size / cost.cpu_seconds)
        ratio, aim = efficiencies[-1] / efficiencies[0], ()
        if row is LADDER[-1] and has_bfloat16(device):
            aim = (f'at least {AIM} times', ratio >= AIM,
                   f'bfloat16 makes {ratio * efficiencies[0] / efficiencies[SAME]:.2f} x of it')
        network = f'{config.decoder} decoder{" with skips" * config.skips}'
        yield Row(
            f'train a predictor, `{config.method}`, {network}, '
            f'{pick_precision(config.precision, device)}',
            f'{args.batch_size / cost.seconds:.0f} samples/s', ratio,
            'the first row, by CPU time', *aim)


def time_step(config, steps):
    """Time a step of training, all that belongs to it included, mean of so many after as many."""
    times = {}

    def note(step):
        times[step] = (time.perf_counter(), time.process_time())

    # A point of the curves waits for the GPU.
    train(replace(config, log_every=steps), stop_at=2 * steps, progress=False, after_step=note)
    return Cost(*((end - begin) / steps for begin, end in zip(times[steps], times[2 * steps])))
