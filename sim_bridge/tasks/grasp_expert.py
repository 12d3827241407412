# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
The expert that grasps: a cross-entropy method with the true simulator over where to (App. D).

A sample is a place of the gripper above the object; drop, close and lift follow from there in the
true physics, all samples at once. Of the places that lift the object, those near its centre are
a little better. Now and then a random place is taken, which may miss: such episodes are kept.
How fast the arm goes, how low and how high, and where it waits varies from episode to episode.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import mujoco
import mujoco.rollout
import numpy as np
from sim_bridge.simulator import OBJECT_QPOS_START, ramp_controls, Simulator
from sim_bridge.tasks.episode_run import carry_out, EpisodeRun
from sim_bridge.world.looks import GRIP_SPREAD
from tap_ros.contract import CLEAR, MOVE_LIMIT, WORKSPACE_HIGH, WORKSPACE_LOW

RANGE = 0.3  # m, |x| and |y| of the random walk, all in view
FAR = 0.22  # m, a start so far from the grasp that the first step cannot hit the object
LOST = 0.12  # m, an object whose origin is farther from the gripper is not held
OTHERS = 2.0  # cost of moving other objects, m per m
OFF_CENTRE = 0.2  # cost of a grasp beside the object's centre, m per m


@dataclass(frozen=True)
class GraspConfig:
    """How hard the expert searches, and how it varies."""

    num_samples: int = 20
    num_iterations: int = 2
    num_elites: int = 5
    explore: float = 0.1  # probability that a random place is taken instead of the best
    spread: tuple[float, float] = (0.03, 0.04)  # m along x and y around the origin, at first
    hover: tuple[float, float] = (0.1, 0.13)  # m, heights of the gripper before it drops,
    low: tuple[float, float] = (0.004, 0.018)  # when it grasps
    lift: tuple[float, float] = (0.12, 0.14)  # and how far it lifts
    hold: int = 2  # control periods that it stays closed at the place, if there is time
    travel_speed: tuple[float, float] = (0.035, 0.08)  # m per control period
    walk: tuple[int, int] = (1, 6)  # control periods of the random walk at the end
    wiggle: float = 0.035  # m per control period, of the random walk


