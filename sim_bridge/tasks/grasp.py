# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Grasping one object, or picking and placing it: shapes, scenes, goals, and the expert (App. D).

To grasp is to lift the object from where it stands; to pick and place is to carry it to a place
within 0.2 m of the middle, with the arm starting about 0.3 m from it. The fingers close along x
and the gripper cannot turn, so an object is held by a part that lies nearly along y; closing the
fingers turns that part quite along y.

The expert is a cross-entropy method with the true simulator over where to grasp. A sample is a
place of the gripper above the object; drop, close and lift follow from there in the true physics,
all samples at once. Of the places that lift the object, those near its centre are a little better.
Now and then a random place is taken, which may miss: such episodes are kept. How fast the arm
goes, how low and how high, and where it waits varies from episode to episode.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from sim_bridge.tasks.motions import carry_out, direction, EpisodeRun, moves, straight
from sim_bridge.tasks.tasks import DemonstrationOptions, Task, TaskScene
from sim_bridge.world.looks import GRIP_SPREAD
from sim_bridge.world.protocol import Observation
from sim_bridge.world.scene import (
    FINGER_GAP,
    FINGER_TRAVEL,
    HALF_HEIGHT,
    ObjectShape,
    random_shape,
)
from sim_bridge.world.table import GRIPPER_HEIGHT, objects_in, ramp_controls, Table, upright
from tap_ros.base.contract import (
    CLEAR,
    MOVE_LIMIT,
    SUCCESS_DISTANCE,
    WORKSPACE_HIGH,
    WORKSPACE_LOW,
)
from tap_ros.base.search import cross_entropy

GRASP_YAW = 0.45  # rad, largest angle between y and the part to be held
FINGER_DEPTH = 0.022  # m, thickness of a finger and a little room
FINGER_HALF_WIDTH = 0.02  # m, along y
GRASP_RANGE = 0.2  # m, |x| and |y| of the start of an object to be grasped
GRASP_REACH_RANGE = 0.3  # m, |x| and |y| of the gripper's start before a grasp, all in view
PLACE_RANGE = 0.2  # m, |x| and |y| of the place where a picked object goes
PLACE_DISTANCE = (0.12, 0.36)  # m, from the start of an object to its place
LIFT_HEIGHT = 0.11  # m, of the goal of a grasp
GRASP_HEIGHT = 0.012  # m of the gripper when it holds an object on the table, in the goal picture
LEAVE_HEIGHT = 0.12  # m of the gripper when it has put the object down, in the goal picture
RANGE = 0.3  # m, |x| and |y| of the random walk, all in view
FAR = 0.22  # m, a start so far from the grasp that the first step cannot hit the object
LOST = 0.12  # m, an object whose origin is farther from the gripper is not held
OTHERS = 2.0  # cost of moving other objects, m per m
OFF_CENTRE = 0.2  # cost of a grasp beside the object's centre, m per m


