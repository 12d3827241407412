# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Benchmark of planning: the time of one plan, beside the naive way and beside arithmetic alone.

The naive way asks the model for one sample at a time and decodes every predicted frame at the
picture's full size. Arithmetic alone is what the plan's floating-point operations would take at
the rate of a large matrix product, measured in the same run; it is compared with a plan while
pushing, since at the start many sequences stay above the objects, where nothing is predicted.
"""

from dataclasses import dataclass
import os
import time

from experiments.bench.speed import matrix_rate, matrix_side
import numpy as np
from sim_bridge.simulator import Simulator
from tap_ros.contract import CLEAR, LOW
from tap_ros.errors import PlanningError
from tap_ros.images.pixels import to_float
from tap_ros.options import ShippedFile
from tap_ros.planning.action_sequences import FIRST_STD, HORIZON
from tap_ros.planning.mpc_config import FIRST_SCENE, PRESETS, with_preset
from tap_ros.planning.mpc_inputs import Scene
from tap_ros.planning.visual_mpc import Memory, VisualMPC
from tap_ros.weights import FORWARD_MODEL
import torch
from torch.utils.flop_counter import FlopCounterMode

BILINEAR = 8  # operations to read one number between four


@dataclass(frozen=True)
class Options:
    """
    Options of this benchmark.

    :param plans: how many to time.
    :param naive_samples: how many of a plan to time one at a time; scaled up to a whole plan.
    :param weights: of the forward model.
    :param device: cpu or cuda.
    """

    plans: int = 15
    naive_samples: int = 20
    weights: ShippedFile = str(FORWARD_MODEL)
    device: str = 'cpu'


def run(args):
    """Print the times of plans, of the naive way, and of the operations alone."""
    simulator = Simulator('push2')
    seen = simulator.reset(FIRST_SCENE)
    goal = simulator.goal().object_pixels
    cores = len(os.sched_getaffinity(0))
    large = with_preset('large')
    search = large.search
    print(f'one plan: {search.num_samples} samples x {search.num_iterations} iterations x '
          f'horizon {HORIZON}, two objects, {args.device}'
          + (f', {cores} cores' if args.device == 'cpu' else ''))
    planners = {name: VisualMPC.load(args.weights, with_preset(name), args.device)
                for name in PRESETS}
    planner = planners['large']
    pushing = push_until_low(simulator, planner, goal)
    print(f'{"":<34}{"at the start":>20}{"while pushing":>20}')
    print(f'{"":<34}' + f'{"p50, ms":>10}{"p90, ms":>10}' * 2)
    for name, mpc in planners.items():
        times = (time_plans(mpc, seen, goal, args.plans),
                 time_plans(mpc, pushing, goal, args.plans, warm=True))
        if name == 'large':
            median = np.median(times[1])
        size = f'{mpc.config.search.num_samples} x {mpc.config.search.num_iterations}'
        print(f'{f"preset {name}, {size}":<34}' + ''.join(
            f'{np.median(part):>10.1f}{np.percentile(part, 90):>10.1f}' for part in times))
    samples = search.num_samples * search.num_iterations + search.num_elites * large.recheck
    naive = time_naively(planner, seen, args.naive_samples) * samples
    operations = samples * count_operations(planner, seen)
    rates = {'float32': matrix_rate(args.device, torch.float32)}
    dtype = next(planner.model.push.parameters()).dtype
    if dtype == torch.bfloat16:
        rates['bfloat16'] = matrix_rate(args.device, dtype)
    print(f'{"large, one sample, every frame":<34}{naive:>10.0f}'
          f'   ({args.naive_samples} of {samples} samples timed)')
    print(f'naive / planned, while pushing: {naive / median:.1f}x')
    print(f'operations of a plan: {operations / 1e9:.2f} G (network {dtype})')
    for name, rate in rates.items():
        alone = 1000 * operations / rate
        print(f'  alone, at {rate / 1e9:.0f} G/s of a {name} product of '
              f'{matrix_side(args.device)}: {alone:.1f} ms; '
              f'planned / alone: {median / alone:.1f}x')
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


@torch.inference_mode()
def time_naively(mpc, seen, count):
    """Return the ms of one sample that is predicted alone, every frame decoded."""
    model = mpc.model
    image, gripper = _inputs(mpc, seen)
    actions = random_actions(mpc, count + 1)
    times = []
    for sample in actions[:, None]:  # (1, horizon, 4)
        begin = time.perf_counter()
        maps = model.table.seed_maps(torch.from_numpy(seen.object_pixels).to(image.device))[None]
        arm = model.draw_arm(gripper)
        scene = model.look(image, arm[:, 3:])
        flow, hand = model.still(1), gripper
        for t in range(HORIZON):
            flow, hand, _ = model.advance(scene.features, flow, hand, sample[:, t])
            picture, _ = model.picture(scene, flow, model.draw_arm(hand))
            carried = model.carry(maps, flow)
        float(picture.sum() + carried.sum())  # waits for a GPU
        times.append(1000 * (time.perf_counter() - begin))
    return float(np.median(times[1:]))


@torch.no_grad()
def count_operations(mpc, seen):
    """
    Count the floating-point operations of one sample among many.

    :return: of convolutions, matrix products and bilinear reading; a product and a sum are two.
    """
    image, gripper = _inputs(mpc, seen)
    maps = mpc.model.table.seed_maps(torch.from_numpy(seen.object_pixels).to(image.device))
    actions = random_actions(mpc, mpc.rollouts.batch_size)

    def bilinear(*_, out_shape=None, **__):
        return BILINEAR * int(np.prod(out_shape))

    features = mpc.model.begin(image, gripper)
    counter = FlopCounterMode(
        display=False, custom_mapping={torch.ops.aten.grid_sampler_2d: bilinear})
    # looked at once before, like in a plan
    with counter:
        for _ in mpc.model.carried_maps(
                features.clone(), gripper, maps.clone(), actions, mpc.config.cost_every):
            pass
    return counter.get_total_flops() / len(actions)


def random_actions(mpc, count):
    """Return sequences (count, horizon, 4) that push all the time, the dearest to predict."""
    rng = np.random.default_rng(0)
    actions = np.zeros((count, HORIZON, 4), np.float32)
    actions[..., :2] = rng.normal(0, FIRST_STD / 2, (*actions.shape[:2], 2))
    return torch.from_numpy(actions).to(mpc.model.table.device)


def _inputs(mpc, seen):
    """Return the picture (1, 3, H, W), and the gripper (1, 4) brought down to push."""
    device = mpc.model.table.device
    gripper = torch.from_numpy(np.append(seen.gripper[:2], [LOW, 0]).astype(np.float32))
    return to_float(seen.image)[None].to(device), gripper[None].to(device)
