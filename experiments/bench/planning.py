# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Benchmark of planning: the time of a plan, where it goes, and the solvers side by side."""

from dataclasses import dataclass, replace
import time

from experiments.bench.mppi import mppi
from experiments.bench.rows import Row
from experiments.planning.methods import FIRST_SCENE, with_samples
import numpy as np
from sim_bridge.simulator import Simulator
from tap_ros.base.contract import CLEAR
from tap_ros.base.errors import PlanningError
from tap_ros.base.options import ShippedFile
from tap_ros.evaluation.intervals import mean_interval
from tap_ros.images.pixels import to_float
from tap_ros.planning.action_sequences import HORIZON
from tap_ros.planning.mpc_config import PRESETS, with_preset
from tap_ros.planning.visual_mpc import Memory, Scene, VisualMPC
from tap_ros.weights import FORWARD_MODEL
import torch
from torch.profiler import profile, ProfilerActivity

AIMS_S = {'at the start': 0.5, 'while pushing': 0.65}  # of a plan of the preset `large`
CALIBRATION = 6  # scenes by which other solvers get the time of CEM


@dataclass(frozen=True)
class Options:
    """
    Options of this benchmark.

    :param plans: how many to time.
    :param scenes: in which the solvers are compared.
    :param weights: of the forward model.
    :param device: cpu or cuda.
    """

    plans: int = 15
    scenes: int = 24
    weights: ShippedFile = str(FORWARD_MODEL)
    device: str = 'cpu'


def run(args):
    """Time plans of each preset, and say what the solvers find."""
    simulator = Simulator('push2', 64)
    seen = simulator.reset(FIRST_SCENE)
    goal = simulator.goal().object_pixels
    planners = {name: VisualMPC.load(args.weights, with_preset(name), args.device)
                for name in PRESETS if name != 'paper'}
    pushing = push_until_low(simulator, planners['large'], goal)
    for name, mpc in planners.items():
        search = mpc.config.search
        for when, scene, warm in (('at the start', seen, False), ('while pushing', pushing, True)):
            times, predicting = time_plans(mpc, scene, goal, args.plans, warm)
            seconds = np.median(times) / 1000
            steps = search.num_samples * search.num_iterations * HORIZON
            yield Row(
                f'plan, preset `{name}`, {when}', f'{seconds:.2f} s, {1e6 * seconds / steps:.0f} '
                'us a sample-step', times.sum() / predicting.sum(), 'its predictions alone',
                *((f'at most {AIMS_S[when]} s', seconds <= AIMS_S[when])
                  if name == 'large' else ()),
                limit=where_time_goes(mpc.model, scene) if name == 'large' else '')
    simulator.close()
    yield from compare_solvers(args)


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
    Return the times (count,) of plans in ms, after one to warm up, and of their predictions.

    :param warm: every plan but the first begins with the one before.
    """
    times, scene, goal, memory = [], as_scene(seen), mpc.goal(goal), Memory()
    judge, spent = mpc.rollouts.judge, []

    def timed(*args):
        begin = time.perf_counter()
        found = judge(*args)
        spent[-1] += 1000 * (time.perf_counter() - begin)
        return found

    mpc.rollouts.judge = timed
    for seed in range(count + 1):
        spent.append(0.0)
        plan = mpc.plan(scene, goal, memory if warm else Memory(seed))
        memory = plan.memory
        times.append(plan.planning_ms)
    mpc.rollouts.judge = judge
    return np.array(times[1:]), np.array(spent[1:])


@torch.inference_mode()
def where_time_goes(model, seen, count=50):
    """Return which share of a prediction the kinds of operations take, in words."""
    table, scene = model.table, as_scene(seen)
    image = to_float(scene.image)[None].to(table.device)
    gripper = torch.from_numpy(scene.gripper).float().to(table.device)[None]
    maps = table.seed_maps(torch.from_numpy(scene.object_pixels).to(table.device))
    actions = torch.zeros(count, HORIZON, 4, device=table.device)
    start = model.begin(image, gripper)
    with profile(activities=[ProfilerActivity.CPU]) as seen_by:
        list(model.carried_maps(start, gripper.expand(count, 4), maps, actions))
    times = {event.key: event.self_cpu_time_total for event in seen_by.key_averages()}
    kinds = {'convolutions': ('conv', 'mkldnn'), 'sampling at points': ('grid_sampl', 'gather',
                                                                     'index')}
    shares = {kind: sum(t for key, t in times.items() if any(w in key for w in words))
              / sum(times.values()) for kind, words in kinds.items()}
    return ', '.join(f'{kind} {share:.0%} of a prediction' for kind, share in shares.items())


def compare_solvers(args):
    """Return rows: what other solvers and fewer samples find beside CEM, in first plans."""
    default = with_preset('default')
    num_samples, few = default.search.num_samples, default.search.num_samples // 3
    simulator = Simulator('push2', 64)
    scenes = [(seed, as_scene(simulator.reset(seed)), simulator.goal().object_pixels)
              for seed in range(FIRST_SCENE, FIRST_SCENE + args.scenes)]
    simulator.close()
    third = with_samples(default, few)
    configs = {('cem', num_samples): default, ('cem', few): third}
    for name, solver in (('icem', 'icem'), ('mppi', mppi)):
        # As many as fit into the time of CEM, on the line through two measurements.
        ways = [default, *(replace(config, solver=solver) for config in (third, default))]
        cem, low, high = (
            np.median(times) for _, times in plans(args, ways, scenes[:CALIBRATION]))
        equal = few + (num_samples - few) * (cem - low) / max(high - low, 0.01 * cem)
        for count in (int(np.clip(equal, few, 2 * num_samples)), few):
            configs[name, count] = replace(with_samples(default, count), solver=solver)
    (costs, times), *others = plans(args, configs.values(), scenes)
    rows = []
    for (name, count), (found, took) in zip(list(configs)[1:], others):
        cost, low, high = np.exp(mean_interval(np.log(np.divide(found, costs))))
        rows.append(Row(
            f'first plan, `{name}`, {count} samples', f'cost {cost:.2f} ({low:.2f} to {high:.2f}) '
            f'times that of `cem`, {num_samples} samples', np.median(took) / np.median(times),
            "the time of `cem`'s"))
    return rows


def plans(args, configs, scenes):
    """Plan each (seed, Scene, pixels) in turns; return for each config (costs, times in ms)."""
    planners = [VisualMPC.load(args.weights, config, args.device) for config in configs]
    found = [([], []) for _ in planners]
    for number, (seed, scene, pixels) in enumerate((scenes[0], *scenes)):
        for (costs, times), mpc in zip(found, planners):
            plan = mpc.plan(scene, mpc.goal(pixels), Memory(seed))
            if number:
                costs.append(plan.cost)
                times.append(plan.planning_ms)
    return found


def as_scene(seen):
    """Return an Observation of the simulator as the planner's Scene."""
    return Scene(seen.image, seen.gripper, seen.object_pixels)
