# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Benchmark of planning: the time of one plan, at the start and while pushing."""

from dataclasses import dataclass
import os

import numpy as np
from sim_bridge.simulator import Simulator
from tap_ros.contract import CLEAR
from tap_ros.errors import PlanningError
from tap_ros.options import ShippedFile
from tap_ros.planning.action_sequences import HORIZON
from tap_ros.planning.mpc_config import FIRST_SCENE, PRESETS, with_preset
from tap_ros.planning.mpc_inputs import Scene
from tap_ros.planning.visual_mpc import Memory, VisualMPC
from tap_ros.weights import FORWARD_MODEL


@dataclass(frozen=True)
class Options:
    """
    Options of this benchmark.

    :param plans: how many to time.
    :param weights: of the forward model.
    :param device: cpu or cuda.
    """

    plans: int = 15
    weights: ShippedFile = str(FORWARD_MODEL)
    device: str = 'cpu'


def run(args):
    """Print the times of plans of each preset."""
    simulator = Simulator('push2')
    seen = simulator.reset(FIRST_SCENE)
    goal = simulator.goal().object_pixels
    print(f'one plan, horizon {HORIZON}, two objects, {args.device}'
          + (f', {len(os.sched_getaffinity(0))} cores' if args.device == 'cpu' else ''))
    planners = {name: VisualMPC.load(args.weights, with_preset(name), args.device)
                for name in PRESETS}
    pushing = push_until_low(simulator, planners['large'], goal)
    print(f'{"samples x iterations":<34}{"at the start":>20}{"while pushing":>20}')
    print(f'{"":<34}' + f'{"p50, ms":>10}{"p90, ms":>10}' * 2)
    for name, mpc in planners.items():
        times = (time_plans(mpc, seen, goal, args.plans),
                 time_plans(mpc, pushing, goal, args.plans, warm=True))
        size = f'{mpc.config.search.num_samples} x {mpc.config.search.num_iterations}'
        print(f'{f"preset {name}, {size}":<34}' + ''.join(
            f'{np.median(part):>10.1f}{np.percentile(part, 90):>10.1f}' for part in times))
    simulator.close()


def push_until_low(simulator, mpc, goal, most=30):
    """Carry out plans until the gripper is low; return what is then seen."""
    seen, goal, memory = simulator.reset(FIRST_SCENE), mpc.goal(goal), Memory()
    for _ in range(most):
        plan = mpc.plan(as_scene(seen), goal, memory)
        seen, memory = simulator.step(plan.action), plan.memory
        if seen.gripper[2] < CLEAR / 2:
            return seen
    raise PlanningError(f'the gripper did not come down within {most} steps')


def time_plans(mpc, seen, goal, count, warm=False):
    """
    Return the times (count,) of plans in ms, after one to warm up.

    :param warm: every plan but the first begins with the one before.
    """
    times, scene, goal, memory = [], as_scene(seen), mpc.goal(goal), Memory()
    for seed in range(count + 1):
        plan = mpc.plan(scene, goal, memory if warm else Memory(seed))
        memory = plan.memory
        times.append(plan.planning_ms)
    return np.array(times[1:])


def as_scene(seen):
    """Return an Observation of the simulator as the planner's Scene."""
    return Scene(seen.image, seen.gripper, seen.object_pixels)
