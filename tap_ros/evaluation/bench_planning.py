# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Benchmark of planning: the time of one plan, and how it compares with one sample at a time."""

from pathlib import Path
import time

import numpy as np
from sim_bridge.simulator import Simulator
from tap_ros.evaluation.planning import FIRST_SCENE
from tap_ros.planning.visual_mpc import PRESETS, VisualMPC, with_preset

WEIGHTS = Path(__file__).parents[1] / 'weights' / 'forward_model_push.safetensors'


def add_arguments(parser):
    """Add the options of this benchmark."""
    parser.add_argument(
        '--plans', type=int, default=15, help='how many to time (default: %(default)s)')
    parser.add_argument('--weights', default=str(WEIGHTS), help='(default: the shipped ones)')
    parser.add_argument('--device', default='cpu', help='cpu or cuda (default: %(default)s)')


def run(args):
    """Print the times of plans, and of the naive way: a batch of one for every sample."""
    simulator = Simulator('push2')
    seen = simulator.reset(FIRST_SCENE)
    goal = simulator.goal().object_pixels

    def times(config, count):
        mpc = VisualMPC.load(args.weights, config, args.device)
        measured = []
        for seed in range(count + 1):
            mpc.reset(seed)
            begin = time.perf_counter()
            mpc.act(seen.image, seen.gripper, seen.object_pixels, goal_pixels=goal)
            measured.append(1000 * (time.perf_counter() - begin))
        return np.array(measured[1:])  # the first one warms up
    default = with_preset('default')
    search = default.search
    print(f'one plan: {search.num_samples} samples x {search.num_iterations} iterations x '
          f'horizon {default.segments * default.repeat}, two objects')
    print(f'{"":<34}{"p50, ms":>10}{"p90, ms":>10}')
    medians = {}
    for name in PRESETS:
        plans = times(with_preset(name), args.plans)
        medians[name] = np.median(plans)
        print(f'preset {name:<27}{medians[name]:>10.0f}{np.percentile(plans, 90):>10.0f}')
    naive = times(with_preset('default', batch_size=1), 1)
    print(f'{"default, one sample at a time":<34}{naive[0]:>10.0f}')
    print(f'ratio to one sample at a time: {naive[0] / medians["default"]:.1f}x faster')
    simulator.close()
