# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""One scene of a loop that another world judges, by each of the methods that are compared."""

from functools import lru_cache
import io
from pathlib import Path
from typing import NamedTuple

from experiments.planning.episode import run_episode
from experiments.planning.methods import FIRST_SCENE, Method
import numpy as np
from PIL import Image
from sim_bridge.pushes import push_to_goal
from sim_bridge.world.protocol import make_world
from tap_ros.base.contract import ACTION_LIMIT, step_budget
from tap_ros.base.errors import SceneError
from tap_ros.images.crop import trained_crop
from tap_ros.images.drawing import enlarge
from tap_ros.messages.subgoals import Subgoal
from tap_ros.planning.action_sequences import FULL, Limits
from tap_ros.planning.mpc_config import VisualMPCConfig
from tap_ros.planning.protocols import SearchConfig
from tap_ros.planning.visual_mpc import VisualMPC
from tap_ros.prediction.nearest_keyframe import NearestKeyframe
from tap_ros.prediction.predictor import SubgoalPredictor
from tap_ros.prediction.protocol import Predictor
from tap_ros.prediction.warp import one_hot_maps
import torch

IMAGE_SIZE = 64
UNTRAINED = ('random', 'straight', 'around')  # methods that need nothing but the world
PLANNED = ('direct', 'places', 'retrieval', 'fixed time', 'subgoal')
WITH_WAYS = ('around', 'places')  # of tasks with subgoals that are put by hand
SUBGOALS = {'push-wall-v3': 2, 'ogbench/cube-double': 1}  # so many
BUDGETS = {'push-wall-v3': 55, 'ogbench/cube-double': 70}  # commands; else contract.step_budget
# Half of what is usual, so that a plan takes half the time.
PLANNER = VisualMPCConfig(SearchConfig(32, 2, 4), proposals=16, recheck=0, threads=1)
# px, here about cm: within this the object is at its goal, and at a subgoal. What is pushed slides
# on, by 2 to 5 cm; chosen in scenes 900000 to 900003, which do not count.
REACHED = {'push-wall-v3': (3.5, 6.0)}
# Low above the table its Sawyer reaches no farther.
REACHES = {'push-wall-v3': Limits(low=(-0.3, -0.2), high=(0.3, 0.2))}
USUAL = 2.0  # elsewhere, chosen in scenes 1000000 to 1000005, which do
ENDS = 'direct', 'subgoal', 'retrieval', 'places'  # that are drawn
FILM_SIZE, FRAME_MS, HOLD_MS = 256, 120, 3000  # pixels; of each picture, of the last one
STRIPS = 6  # scenes of each task whose actions and subgoals are kept, to draw them
SCALE = 2  # of pictures that are drawn


class Weights(NamedTuple):
    """What methods act by: files, '' for none."""

    forward: str = ''
    predictor: str = ''  # of this method
    keyframes: str = ''  # recordings and their marks, as NearestKeyframe.load takes them


class Judged:
    """A GymWorld, and what it says after every step; a name without a world is Meta-World's."""

    def __init__(self, name, image_size):
        world, _, task = name.rpartition('/')
        self.world = make_world(world or 'metaworld', task, image_size)

    def __getattr__(self, name):
        return getattr(self.world, name)

    def reset(self, seed):
        """Begin a scene."""
        self.said, self.actions = [], []
        return self.world.reset(seed)

    def step(self, action):
        """Act, and note."""
        seen = self.world.step(action)
        self.said.append(self.succeeds())
        self.actions.append(np.asarray(action))
        return seen


class Places(Predictor):
    """
    Subgoals that are put by hand: the objects on their route; the picture is the start.

    :param world: whose `route` it is, after a reset.
    """

    mode = 'bidirectional'

    def __init__(self, world):
        places, self.pixels = world.object_poses()[:, :3], []
        for k, place in world.route()[:-1]:
            places[k, :2] = place
            self.pixels.append(world.camera.project(places).astype(np.float32))
        self.image_size, self.training = (IMAGE_SIZE, IMAGE_SIZE), {}
        self.camera_crop = trained_crop(self.training, self.image_size)

    def predict_together(self, requests):
        """Answer requests."""
        return [[Subgoal(
            request.start, one_hot_maps(torch.from_numpy(at), self.image_size).numpy(), at,
            np.ones(len(at), np.float32), 0, len(self.pixels) - i)
            for i, at in enumerate(self.pixels)] for request in requests]


