# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
One scene: pictures are brought about one after the other, by picking up and placing objects.

The executor is the simulator's own: it knows where the objects are and finds each grasp in the
true physics. A picture says which object goes where.
"""

from dataclasses import dataclass, field

from experiments.planning.episode import shown_mask
from experiments.planning.reading import Move, PictureReader, read_moves
import numpy as np
from sim_bridge.tasks.stack import on_table, pick_and_place
from sim_bridge.tasks.tasks import run_episode as run_expert
from tap_ros.base.contract import LIFTED, SUCCESS_DISTANCE
from tap_ros.base.errors import ConfigError
from tap_ros.images.robot_mask import FreeView

OVER = 0.045  # m; an object whose place is nearer to another one, from above, is put on that
ARRIVED = 0.01  # m from its last place, then an object of the expert's is where it goes
SETTLE_STEPS = 3  # control periods with the arm risen, then it counts where things are


@dataclass
class Stage:
    """One picture that was brought about."""

    picture: np.ndarray  # uint8 (H, W, 3)
    pixels: np.ndarray  # (K, 2), what was read from it; NaN: not seen
    moves: list  # Move, in the order in which they were made


@dataclass
class StackedEpisode:
    """What happened in one run."""

    start: object  # Observation
    goal: object  # Observation
    distances: np.ndarray  # (K,) m to the goals at the end, ground truth
    success: bool
    first_right: bool  # the first move was that of the object that has to be first, to its place
    stages: list = field(default_factory=list)  # Stage
    frames: list = field(default_factory=list)  # uint8 (H, W, 3), one a control period

    @property
    def moves(self):
        """Return all moves in the order in which they were made."""
        return [move for stage in self.stages for move in stage.moves]


def stack(simulator, method, seed, predictor=None):
    """Bring the pictures of a method about in one scene; return the StackedEpisode."""
    if method.predicted and predictor is None:
        raise ConfigError(f'method {method.name!r} needs a predictor; load one, or use direct')
    shown = _expert_subgoals(simulator, seed) if method.base == 'true_subgoals' else []
    start = simulator.reset(seed)
    goal, reader = simulator.goal(), PictureReader(simulator, start)
    if method.predicted:
        shown = _predict(predictor, method, start, goal, seed)
    pictures = [] if method.base == 'nothing' else [*shown, goal.image]
    # The same order for all methods that know none, so that they are compared scene by scene.
    stream = simulator.task.stream
    order = np.random.default_rng([seed, stream, 2]).permutation(simulator.task.num_objects)
    rng = np.random.default_rng([seed, stream, 3])
    stages, frames = [], [start.image]
    for picture in pictures:
        poses = simulator.object_poses()[:, :3]
        pixels = reader.read(picture, simulator.camera.project(poses))
        moves = read_moves(pixels, poses, simulator.camera)
        if method.base == 'true_places':
            places = simulator.scene.goal_poses[:, :2]
            moves = [Move(k, tuple(places[k].tolist())) for k in simulator.scene.order]
        elif method.base == 'oracle_order':
            moves.sort(key=lambda move: [*simulator.scene.order, move.object].index(move.object))
        elif method.base != 'lowest_first':
            moves.sort(key=lambda move: order.tolist().index(move.object))
        for move in moves:
            frames += _make(simulator, rng, move)
        stages.append(Stage(picture, pixels, moves))
    distances = simulator.distances()
    success = simulator.outcome() == 'success' and bool((distances < SUCCESS_DISTANCE).all())
    run = StackedEpisode(start, goal, distances, success, False, stages, frames)
    if run.moves:
        move, k = run.moves[0], simulator.scene.order[0]
        gap = np.linalg.norm(simulator.scene.goal_poses[k, :2] - move.place)
        run.first_right = bool(move.object == k and gap < SUCCESS_DISTANCE)
    return run


def _make(simulator, rng, move):
    """Make a move, rise and wait until all is at rest; return the pictures meanwhile."""
    frames = []
    for plan in pick_and_place(simulator, rng, move.object,
                               lambda poses: what_is_below(poses, move)):
        frames += [simulator.step(action).image for action in plan]
    rise = [[0, 0, max(LIFTED - simulator.target[2], 0), 1]]
    return frames + [simulator.step(action).image
                     for action in rise + [[0, 0, 0, 1]] * SETTLE_STEPS]


def what_is_below(poses, move):
    """Return (3,) m, the origin of the highest other object at a place, see also on_table."""
    place = np.array(move.place)
    others = np.delete(poses[:, :3], move.object, axis=0)
    under = others[np.linalg.norm(others[:, :2] - place, axis=1) < OVER]
    return under[under[:, 2].argmax()] if len(under) else on_table(place)


def _expert_subgoals(simulator, seed):
    """Return the frame of each object in which the expert has brought it to its place."""
    observations, *_ = run_expert(simulator, seed)
    places = np.array([seen.object_poses[:, :3] for seen in observations])  # (T, K, 3)
    there = np.linalg.norm(places - places[-1], axis=-1) < ARRIVED
    # argmax: the first one.
    return [observations[there[:, k].argmax()].image for k in simulator.scene.order]


def _predict(predictor, method, start, goal, seed):
    """Return the pictures of the predicted subgoals, the earliest first."""
    view = FreeView(shown_mask(predictor))
    pictures = [fill(seen.image, seen.robot_mask)
                for fill, seen in ((view.update, start), (view.fill, goal))]
    subgoals = predictor.predict(*pictures, recursion_depth=method.recursion, seed=seed)
    return [subgoal.image for subgoal in subgoals]
