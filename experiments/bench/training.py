# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Benchmark of training: samples a second of each kind of method, and the share of the peak.

The peak is the rate of a large matrix product in the precision of the training, measured in the
same run.
"""

from dataclasses import dataclass, replace
import os
import tempfile
from typing import Annotated

from experiments.bench.speed import matrix_rate, matrix_side
from tap_ros.learning.devices import make_autocast, pick_device
from tap_ros.options import Bags, Flag
from tap_ros.prediction.training import train
from tap_ros.prediction.training_config import TrainingConfig
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator
import torch
from torch.utils.flop_counter import FlopCounterMode
from tyro import conf

METHODS = ('genmin-wo-gan', 'genmin', 'genmin-vae', 'genmin-vae-gan')


@dataclass(frozen=True)
class Options:
    """
    Options of this benchmark.

    :param recordings: to train on.
    :param methods: each as --method of train.
    :param steps: how many to time.
    :param base_width: as for train.
    :param batch_size: as for train.
    :param threads: as for train.
    :param device: as for train.
    :param compile: as for train.
    """

    recordings: Bags = ('bags/sample_push2',)
    methods: Annotated[tuple[str, ...], conf.arg(metavar='METHOD [METHOD ...]')] = METHODS
    steps: int = 30
    base_width: int = TrainingConfig.base_width
    batch_size: int = TrainingConfig.batch_size
    threads: int = TrainingConfig.threads
    device: str = TrainingConfig.device
    compile: Flag = False


def run(args):
    """Train each method for some steps in a temporary folder, and print how fast that was."""
    device = pick_device(args.device)
    with make_autocast('auto', device)():
        half = torch.is_autocast_enabled(device.type)
    dtype = torch.bfloat16 if half else torch.float32
    torch.set_num_threads(args.threads or len(os.sched_getaffinity(0)))
    peak = matrix_rate(device, dtype)
    print(f'batch {args.batch_size}, base width {args.base_width}, new pixels, {device.type}'
          + (f', {torch.get_num_threads()} threads' if device.type == 'cpu' else '')
          + f'; peak: {peak / 1e12:.2f} T operations/s, '
          f'a {dtype} product of {matrix_side(device)}')
    print(f'{"method":<20}{"samples/s":>12}{"G operations a sample":>24}{"share of peak":>16}')
    for method in args.methods:
        with tempfile.TemporaryDirectory() as folder:
            config = TrainingConfig(
                recordings=tuple(args.recordings), out=folder, method=method, new_pixels=True,
                margin=0, outer_power=1.0, goal_picture='last', base_width=args.base_width,
                batch_size=args.batch_size, device=args.device, threads=args.threads,
                compile=args.compile, save_every=10 ** 9)
            rate = args.batch_size / time_step(config, args.steps)
            operations = count_operations(config) / args.batch_size
        print(f'{method:<20}{rate:>12.0f}{operations / 1e9:>24.2f}'
              f'{rate * operations / peak:>16.0%}')


def time_step(config, steps):
    """
    Time a step of training, all that belongs to it included.

    :param config: TrainingConfig, of a run that has not begun.
    :param steps: how many to average over, after as many to warm up and to compile.
    :return: seconds.
    """
    # A point of the curves waits for the GPU.
    train(replace(config, log_every=steps), stop_at=2 * steps, progress=False)
    first, last = EventAccumulator(config.out).Reload().Scalars('train/loss')
    return (last.wall_time - first.wall_time) / steps


def count_operations(config):
    """
    Count the floating-point operations of a step: of convolutions and matrix products.

    :param config: TrainingConfig.
    :return: operations; a product and a sum are two.
    """
    counts = []
    for steps in (1, 2):  # the difference is one step without what surrounds it
        with tempfile.TemporaryDirectory() as folder, FlopCounterMode(display=False) as counter:
            train(replace(config, out=folder, compile=False), stop_at=steps, progress=False)
        counts.append(counter.get_total_flops())
    return counts[1] - counts[0]