@dataclass(frozen=True)
class GraspTask(Task):
    """
    Lift the object.

    :param reach: m, nearest and farthest start of the gripper from the object.
    """

    reach: tuple[float, float]
    kind: ClassVar[str] = 'grasp'
    gripping: ClassVar[bool] = True
    photographed: ClassVar[bool] = False
    lifts: ClassVar[bool] = True  # the object is to be in the fingers at the end; else let go

    def draw(self, rng: np.random.Generator, spread: float) -> TaskScene:
        """Draw one object that can be held; its goal is lifted, or elsewhere."""
        shape = random_shape(rng, thin=True)
        yaw = graspable_yaw(shape, rng)
        start = goal = spread * rng.uniform(-GRASP_RANGE, GRASP_RANGE, 2)
        nearest, farthest = np.multiply(PLACE_DISTANCE, spread)
        while not (self.lifts or nearest <= np.linalg.norm(goal - start) <= farthest):
            goal = spread * rng.uniform(-PLACE_RANGE, PLACE_RANGE, 2)
        gripper = np.full(2, np.inf)
        while (np.abs(gripper) > spread * GRASP_REACH_RANGE).any():
            angle = rng.uniform(0, 2 * np.pi)
            gripper = start + spread * rng.uniform(*self.reach) * direction(angle)
        return TaskScene((shape,), np.array([[*start, yaw]]),
                         np.array([[*goal, grasp_place(shape, yaw)[1]]]),
                         np.append(gripper, rng.uniform(0, GRIPPER_HEIGHT)), (0,))

    @property
    def goal_heights(self) -> float:
        """Return how high the object is lifted, or 0: it stands on the table."""
        return LIFT_HEIGHT if self.lifts else 0.0

    def goal_gripper(self, table: Table, scene: TaskScene) -> np.ndarray:
        """Return where the gripper holds the lifted object, or is above what it put down."""
        place, _, half_gap = grasp_place(scene.shapes[0], scene.start_poses[0, 2])
        height, opening = LEAVE_HEIGHT, 1
        if self.lifts:
            height = LIFT_HEIGHT + GRASP_HEIGHT
            opening = (half_gap - FINGER_GAP) / FINGER_TRAVEL
        return np.array([*scene.goal_poses[0, :2] + place, height, opening])

    def succeeds(self, table: Table) -> bool:
        """Return whether the fingers hold it SUCCESS_DISTANCE high, or it is so near its goal."""
        if not self.lifts:
            return super().succeeds(table)
        high = table.object_poses()[:, 2] - HALF_HEIGHT > SUCCESS_DISTANCE
        return bool(high.all() and table.touching())

    def demonstrate(self, table: Table, scene: TaskScene, first: Observation,
                    rng: np.random.Generator, how: DemonstrationOptions) -> EpisodeRun:
        """Act for exactly so many frames."""
        expert = GraspExpert(table, rng, lifts=self.lifts)
        num_frames = how.num_frames or self.num_frames
        return carry_out(table, self.succeeds, first, expert.plans(num_frames), num_frames)


@dataclass(frozen=True)
class PickPlaceTask(GraspTask):
    """Carry the object elsewhere and let go of it."""

    kind: ClassVar[str] = 'pick_place'
    lifts: ClassVar[bool] = False


GRASP = GraspTask('grasp', num_objects=1, num_frames=15, stream=4, reach=(0.13, 0.32))
PICK_PLACE = PickPlaceTask(
    'pick_place', num_objects=1, num_frames=20, stream=5, reach=(0.27, 0.33))


def graspable_yaw(shape: ObjectShape, rng: np.random.Generator) -> float:
    """Draw a yaw with which some part of the shape lies nearly along y; radians."""
    if shape.kind == 'disc':
        return rng.uniform(0, 2 * np.pi)
    # The two parts of an L or T are at right angles: one of them fits at any quarter turn.
    quarters = 2 * rng.integers(2) if shape.kind == 'bar' else rng.integers(4)
    return (quarters * np.pi / 2 + rng.uniform(-GRASP_YAW, GRASP_YAW)) % (2 * np.pi)


