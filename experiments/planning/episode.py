# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
One scene, planned and pushed in one process.

The loop is that of visual_mpc_node, planning/reach.py, with the same seeds, so that both act the
same.
"""

from dataclasses import dataclass

from experiments.planning.following import Follower
import numpy as np
from tap_ros.base.contract import GOAL_TOLERANCE
from tap_ros.base.errors import ConfigError, TrackingError
from tap_ros.images.robot_mask import FreeView, trained_robot_mask
from tap_ros.planning.action_sequences import DOWN, FULL
from tap_ros.planning.cost import BLOCKED
from tap_ros.planning.hierarchy import choose_sample, Target, targets_by
from tap_ros.planning.reach import End, Observation, Reach, ReachConfig, SelectTargets
from tap_ros.planning.visual_mpc import Memory, Scene, SHORT


@dataclass
class PlannedEpisode:
    """What happened in one run."""

    distances: np.ndarray  # (steps + 1, K) metres from each object to its goal, ground truth
    observations: list  # steps + 1 Observations
    actions: np.ndarray  # (steps, 4)
    planning_ms: np.ndarray  # (steps,)
    goal: object  # Observation
    targets: list  # Target, the goal last
    switches: list  # steps at which the second, third ... target began
    tracked: np.ndarray  # (steps + 1, K, 2) pixels that the planner was given
    subgoals: list  # prediction.predictor.Subgoal
    placed: list  # names of objects that had to be clicked in the goal picture
    refused: str  # why nothing was planned: a click was of no use; '' if it was
    aborted: str  # why the loop gave up before the goal or the end of its budget, '' if not

    @property
    def frames(self):
        """Return the steps + 1 pictures uint8 (H, W, 3)."""
        return [seen.image for seen in self.observations]

    def tracking_error(self):
        """Return the mean distance in pixels from what the planner was given to the truth."""
        true = np.array([seen.object_pixels for seen in self.observations])
        return float(np.linalg.norm(self.tracked - true, axis=-1).mean())

    def blocked(self):
        """Return how many descents met something at one place, at most."""
        hand = np.array([seen.gripper[:3] for seen in self.observations])
        missing = hand[1:, 2] - hand[:-1, 2] - self.actions[:, 2]
        met = (self.actions[:, 2] < 0) & (hand[1:, 2] > DOWN) & (missing > SHORT)
        places = hand[1:][met, :2]
        near = np.linalg.norm(places[:, None] - places, axis=-1) < BLOCKED
        return int(near.sum(1).max(initial=0))


def run_episode(simulator, mpc, method, step_budget, seed, predictor=None,
                reached=GOAL_TOLERANCE, limits=FULL):
    """
    Push the objects of one scene.

    :param mpc: VisualMPC, with the forward model that the method names.
    :param predictor: SubgoalPredictor, for methods that predict.
    :param reached: px, mean over objects; nearer than this is there, 0: never. Or of the goal and
        of subgoals, (2,).
    :param limits: action_sequences.Limits of the arm.
    :return: PlannedEpisode.
    """
    if method.predicted and predictor is None:
        raise ConfigError(f'method {method.name!r} needs a predictor; load one, or use direct')
    start = seen = simulator.reset(seed)
    goal = simulator.goal()
    view = FreeView(getattr(mpc.model, 'robot_mask', 'none'))
    asked = FreeView(shown_mask(predictor) if method.predicted else 'none')
    subgoals, refused, aborted = [], '', ''
    reached, passed = np.broadcast_to(reached, 2).tolist()
    reach = Reach(mpc, ReachConfig(
        step_budget, method.switch, reached, limits, rounds=method.rounds, passed=passed), seed)
    observations, distances, actions, times = [seen], [simulator.distances()], [], []
    tracked, states, true_goal, follower = [], (), goal, None
    if method.tracking != 'ground_truth':
        follower = Follower(method.tracking, simulator)
        try:
            seen, states = follower.select(seen, seed)
            goal = follower.find(goal)
        except TrackingError as error:
            refused = str(error)
    while method.base != 'nothing' and not refused:
        tracked.append(seen.object_pixels)
        shown, start_picture = (each.update(seen.image, seen.robot_mask) for each in (view, asked))
        looked = Observation(shown, seen.gripper, tuple(seen.object_names), seen.object_pixels,
                             seen.stamp_ns, states=states)
        answer = reach.step(looked)
        while isinstance(answer, SelectTargets):
            pictures = start_picture, asked.fill(goal.image, goal.robot_mask), shown
            targets, found = make_targets(
                simulator, mpc, method, seen, goal, predictor, seed, pictures)
            subgoals += found
            reach.set_targets(targets)
            answer = reach.step(looked)
        if isinstance(answer, End):
            aborted = answer.message if answer.outcome == 'aborted' else ''
            break
        seen = simulator.step(answer.plan.action)
        reach.sent()
        observations.append(seen)
        if follower is not None:
            seen, states = follower.see(seen)
        distances.append(simulator.distances())
        actions.append(answer.plan.action)
        times.append(answer.plan.planning_ms)
    return PlannedEpisode(
        np.array(distances), observations, np.array(actions).reshape(-1, 4), np.array(times),
        true_goal, reach.targets or [Target(goal.object_pixels)], reach.switches,
        np.array(tracked or [start.object_pixels]), subgoals,
        follower.placed if follower else [], refused, aborted)


def shown_mask(predictor):
    """Return what robot_mask the pictures for a predictor are filled with."""
    robot_mask, share = trained_robot_mask(predictor.training)
    return robot_mask if share else 'none'


def make_targets(simulator, mpc, method, seen, goal, predictor, seed, pictures=()):
    """
    Decide what is planned to from what is seen, at the start of each round.

    :param pictures: for methods that predict, uint8 (H, W, 3), filled as each network was
        trained: of the start and of the goal for the predictor, of now for the planner's model.
    :return: list of Target, the goal last, and the list of the Subgoals that were predicted.
    """
    start, end = seen.object_pixels, goal.object_pixels
    last = Target(end)
    if method.predicted:
        first, last_picture, now = pictures
        found = predictor.predict(
            first, last_picture, start, end, num_samples=method.samples,
            recursion_depth=method.recursion, seed=seed)
        subgoals = choose_sample(
            mpc, Scene(now, seen.gripper, start), end, found,
            lambda *leg: mpc.plan(*leg, Memory(seed)))
        return targets_by(subgoals, start, end), subgoals
    if method.base not in ('oracle_order', 'true_subgoal'):
        return [last], []
    order = simulator.scene.order
    K, n = len(order), method.recursion
    if method.base == 'oracle_order':
        later = [np.isin(np.arange(K), order[i + 1:]) for i in range(K - 1)]
        return [*(Target(end, free=free) for free in later), last], []
    moved = [order[:max(1, i * K // (n + 1))] for i in range(1, n + 1)]
    return [*(Target(np.where(np.isin(np.arange(K), done)[:, None], end, start))
              for done in moved), last], []
