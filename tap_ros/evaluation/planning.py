# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Planning in simulated scenes, in one process: do nothing, straight to the goal, by the subgoal.

The loop and its seeds are those of visual_mpc_node. All methods push the same scenes, so that
their differences are paired. Object pixels come from the simulator's ground truth at every step,
as in the paper.
"""

from dataclasses import asdict, dataclass
import json
from pathlib import Path

import numpy as np
from sim_bridge.simulator import Simulator
from sim_bridge.tasks import TASKS
from tap_ros.errors import ConfigError
from tap_ros.planning.visual_mpc import PRESETS, VisualMPC, with_preset
from tap_ros.prediction.predictor import SubgoalPredictor
from tqdm import tqdm

MODES = ('nothing', 'direct', 'subgoal')
STEP_BUDGETS = {'push2': 40, 'push3': 75}  # App. F
FIRST_SCENE = 1_000_000  # far from the seeds of the training recordings
WEIGHTS = Path(__file__).parents[1] / 'weights'
REACHED = 1.0  # px, mean over the objects, at which a goal or subgoal is reached


@dataclass
class PlannedEpisode:
    """What happened in one run."""

    distances: np.ndarray  # (steps + 1, K) metres from each object to its goal, ground truth
    frames: list  # steps + 1 pictures uint8 (H, W, 3)
    actions: np.ndarray  # (steps, 4)
    planning_ms: np.ndarray  # (steps,)
    goal: np.ndarray  # picture uint8 (H, W, 3)
    subgoal: object = None  # prediction.predictor.Subgoal
    switched_at: int | None = None  # step from which the goal itself was planned to


def run_episode(simulator, mpc, predictor, mode, step_budget, seed, reached=REACHED):
    """
    Push the objects of one scene.

    In mode 'subgoal' the planner gets the subgoal's object maps for the first half of the budget
    (App. F), or until the objects are there; then, and in mode 'direct', the goal's pixels.

    :param simulator: Simulator; reset here.
    :param mpc: VisualMPC; reset here.
    :param predictor: SubgoalPredictor; needed in mode 'subgoal' only.
    :param mode: one of MODES.
    :param step_budget: control periods at most.
    :param seed: of the scene, the planner and the predictor.
    :param reached: px, mean over objects; nearer than this is there. 0: never.
    :return: PlannedEpisode.
    :raises ConfigError: for an unknown mode, or a missing predictor.
    """
    if mode not in MODES:
        raise ConfigError(f'mode {mode!r} is unknown; valid modes: {", ".join(MODES)}')
    seen = simulator.reset(seed)
    goal = simulator.goal()
    episode = PlannedEpisode([simulator.distances()], [seen.image], [], [], goal.image)
    maps = centres = None
    if mode == 'subgoal':
        if predictor is None:
            raise ConfigError("mode 'subgoal' needs a predictor; load one, or use mode 'direct'")
        episode.subgoal = predictor.predict(
            seen.image, goal.image, seen.object_pixels, goal.object_pixels, seed=seed)[0]
        maps, centres = episode.subgoal.object_maps, episode.subgoal.expected_pixels
    mpc.reset(seed)
    for step in range(step_budget if mode != 'nothing' else 0):
        pixels = seen.object_pixels
        if _mean_distance(pixels, goal.object_pixels) <= reached:
            break
        if maps is not None and (
                step >= step_budget // 2 or _mean_distance(pixels, centres) <= reached):
            maps, episode.switched_at = None, step  # from now on straight to the goal
        plan = mpc.act(seen.image, seen.gripper, pixels, goal_maps=maps,
                       goal_pixels=goal.object_pixels if maps is None else None)
        seen = simulator.step(plan.action)
        episode.distances.append(simulator.distances())
        episode.frames.append(seen.image)
        episode.actions.append(plan.action)
        episode.planning_ms.append(plan.planning_ms)
    for name in ('distances', 'actions', 'planning_ms'):
        setattr(episode, name, np.array(getattr(episode, name)))
    return episode


def _mean_distance(pixels, goals):
    return float(np.linalg.norm(pixels - goals, axis=1).mean())


def evaluate_planning(simulator, mpc, predictor, modes, seeds, step_budget, out=None,
                      settings=None, progress=True):
    """
    Run every mode on every scene; go on where an interrupted evaluation stopped.

    :param seeds: of the scenes.
    :param out: JSON file to write after every scene and to resume from, or None.
    :param settings: dict that says what is evaluated; a file with other settings is refused.
    :return: list of dicts with seed, mode, final_cm, objects_cm, steps, planning_ms (median).
    :raises ConfigError: if `out` holds an evaluation with other settings.
    """
    settings, done = settings or {}, []
    if out is not None and Path(out).exists():
        stored = json.loads(Path(out).read_text())
        if stored['settings'] != settings:
            raise ConfigError(f'{out}: holds an evaluation with other settings '
                              f'{stored["settings"]}; give another --out, or remove it')
        done = stored['episodes']
    known = {(e['seed'], e['mode']) for e in done}
    todo = [(s, m) for s in seeds for m in modes if (s, m) not in known]
    for seed, mode in tqdm(todo, desc='scenes x modes', disable=not progress):
        run = run_episode(simulator, mpc, predictor, mode, step_budget, seed)
        final = 100 * run.distances[-1]
        done.append({
            'seed': seed, 'mode': mode, 'final_cm': float(final.mean()),
            'objects_cm': final.tolist(), 'steps': len(run.actions),
            'switched_at': run.switched_at,
            'planning_ms': float(np.median(run.planning_ms)) if len(run.planning_ms) else None})
        if out is not None:
            Path(out).parent.mkdir(parents=True, exist_ok=True)
            Path(out).write_text(json.dumps({
                'settings': settings, 'summary': summarise(done), 'episodes': done},
                indent=1) + '\n')
    return [e for e in done if e['seed'] in set(seeds) and e['mode'] in modes]


def summarise(episodes):
    """
    Average by mode.

    :param episodes: as evaluate_planning returns them.
    :return: dict mode -> mean_cm, standard_error_cm, success_5cm (share of scenes in which every
        object ends within 5 cm), scenes, planning_ms (median), and, beside 'direct' where both
        were run on the same scenes, gain_cm and gain_standard_error_cm over it.
    """
    table = {}
    finals = {mode: {e['seed']: e for e in episodes if e['mode'] == mode} for mode in MODES}
    for mode, runs in finals.items():
        if not runs:
            continue
        values = np.array([e['final_cm'] for e in runs.values()])
        times = [e['planning_ms'] for e in runs.values() if e['planning_ms'] is not None]
        table[mode] = {
            'mean_cm': float(values.mean()), 'standard_error_cm': standard_error(values),
            'success_5cm': float(np.mean([max(e['objects_cm']) < 5 for e in runs.values()])),
            'scenes': len(values), 'planning_ms': float(np.median(times)) if times else None}
        both = sorted(set(runs) & set(finals['direct']))
        if mode == 'subgoal' and both:
            gains = np.array([finals['direct'][s]['final_cm'] - runs[s]['final_cm'] for s in both])
            table[mode] |= {'gain_cm': float(gains.mean()),
                            'gain_standard_error_cm': standard_error(gains)}
    return table


def standard_error(values):
    """Return the standard error of a mean; 0 for a single value."""
    return float(values.std(ddof=1) / np.sqrt(len(values))) if len(values) > 1 else 0.0


def add_arguments(parser):
    """Add the options of `evaluate planning` to a parser."""
    parser.add_argument('--task', choices=list(TASKS), default='push2')
    parser.add_argument('--scenes', type=int, default=20, help='how many (default: %(default)s)')
    parser.add_argument('--seed', type=int, default=FIRST_SCENE,
                        help='of the first scene (default: %(default)s)')
    parser.add_argument('--modes', nargs='+', choices=MODES, default=list(MODES))
    parser.add_argument('--step-budget', type=int, default=0,
                        help="control periods; 0: the paper's for the task")
    parser.add_argument('--preset', choices=list(PRESETS), default='default',
                        help="settings of the planner; 'paper': the paper's")
    for name in ('forward_model', 'predictor'):
        parser.add_argument(f'--{name.split("_")[0]}-weights', metavar='FILE',
                            default=str(WEIGHTS / f'{name}_push.safetensors'))
    parser.add_argument('--device', default='cpu')
    parser.add_argument('--out', default='runs/planning.json',
                        help='results; an interrupted evaluation goes on (default: %(default)s)')


def run(args):
    """Evaluate, print a table, write JSON."""
    config = with_preset(args.preset)
    budget = args.step_budget or STEP_BUDGETS[args.task]
    mpc = VisualMPC.load(args.forward_weights, config, args.device)
    predictor = None
    if 'subgoal' in args.modes:
        predictor = SubgoalPredictor.load(args.predictor_weights, args.device)
    settings = {
        'task': args.task, 'step_budget': budget, 'preset': args.preset,
        'planner': asdict(config), 'forward_weights': args.forward_weights,
        'predictor_weights': args.predictor_weights, 'reached_px': REACHED,
        'object_pixels': 'ground truth at every step', 'arm': 'visible'}
    settings = json.loads(json.dumps(settings))
    simulator = Simulator(args.task, mpc.image_size[0])
    seeds = range(args.seed, args.seed + args.scenes)
    episodes = evaluate_planning(
        simulator, mpc, predictor, args.modes, seeds, budget, args.out, settings)
    print(f'{args.task}, {args.scenes} scenes, {budget} steps: mean final distance')
    for mode, row in summarise(episodes).items():
        gain = (f', {row["gain_cm"]:+.1f} +- {row["gain_standard_error_cm"]:.1f} cm over direct'
                if 'gain_cm' in row else '')
        speed = f', {row["planning_ms"]:.0f} ms a plan' if row['planning_ms'] else ''
        print(f'  {mode:8} {row["mean_cm"]:5.1f} +- {row["standard_error_cm"]:.1f} cm, '
              f'all within 5 cm: {row["success_5cm"]:.0%}{speed}{gain}')
    print(f'written: {args.out}')