_world, _planner = lru_cache(Judged), lru_cache(VisualMPC.load)
_predictor, _keyframes = lru_cache(SubgoalPredictor.load), lru_cache(NearestKeyframe.load)


def run_scene(task, method, seed, weights, folder):
    """Run a method in a scene; return what came of it, None if the scene has no goal."""
    world = _world(task, IMAGE_SIZE)
    try:
        start, shown, switches = _act(world, task, method, seed, weights)
    except SceneError:
        return None
    kept = Path(folder, f'{method}_{seed}.npz')
    if seed < FIRST_SCENE + STRIPS and not kept.exists():  # of the first training
        np.savez(kept, actions=world.actions, shown=shown)
    goal = world.goal().object_poses[:, :3] - world.goal_places()
    return {'task': task, 'method': method, 'seed': seed, 'ends': bool(world.succeeds()),
            'ever': any(world.said), 'steps': len(world.said),
            'goal_cm': _cm(np.linalg.norm(goal, axis=1)), 'start_cm': _cm(start),
            'final_cm': _cm(world.distances()), 'switches': switches}


def _cm(metres):
    """Return the mean over objects (K,) m."""
    return round(100 * float(np.mean(metres)), 2)


def _act(world, task, method, seed, weights):
    """Act; return (K,) m at the start, pictures of start, subgoals, end, steps that went on."""
    budget = BUDGETS.get(task, step_budget(1))
    if method in PLANNED:
        def predictor():
            return {'places': lambda: Places(world), 'direct': lambda: None,
                    'retrieval': lambda: _keyframes(weights.keyframes)}.get(
                        method, lambda: _predictor(weights.predictor))()

        if method == 'places':
            world.reset(seed)
        ran = run_episode(
            world, _planner(weights.forward, PLANNER),
            Method(method.replace(' ', '_'), recursion=max(1, SUBGOALS.get(task, 0))), budget,
            seed, predictor(), REACHED.get(task, USUAL), REACHES.get(task, FULL))
        frames = ran.frames
        return ran.distances[0], [
            frames[0], *(subgoal.image for subgoal in ran.subgoals), frames[-1]], ran.switches
    last = first = world.reset(seed)
    distance, rng = world.distances(), np.random.default_rng(seed)
    actions = (np.append(rng.uniform(-1, 1, 3) * ACTION_LIMIT, 0) for _ in range(budget))
    if method != 'random':
        away = np.linalg.norm(first.object_poses[:, :2] - first.gripper[:2], axis=1)
        straight = [(k, world.goal_places()[k, :2]) for k in away.argsort()]
        actions = push_to_goal(world, route=world.route() if method == 'around' else straight)
    for _, action in zip(range(budget), actions):
        last = world.step(action)
    return distance, [first.image, last.image], []


def _kept(task, seed, folder, methods):
    """Return what is kept of a scene by methods; None where one is missing."""
    paths = [Path(folder, f'{method}_{seed}.npz') for method in methods]
    return [np.load(path) for path in paths] if all(map(Path.exists, paths)) else None


def draw_strip(task, seed, folder):
    """
    Draw a scene: the start, what is predicted, the ends of ENDS, the goal.

    :return: list of pictures, None if they are not kept.
    """
    kept = _kept(task, seed, folder, ENDS)
    if kept is None:
        return None
    world = _world(task, IMAGE_SIZE)
    world.reset(seed)
    shown = [each['shown'] for each in kept]
    return [enlarge(picture, SCALE) for picture in (
        *shown[ENDS.index('subgoal')][:-1], *(pictures[-1] for pictures in shown),
        world.goal().image)]


def film(task, seed, folder, methods):
    """Return an animated WebP of a scene, methods that are kept side by side; None as above."""
    kept = _kept(task, seed, folder, methods)
    if kept is None:
        return None
    world = _world(task, FILM_SIZE)
    films = [[world.reset(seed).image, *(world.step(action).image for action in each['actions'])]
             for each in kept]
    length = max(map(len, films))
    first, *others = (Image.fromarray(np.hstack([one[min(t, len(one) - 1)] for one in films]))
                      for t in range(length))
    buffer = io.BytesIO()
    first.save(buffer, 'webp', save_all=True, append_images=others, loop=0, quality=80,
               duration=[FRAME_MS] * (length - 1) + [HOLD_MS])
    return buffer.getvalue()