class GraspExpert:
    """
    Plans one episode of grasping, or of picking and placing.

    :param simulator: Simulator, already reset.
    :param rng: numpy Generator; every whim of this expert comes from it.
    :param config: GraspConfig.
    :param rollout: mujoco.rollout.Rollout to share between episodes.
    :param held: index of the object that is to be grasped.
    :ivar hover: m, height of the gripper before it drops.
    """

    def __init__(self, simulator: Simulator, rng: np.random.Generator, config: GraspConfig,
                 rollout: mujoco.rollout.Rollout, held: int = 0) -> None:
        self.simulator, self._rng, self._config = simulator, rng, config
        self._rollout, self._held = rollout, held
        self._scratch = mujoco.MjData(simulator.model)  # rollouts overwrite it
        self.hover = rng.uniform(*config.hover)
        self._low = rng.uniform(*config.low)
        self._top = self._low + rng.uniform(*config.lift)
        self._drop_steps = int(rng.integers(1, 3))
        self._walk_steps = int(rng.integers(*config.walk, endpoint=True))
        # A grasp ends with the lift: it may be slow.
        self._lift_steps = int(rng.integers(*((2, 5) if simulator.task.lift else (1, 3))))

    def pick(self, steps_left: int) -> np.ndarray:
        """
        Plan to go to the object, grasp and lift it.

        :param steps_left: control periods until the episode ends.
        :return: (n, 4) actions.
        """
        here = self.simulator.target
        steps_left -= self._reserve(steps_left)
        place = self._search()
        # From afar the arm rises on the way.
        far = np.linalg.norm(place - here[:2]) > FAR
        rise = bool(here[2] < CLEAR - 0.02 and not far)
        travel, fastest = self._travel_steps(place - here[:2])
        fixed = rise + self._drop_steps + 1 + self._lift_steps
        travel = min(travel, max(steps_left - fixed, fastest))
        idle = int(self._rng.integers(0, 1 + max(min(steps_left - fixed - travel, 4), 0)))
        lift_steps = self._lift_steps
        if self.simulator.task.lift:
            # Up to the last frame: idle frames beside the goal picture would make copying perfect.
            lift_steps = max(steps_left - (fixed - lift_steps) - travel - idle, lift_steps)
        path = [here[:3]]
        if rise:
            path.append(np.append(here[:2], self.hover))
        above, below = np.append(place, self.hover), np.append(place, self._low)
        path += straight(path[-1], above, travel)
        if far:
            path[-travel:] = [np.append(point[:2], self.hover) for point in path[-travel:]]
        path += [above] * idle  # it waits above the object
        path += straight(above, below, self._drop_steps)
        opened = len(path) - 1
        path += [below] + straight(below, np.append(place, self._top), lift_steps)
        opening = np.zeros(len(path) - 1)
        opening[:opened] = 1
        return np.column_stack([np.diff(path, axis=0), opening])

    def pick_and_lift(self) -> np.ndarray:
        """
        Plan to go to an object among others, above which the gripper is, and lift it clear of all.

        :return: (n, 4) actions.
        """
        here = self.simulator.target
        place = self._search()
        travel, _ = self._travel_steps(place - here[:2])
        above, below = np.append(place, self.hover), np.append(place, self._low)
        path = [here[:3], *straight(here[:3], above, travel)]
        path += [above] * int(self._rng.integers(3))  # it waits above the object
        path += straight(above, below, self._drop_steps)
        opened = len(path) - 1
        path += [below, *straight(below, np.append(place, self._top), self._lift_steps)]
        opening = np.zeros(len(path) - 1)
        opening[:opened] = 1
        return np.column_stack([np.diff(path, axis=0), opening])

    def _reserve(self, steps_left: int) -> int:
        """Hurry if there is little time; return the control periods that placing will take."""
        simulator = self.simulator
        if simulator.task.kind != 'pick_place':
            return 0
        start, goal = simulator.object_poses()[0, :2], simulator.goal().object_poses[0, :2]
        # The grasp may be beside the origin, and the object may shift: 3 cm more.
        reach, carry = (self._travel_steps(np.abs(way) + 0.03)[1] for way in (
            start - simulator.target[:2], goal - start))
        fixed = reach + carry + 3  # close, open, leave
        for name in ('_walk_steps', '_lift_steps', '_drop_steps'):
            while getattr(self, name) > 1 and fixed + (
                    2 * self._drop_steps + self._lift_steps + self._walk_steps) > steps_left:
                setattr(self, name, getattr(self, name) - 1)
        return carry + self._drop_steps + self._config.hold + 2 + self._walk_steps

    def place(self, steps_left: int) -> np.ndarray:
        """
        Plan to carry the object to its goal, let go, leave and walk about.

        :param steps_left: control periods until the episode ends.
        :return: (n, 4) actions; they may not suffice to reach the goal.
        """
        simulator, rng = self.simulator, self._rng
        here = simulator.target[:3]
        gap = simulator.goal().object_poses[0, :2] - simulator.object_poses()[0, :2]
        end = np.clip(here[:2] + gap, WORKSPACE_LOW[:2], WORKSPACE_HIGH[:2])
        travel, fastest = self._travel_steps(end - here[:2])
        free = steps_left - self._drop_steps - 2 - self._walk_steps
        hold = int(np.clip(free - fastest, 0, self._config.hold))
        travel = min(travel, max(free - hold, fastest))
        above = np.append(end, here[2])
        below, leave = np.append(end, self._low + 0.003), np.append(end, self.hover)
        path = [here] + straight(here, above, travel) + straight(above, below, self._drop_steps)
        path += [below] * hold
        closed = len(path) - 1
        path += [below, leave]
        wiggle, reach = self._config.wiggle, RANGE * GRIP_SPREAD
        while len(path) <= steps_left:
            path.append(path[-1] + rng.normal(0, [wiggle, wiggle, wiggle / 3]))
            path[-1] = np.clip(path[-1], [-reach, -reach, CLEAR], [reach, reach, 0.14])
        opening = np.ones(len(path) - 1)
        opening[:closed] = 0
        return np.column_stack([np.diff(path, axis=0), opening])[:steps_left]

    def _travel_steps(self, way: np.ndarray) -> tuple[int, int]:
        """Draw how many control periods a way (2,) takes, and say how few would do."""
        fastest = max(int(np.ceil(np.abs(way).max() / MOVE_LIMIT)), 1)
        speed = self._rng.uniform(*self._config.travel_speed)
        return max(int(np.ceil(np.linalg.norm(way) / speed)), fastest), fastest

    def _search(self) -> np.ndarray:
        """Return the gripper's x and y, (2,) metres, for a grasp."""
        config, rng = self._config, self._rng
        origin = self.simulator.object_poses()[self._held, :2]
        mean, spread = origin, np.array(config.spread)
        explore = rng.random() < config.explore
        best_cost, best = np.inf, origin
        for _ in range(config.num_iterations):
            places = rng.normal(mean, spread, (config.num_samples, 2))
            places = np.clip(places, WORKSPACE_LOW[:2], WORKSPACE_HIGH[:2])
            if explore:
                return places[0]
            costs = self._costs(places)
            order = np.argsort(costs, kind='stable')[:config.num_elites]
            if costs[order[0]] < best_cost:
                best_cost, best = costs[order[0]], places[order[0]]
            mean, spread = places[order].mean(0), places[order].std(0) + 0.004
        return best

    def _costs(self, places: np.ndarray) -> np.ndarray:
        """Grasp at all places (N, 2) in the true simulator; return (N,) metres not lifted."""
        simulator = self.simulator
        lift = self._top - self._low
        grasp = self._drop_steps + 1
        actions = np.zeros((grasp + self._lift_steps + 1, 4))  # the last one holds still
        actions[:self._drop_steps, 2] = (self._low - self.hover) / self._drop_steps
        actions[:self._drop_steps, 3] = 1
        actions[grasp:-1, 2] = lift / self._lift_steps
        controls, _ = ramp_controls(np.array([0, 0, self.hover, 1]), actions)
        controls = np.tile(controls, (len(places), 1, 1))
        controls[..., :2] += places[:, None]
        states = np.tile(simulator.state(), (len(places), 1))
        states[:, 1:3], states[:, 3] = places, self.hover
        states[:, 4:6] = controls[:, :1, 3:].squeeze(1)
        ends, _ = self._rollout.rollout(simulator.model, self._scratch, states, controls)
        before = simulator.object_poses()[:, :3]
        after = ends[:, -1, 1 + OBJECT_QPOS_START:1 + simulator.model.nq].reshape(
            len(places), -1, 7)
        poses = after[:, self._held]
        lifted = poses[:, 2] - before[self._held, 2]
        moved = np.delete(np.linalg.norm(after[..., :3] - before, axis=-1), self._held, axis=1)
        lost = np.linalg.norm(poses[:, :2] - places, axis=1) > LOST
        upright = 1 - 2 * (poses[:, 4] ** 2 + poses[:, 5] ** 2)
        # What is lifted but for a centimetre is as good as can be: then the centre decides.
        return lift - np.clip(lifted, 0, lift - 0.01) + 0.1 * (
            (upright < 0.95) | lost) + OTHERS * moved.sum(1) + OFF_CENTRE * np.linalg.norm(
                places - before[self._held, :2], axis=1)


