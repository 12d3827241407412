# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
What the search varies: a few displacements, each repeated, and for how long the gripper is lifted.

A sequence of HORIZON actions is made of segments of REPEAT control periods. Parameters (D,)
are x, y of every segment in metres per control period, the number of segments to stay lifted and
the phase, how much shorter the first segment is: so a way may take any number of periods, and a
plan goes on inside a segment one period later. Like the expert that was recorded, the arm goes up
and down on the spot and pushes slowly: what the forward model has never seen, it cannot foresee.

Random displacements seldom touch an object. push_proposals goes behind one as seen from its goal,
and pushes it through.
"""

from dataclasses import dataclass
from functools import lru_cache
from itertools import product

import numpy as np
from numpy.typing import ArrayLike
from tap_ros.base.contract import (
    ACTION_LIMIT,
    CLIMB_LIMIT,
    LIFTED,
    LOW,
    MOVE_LIMIT,
    WORKSPACE_HIGH,
    WORKSPACE_LOW,
)

SEGMENTS = 5  # displacements within the horizon
REPEAT = 3  # control periods of each
HORIZON = SEGMENTS * REPEAT  # control periods
MOVES = SEGMENTS + 1  # displacements that the horizon touches
SIZE = 2 * MOVES + 2  # D
MAX_LIFT = 4  # segments, at most, that the gripper travels lifted before it goes down
FIRST_STD = 0.04  # m per control period, of x and y in the first Gaussian
PUSH_LIMIT = 0.05  # m per control period, of a displacement while the gripper is low
PACE = 0.9  # of the limits is used by proposals, so that the search can still add to it
VERTICAL = 0.06  # m, a change of height beyond which the arm does not move sideways meanwhile
TURNS = 0.2, 0.8  # rad, from the way to the goal to that of a push; where it begins out of reach
DOWN = LOW + 0.02  # m; a gripper that is not lifted and higher than this stands upon something
UP = LIFTED - 0.03  # m; one that is higher than this is lifted


@dataclass(frozen=True)
class Limits:
    """How far the arm may move in one control period, and where; the contract's hold anyway."""

    move: float = MOVE_LIMIT  # |x| and |y|, m
    climb: float = CLIMB_LIMIT  # |z|, m
    low: tuple[float, float] = WORKSPACE_LOW[:2]  # x, y of the gripper, m, least
    high: tuple[float, float] = WORKSPACE_HIGH[:2]  # greatest

    def __post_init__(self) -> None:
        for name, value in (
                ('move', min(self.move, MOVE_LIMIT)), ('climb', min(self.climb, CLIMB_LIMIT)),
                ('low', tuple(map(max, self.low, WORKSPACE_LOW))),
                ('high', tuple(map(min, self.high, WORKSPACE_HIGH)))):
            object.__setattr__(self, name, value)

    def shorten(self, move: np.ndarray, here: np.ndarray) -> np.ndarray:
        """
        Return as much of a move as leads not out of the workspace, and no farther out.

        :param move: (..., 2) m; here: (..., 2) m, where it begins.
        """
        wanted = here + move
        end = wanted.clip(np.minimum(self.low, here), np.maximum(self.high, here))
        return np.asarray(move + (end - wanted))


FULL = Limits()
# The ways to be lifted, as (segments, phase), the shortest first.
LIFTS = sorted(product(range(1, MAX_LIFT + 1), range(REPEAT)),
               key=lambda way: REPEAT * way[0] - way[1])