def grasp_place(shape: ObjectShape, yaw: float) -> tuple[np.ndarray, float, float]:
    """
    Find a place where the fingers can hold an object that stands with this yaw.

    :param shape: ObjectShape.
    :param yaw: radians.
    :return: (2,) gripper x, y relative to the object's origin in metres, the yaw that the object
        has when held, and half the gap between the fingers in metres.
    """
    if shape.kind == 'disc':
        return np.zeros(2), yaw, shape.half_sizes[0][0]
    sizes = np.array(shape.half_sizes)[:, :2]
    angles = yaw - np.where(sizes[:, 0] > sizes[:, 1], np.pi / 2, 0)  # of the parts, from y
    angles = (angles + np.pi / 2) % np.pi - np.pi / 2
    held = int(np.abs(angles).argmin())
    yaw = yaw - angles[held]
    turn = np.array([[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]])
    centres, sizes = np.array(shape.centres) @ turn.T, np.abs(sizes @ turn.T)
    half_gap, length = sizes[held]
    places = centres[held, 1] + np.linspace(-length, length, 41)
    free = np.ones(len(places), bool)
    for k in {*range(len(centres))} - {held}:
        low, high = centres[k] - sizes[k], centres[k] + sizes[k]
        for sign in (-1, 1):
            edges = centres[held, 0] + sign * np.array([half_gap, half_gap + FINGER_DEPTH])
            if edges.max() > low[0] + 1e-6 and edges.min() < high[0] - 1e-6:
                free &= (places + FINGER_HALF_WIDTH <= low[1]) | (
                    places - FINGER_HALF_WIDTH >= high[1])
    places = places[free] if free.any() else places
    y = places[np.abs(places).argmin()]  # nearest to the centre of mass
    return np.array([centres[held, 0], y]), yaw, half_gap


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

    :param table: Table with a scene.
    :param rng: numpy Generator; every whim of this expert comes from it.
    :param config: GraspConfig; None: the usual one.
    :param held: index of the object that is to be grasped.
    :param lifts: the episode ends with the lift.
    :ivar hover: m, height of the gripper before it drops.
    """

    def __init__(self, table: Table, rng: np.random.Generator, config: GraspConfig | None = None,
                 held: int = 0, lifts: bool = False) -> None:
        self._config = config = config or GraspConfig()
        self.table, self._rng, self.lifts, self._held = table, rng, lifts, held
        self.hover = rng.uniform(*config.hover)
        self._low = rng.uniform(*config.low)
        self._top = self._low + rng.uniform(*config.lift)
        self._drop_steps = int(rng.integers(1, 3))
        self._walk_steps = int(rng.integers(*config.walk, endpoint=True))
        # A grasp ends with the lift: it may be slow.
        self._lift_steps = int(rng.integers(*((2, 5) if lifts else (1, 3))))

    def plans(self, num_frames: int) -> Iterator[np.ndarray]:
        """Yield the actions (n, 4) of an episode; each waits until those before are done."""
        steps_left = num_frames - 1
        for plan in (self._pick, self._place)[:1 if self.lifts else 2]:
            actions = plan(steps_left)
            yield actions
            steps_left -= len(actions)
        yield np.tile([0, 0, 0, self.table.target[3]], (max(steps_left, 0), 1))  # hold still

    def _pick(self, steps_left: int) -> np.ndarray:
        """Plan to go to the object, grasp and lift it; so many control periods are left."""
        here = self.table.target
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
        if self.lifts:
            # Up to the last frame: idle frames beside the goal picture would make copying perfect.
            lift_steps = max(steps_left - (fixed - lift_steps) - travel - idle, lift_steps)
        path = [here[:3], *[np.append(here[:2], self.hover)] * rise]
        way = straight(path[-1], np.append(place, self.hover), travel)
        path += [np.append(point[:2], self.hover) for point in way] if far else way
        return self._close_and_lift(path, place, idle, lift_steps)

    def pick_and_lift(self) -> np.ndarray:
        """
        Plan to go to an object among others, above which the gripper is, and lift it clear of all.

        :return: (n, 4) actions.
        """
        here, place = self.table.target, self._search()
        travel, _ = self._travel_steps(place - here[:2])
        path = [here[:3], *straight(here[:3], np.append(place, self.hover), travel)]
        return self._close_and_lift(path, place, int(self._rng.integers(3)), self._lift_steps)

    def _close_and_lift(self, path: list[np.ndarray], place: np.ndarray, idle: int,
                        lift_steps: int) -> np.ndarray:
        """Go on from the end of a path above an object's place (2,): wait, drop, close, lift."""
        above, below, top = (np.append(place, z) for z in (self.hover, self._low, self._top))
        path = [*path, *[above] * idle, *straight(above, below, self._drop_steps)]
        return moves([*path, below, *straight(below, top, lift_steps)], opened=len(path) - 1)

    def _reserve(self, steps_left: int) -> int:
        """Hurry if there is little time; return the control periods that placing will take."""
        if self.lifts:
            return 0
        table = self.table
        start, goal = table.object_poses()[0, :2], table.goal_poses[0, :2]
        # The grasp may be beside the origin, and the object may shift: 3 cm more.
        reach, carry = (self._travel_steps(np.abs(way) + 0.03)[1] for way in (
            start - table.target[:2], goal - start))
        fixed = reach + carry + 3  # close, open, leave
        for name in ('_walk_steps', '_lift_steps', '_drop_steps'):
            while getattr(self, name) > 1 and fixed + (
                    2 * self._drop_steps + self._lift_steps + self._walk_steps) > steps_left:
                setattr(self, name, getattr(self, name) - 1)
        return carry + self._drop_steps + self._config.hold + 2 + self._walk_steps

    def _place(self, steps_left: int) -> np.ndarray:
        """Plan to carry the object towards its goal, let go, leave and walk about."""
        table, rng = self.table, self._rng
        here = table.target[:3]
        gap = table.goal_poses[0, :2] - table.object_poses()[0, :2]
        end = np.clip(here[:2] + gap, WORKSPACE_LOW[:2], WORKSPACE_HIGH[:2])
        travel, fastest = self._travel_steps(end - here[:2])
        free = steps_left - self._drop_steps - 2 - self._walk_steps
        hold = int(np.clip(free - fastest, 0, self._config.hold))
        travel = min(travel, max(free - hold, fastest))
        above, below, leave = (
            np.append(end, z) for z in (here[2], self._low + 0.003, self.hover))
        path = [here, *straight(here, above, travel), *straight(above, below, self._drop_steps),
                *[below] * hold]
        closed = len(path) - 1
        path += [below, leave]
        wiggle, reach = self._config.wiggle, RANGE * GRIP_SPREAD
        while len(path) <= steps_left:
            path.append(np.clip(path[-1] + rng.normal(0, [wiggle, wiggle, wiggle / 3]),
                                [-reach, -reach, CLEAR], [reach, reach, 0.14]))
        return moves(path, closed=closed)[:steps_left]

    def _travel_steps(self, way: np.ndarray) -> tuple[int, int]:
        """Draw how many control periods a way (2,) takes, and say how few would do."""
        fastest = max(int(np.ceil(np.abs(way).max() / MOVE_LIMIT)), 1)
        speed = self._rng.uniform(*self._config.travel_speed)
        return max(int(np.ceil(np.linalg.norm(way) / speed)), fastest), fastest

    def _search(self) -> np.ndarray:
        """Return the gripper's x and y, (2,) metres, for a grasp."""
        config, rng = self._config, self._rng
        origin = self.table.object_poses()[self._held, :2]

        def draw(elites: np.ndarray | None) -> np.ndarray:
            mean, spread = origin, np.array(config.spread)
            if elites is not None:
                mean, spread = elites.mean(0), elites.std(0) + 0.004
            places = rng.normal(mean, spread, (config.num_samples, 2))
            return np.clip(places, WORKSPACE_LOW[:2], WORKSPACE_HIGH[:2])

        if rng.random() < config.explore:
            return draw(None)[0]
        best, _ = cross_entropy(draw, self._costs, config.num_iterations, config.num_elites)
        return best[0]

    def _costs(self, places: np.ndarray) -> np.ndarray:
        """Grasp at all places (N, 2) in the true simulator; return (N,) metres not lifted."""
        table, held, lift = self.table, self._held, self._top - self._low
        grasp = self._drop_steps + 1
        actions = np.zeros((grasp + self._lift_steps + 1, 4))  # the last one holds still
        actions[:self._drop_steps, 2] = (self._low - self.hover) / self._drop_steps
        actions[:self._drop_steps, 3] = 1
        actions[grasp:-1, 2] = lift / self._lift_steps
        controls, _ = ramp_controls(np.array([0, 0, self.hover, 1]), actions)
        controls = np.tile(controls, (len(places), 1, 1))
        controls[..., :2] += places[:, None]
        states = np.tile(table.state(), (len(places), 1))
        states[:, 1:3], states[:, 3], states[:, 4:6] = places, self.hover, controls[:, 0, 3:]
        after = objects_in(table.rollout(states, controls)[:, -1], table.model)
        before, poses = table.object_poses()[:, :3], after[:, held]
        moved = np.delete(np.linalg.norm(after[..., :3] - before, axis=-1), held, axis=1)
        lost = np.linalg.norm(poses[:, :2] - places, axis=1) > LOST
        # What is lifted but for a centimetre is as good as can be: then the centre decides.
        return lift - np.clip(poses[:, 2] - before[held, 2], 0, lift - 0.01) + 0.1 * (
            (upright(poses) < 0.95) | lost) + OTHERS * moved.sum(1) + OFF_CENTRE * np.linalg.norm(
                places - before[held, :2], axis=1)