def straight(start: np.ndarray, end: np.ndarray, steps: int) -> list[np.ndarray]:
    """Return the points after start on a straight way of so many steps."""
    return [start + share * (end - start) for share in np.linspace(0, 1, steps + 1)[1:]]


def run_grasp_episode(
        simulator: Simulator, seed: int, config: GraspConfig | None = None,
        rollout: mujoco.rollout.Rollout | None = None, num_frames: int = 0) -> EpisodeRun:
    """
    Run one episode of exactly num_frames frames; 0: as many as the task has.

    :param simulator: Simulator of a task with a grasp.
    :param seed: of the scene and of the expert.
    :param config: GraspConfig.
    :param rollout: mujoco.rollout.Rollout to share between episodes, or None.
    :return: EpisodeRun.
    """
    first = simulator.reset(seed)
    rng = np.random.default_rng([seed, simulator.task.stream, 1])
    expert = GraspExpert(
        simulator, rng, config or GraspConfig(), rollout or mujoco.rollout.Rollout(nthread=0))
    num_frames = num_frames or simulator.task.num_frames
    return carry_out(simulator, first, _plans(expert, num_frames), num_frames)


def _plans(expert: GraspExpert, num_frames: int) -> Iterator[np.ndarray]:
    """Yield the actions of one episode; each waits until those before are carried out."""
    simulator, steps_left = expert.simulator, num_frames - 1
    for plan in (expert.pick, expert.place)[:1 + (simulator.task.kind == 'pick_place')]:
        actions = plan(steps_left)
        yield actions
        steps_left -= len(actions)
    yield np.tile([0, 0, 0, simulator.target[3]], (max(steps_left, 0), 1))  # hold still