class SequenceShape:
    """
    How parameters become actions.

    :param limits: of the arm.
    """

    def __init__(self, limits: Limits = FULL) -> None:
        self.limits, self.move_limit, self.climb_limit = limits, limits.move, limits.climb
        self.push_limit = min(limits.move, PUSH_LIMIT)

    def inside(self, places: np.ndarray) -> np.ndarray:
        """Return places (..., 2) m, those outside the workspace at its edge."""
        return places.clip(self.limits.low, self.limits.high)

    def first_gaussian(self) -> tuple[np.ndarray, np.ndarray]:
        """Return mean and deviation (D,) to begin a search with."""
        counts, still = np.array([MAX_LIFT, REPEAT - 1]) / 2, np.zeros(2 * MOVES)
        return np.append(still, counts), np.append(still + FIRST_STD, counts)

    def clip(self, parameters: np.ndarray, least_lift: int = 0) -> np.ndarray:
        """
        Limit parameters (N, D) to what the arm may do; lift and phase become whole numbers.

        :param least_lift: segments to stay lifted at least.
        """
        moves, counts = np.split(parameters, [2 * MOVES], axis=1)
        counts = np.clip(np.rint(counts), [least_lift, 0], [MAX_LIFT, REPEAT - 1])
        return np.hstack([np.clip(moves, -self.move_limit, self.move_limit), counts])

    def least_lift(self, height: float) -> int:
        """
        Return how many segments the gripper has to be lifted at least.

        Neither low nor lifted, it stands upon something: then it must go up before it can push.
        Where it takes several periods to come down, it passes these heights every time.
        """
        return int(self.climb_limit >= LIFTED - LOW and DOWN < height < UP)

    def climbs(self, lifted: np.ndarray, phase: np.ndarray,
               height: float) -> tuple[np.ndarray, np.ndarray]:
        """
        Plan the heights.

        :param lifted: (N,) segments; phase: (N,); height: of the gripper now, m.
        :return: climb (N, HORIZON) m per control period, and whether the arm may move sideways.
        """
        heights = np.where(segments(phase) < lifted[:, None], LIFTED, LOW)
        missing, climb = np.empty(heights.shape), np.empty(heights.shape)
        now = np.full(len(lifted), height, float)
        for t in range(HORIZON):
            missing[:, t] = heights[:, t] - now
            climb[:, t] = np.clip(missing[:, t], -self.climb_limit, self.climb_limit)
            now = now + climb[:, t]
        near = min(VERTICAL, max(self.climb_limit, 0.02))  # slow ones wait until it is done
        return climb, np.abs(missing) < near

    def actions(self, parameters: np.ndarray, gripper: np.ndarray) -> np.ndarray:
        """
        Expand parameters (N, D) to actions (N, HORIZON, 4), float32, gripper closed (0).

        None leads out of the workspace, or farther out.

        :param gripper: (4,) m, now.
        """
        moves, lifted, phase = split(parameters)
        climb, sideways = self.climbs(lifted, phase, gripper[2])
        segment = segments(phase)
        actions = np.zeros((len(parameters), HORIZON, 4), np.float32)
        actions[..., :2] = moves[np.arange(len(moves))[:, None], segment] * sideways[..., None]
        actions[..., 2] = climb
        length = np.linalg.norm(actions[..., :2], axis=-1)
        low = segment >= lifted[:, None]
        slow = np.minimum(1, self.push_limit / np.maximum(length, 1e-9))
        actions[..., :2] *= np.where(low, slow, 1)[..., None]
        here = np.broadcast_to(gripper[:2], actions[:, 0, :2].shape)
        for move in actions[..., :2].swapaxes(0, 1):
            move[:] = self.limits.shorten(move, here)
            here = here + move
        return actions

    def rise(self, gripper: np.ndarray) -> np.ndarray:
        """Return actions (HORIZON, 4) that lift the gripper (4,) on the spot."""
        still = np.array([0.0] * 2 * MOVES + [SEGMENTS, 0])
        return self.actions(still[None], gripper)[0]


def split(parameters: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return displacements (N, MOVES, 2), the lifted segments and the phases, ints (N,)."""
    moves = parameters[:, :2 * MOVES].reshape(len(parameters), MOVES, 2)
    counts = np.rint(parameters[:, 2 * MOVES:]).astype(int)
    return moves, counts[:, 0], counts[:, 1]


def join(moves: np.ndarray, lifted: int, phase: int) -> np.ndarray:
    """Return the parameters (D,) of displacements (M, 2) or fewer, the others standing."""
    parameters = np.zeros(SIZE)
    parameters[:moves.size] = moves.ravel()
    parameters[2 * MOVES:] = lifted, phase
    return parameters


def segments(phase: ArrayLike) -> np.ndarray:
    """Return the segment (N, HORIZON) of each control period, for phases (N,)."""
    return (np.arange(HORIZON) + np.asarray(phase)[:, None]) // REPEAT


def shift(parameters: np.ndarray) -> np.ndarray:
    """Carry parameters (D,) over to the next control period; new segments stand still."""
    (moves,), (lifted,), (phase,) = split(parameters[None])
    phase = (phase + 1) % REPEAT
    if phase == 0:  # the first segment is over
        moves, lifted = moves[1:], max(lifted - 1, 0)
    return join(moves, lifted, phase)


def landings(actions: np.ndarray, gripper: np.ndarray) -> np.ndarray:
    """
    Find where, (N, 2) metres, the gripper comes down: passes DOWN; NaN if it does not.

    :param actions: (N, HORIZON, 4); gripper: (4,).
    """
    path, height = (gripper[at] + actions[..., at].cumsum(1, dtype=float)
                    for at in (np.s_[:2], 2))
    down = (height - actions[..., 2] > DOWN) & (height <= DOWN)
    first = down.argmax(1)
    return np.where(down.any(1)[:, None], path[np.arange(len(path)), first], np.nan)


def gripper_after(gripper: np.ndarray, actions: np.ndarray) -> np.ndarray:
    """Return where actions (T, 4) leave a gripper (4,), float32, within limits and workspace."""
    low, high, limit = (np.array(values, np.float32) for values in (
        [*WORKSPACE_LOW, 0.0], [*WORKSPACE_HIGH, 1.0], ACTION_LIMIT))
    hand = np.asarray(gripper, np.float32)
    for action in np.asarray(actions, np.float32):
        moved = hand[:3] + np.clip(action[:3], -limit, limit)
        hand = np.clip(np.append(moved, action[3]), low, high)
    return hand


def push_proposals(shape: SequenceShape, gripper: np.ndarray, objects: np.ndarray,
                   goals: np.ndarray, count: int, rng: np.random.Generator) -> np.ndarray:
    """
    Propose P pushes, parameters (P, D); none when every object is at its goal.

    :param gripper: (4,) metres.
    :param objects: (K, 2) metres on the table; goals (K, 2).
    :param count: P, how many.
    """
    gaps = goals - objects
    distances = np.linalg.norm(gaps, axis=1)
    weights = np.where(distances > 0.01, distances, 0)  # how often each object is chosen
    if not count or weights.sum() <= 0:
        return np.zeros((0, SIZE))
    proposals = []
    for k in rng.choice(len(objects), count, p=weights / weights.sum()):
        for spread in TURNS:
            angle = np.arctan2(*gaps[k][::-1]) + rng.normal(0, spread)
            along = np.array([np.cos(angle), np.sin(angle)])
            aside = rng.normal(0, 0.025) * np.array([-along[1], along[0]])
            start = objects[k] - rng.uniform(0.13, 0.16) * along + aside
            if (start == shape.inside(start)).all():
                break
        # the gripper stops where the object's near side should end
        end = start + (distances[k] + rng.normal(0.07, 0.03)) * along
        proposals.append(_go_and_push(shape, gripper, shape.inside(start), end, objects[k], along))
    return np.stack(proposals)


def _go_and_push(shape: SequenceShape, gripper: np.ndarray, start: np.ndarray, end: np.ndarray,
                 target: np.ndarray, along: np.ndarray) -> np.ndarray:
    """
    Return parameters (D,): travel lifted to the start unless already behind, push to the end.

    :param start: (2,) metres; end (2,); target (2,), the object; along (2,), of the push.
    """
    here = gripper[:2]
    ahead = (target - here) @ along
    beside = np.linalg.norm(target - here - ahead * along)
    lifted, phase = 0, 0
    if not (gripper[2] < 0.05 and 0.02 < ahead < 0.2 and beside < 0.05):
        # as many lifted periods as the way needs at nearly full speed
        for lifted, phase in LIFTS:
            periods = _moving_periods(shape, gripper[2], lifted, phase)
            if np.abs(start - here).max() <= PACE * shape.move_limit * periods[:lifted].sum():
                break
    start = start if lifted else here
    needed = np.linalg.norm(end - start) / (PACE * shape.push_limit)
    if not lifted:
        phase = int(-np.ceil(needed) % REPEAT)  # so that it ends with a segment
    periods = _moving_periods(shape, gripper[2], lifted, phase)
    moves = np.zeros((MOVES, 2))
    moves[:lifted] = (start - here) / max(1, periods[:lifted].sum())
    last = lifted + 1
    while last < MOVES and periods[lifted:last].sum() < needed:
        last += 1
    moves[lifted:last] = (end - start) / max(1, periods[lifted:last].sum())
    moves = np.clip(moves, -shape.move_limit, shape.move_limit)
    return join(moves, lifted, phase)


@lru_cache(100)
def _moving_periods(shape: SequenceShape, height: float, lifted: int, phase: int) -> np.ndarray:
    """Return how many control periods of each segment (num_moves,) move sideways."""
    _, (sideways,) = shape.climbs(np.array([lifted]), np.array([phase]), height)
    return np.bincount(segments([phase])[0], sideways, minlength=MOVES)
