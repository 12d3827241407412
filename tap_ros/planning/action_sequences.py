# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
What the search varies: a few displacements, each repeated, and for how long the gripper is lifted.

A sequence of HORIZON actions is made of segments of REPEAT control periods. Parameters (D,)
are x, y of every segment in metres per control period, the number of segments to stay lifted and,
where it is searched, how much shorter the first segment is: so a way may take any number of
periods, not just whole segments. Like the expert that was recorded, the arm goes up and down on
the spot and pushes slowly: what the forward model has never seen, it cannot foresee. A plan that
is carried over to the next control period starts inside a segment, whose first `phase` periods are
past; the horizon then reaches into one segment more.
"""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike
from tap_ros.contract import CLIMB_LIMIT, LIFTED, LOW, MOVE_LIMIT

SEGMENTS = 5  # displacements within the horizon
REPEAT = 3  # control periods of each
HORIZON = SEGMENTS * REPEAT  # control periods
MAX_LIFT = 4  # segments, at most, that the gripper travels lifted before it goes down
FIRST_STD = 0.04  # m per control period, of x and y in the first Gaussian
VERTICAL = 0.06  # m, a change of height beyond which the arm does not move sideways meanwhile


@dataclass(frozen=True)
class Limits:
    """How far the arm may move in one control period, m; the contract's limits hold anyway."""

    move: float = MOVE_LIMIT  # |x| and |y|
    climb: float = CLIMB_LIMIT  # |z|


FULL = Limits()


@dataclass(frozen=True)
class SequenceShape:
    """
    How parameters become actions.

    :param phase: periods that the first segment is shorter, 0..REPEAT-1; None: the last parameter
        of a sequence says it.
    :param move_limit: m per control period, |x| and |y|.
    :param push_limit: m per control period, length of a displacement while the gripper is low.
    :param upright: go up and down without moving sideways.
    :param climb_limit: m per control period, up and down.
    """

    phase: int | None = 0
    move_limit: float = MOVE_LIMIT
    push_limit: float = 0.05
    upright: bool = True
    climb_limit: float = CLIMB_LIMIT

    @property
    def num_moves(self) -> int:
        """Number of displacements that the horizon touches."""
        return SEGMENTS + (self.phase != 0)

    @property
    def size(self) -> int:
        """Number of parameters."""
        return 2 * self.num_moves + 1 + (self.phase is None)

    def split(self, parameters: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return displacements (N, M, 2), the lifted segments and the phases, ints (N,)."""
        moves = parameters[:, :2 * self.num_moves].reshape(len(parameters), self.num_moves, 2)
        counts = np.rint(parameters[:, 2 * self.num_moves:]).astype(int)
        fixed = self.phase is not None
        return moves, counts[:, 0], np.full(len(counts), self.phase) if fixed else counts[:, 1]

    def join(self, moves: np.ndarray, lifted: int, phase: int) -> np.ndarray:
        """Return the parameters (D,) of displacements (M, 2) or fewer, the others standing."""
        parameters = np.zeros(self.size)
        kept = moves[:self.num_moves].ravel()
        parameters[:len(kept)] = kept
        parameters[2 * self.num_moves:] = [lifted, phase][:1 + (self.phase is None)]
        return parameters

    def first_gaussian(self) -> tuple[np.ndarray, np.ndarray]:
        """Return mean and deviation (D,) to begin a search with."""
        counts = np.array([MAX_LIFT, REPEAT - 1][:1 + (self.phase is None)]) / 2
        still = np.zeros(2 * self.num_moves)
        return np.append(still, counts), np.append(still + FIRST_STD, counts)

    def clip(self, parameters: np.ndarray, least_lift: int = 0) -> np.ndarray:
        """
        Limit parameters (N, D) to what the arm may do; lift and phase become whole numbers.

        :param least_lift: segments to stay lifted at least.
        """
        moves, counts = np.split(parameters, [2 * self.num_moves], axis=1)
        lowest, highest = [least_lift, 0], [MAX_LIFT, REPEAT - 1]
        counts = np.clip(np.rint(counts), lowest[:counts.shape[1]], highest[:counts.shape[1]])
        return np.hstack([np.clip(moves, -self.move_limit, self.move_limit), counts])

    def least_lift(self, height: float) -> int:
        """
        Return how many segments the gripper has to be lifted at least.

        Neither low nor lifted, it stands upon something: then it must go up before it can push.
        Where it takes several periods to come down, it passes these heights every time.
        """
        return int(self.upright and self.climb_limit >= LIFTED - LOW
                   and LOW + 0.02 < height < LIFTED - 0.03)

    def lifts(self) -> list[tuple[int, int]]:
        """Return the ways to be lifted, as (segments, phase), the shortest first."""
        phases = range(REPEAT) if self.phase is None else [self.phase]
        ways = [(n, phase) for n in range(1, MAX_LIFT + 1) for phase in phases]
        return sorted(ways, key=lambda way: REPEAT * way[0] - way[1])

    def segment(self, phase: ArrayLike) -> np.ndarray:
        """Return the segment (N, HORIZON) of each control period, for phases (N,)."""
        return (np.arange(HORIZON) + np.asarray(phase)[:, None]) // REPEAT

    def climbs(self, lifted: np.ndarray, phase: np.ndarray,
               height: float) -> tuple[np.ndarray, np.ndarray]:
        """
        Plan the heights.

        :param lifted: (N,) segments; phase: (N,); height: of the gripper now, m.
        :return: climb (N, HORIZON) m per control period, and whether the arm may move sideways.
        """
        heights = np.where(self.segment(phase) < lifted[:, None], LIFTED, LOW)
        missing, climb = np.empty(heights.shape), np.empty(heights.shape)
        now = np.full(len(lifted), height, float)
        for t in range(HORIZON):
            missing[:, t] = heights[:, t] - now
            climb[:, t] = np.clip(missing[:, t], -self.climb_limit, self.climb_limit)
            now = now + climb[:, t]
        near = min(VERTICAL, max(self.climb_limit, 0.02))  # slow ones wait until it is done
        return climb, (np.abs(missing) < near) | (not self.upright)

    def actions(self, parameters: np.ndarray, height: float) -> np.ndarray:
        """
        Expand parameters.

        :param parameters: (N, D); height: of the gripper now, m.
        :return: (N, HORIZON, 4) float32: metres per control period, gripper closed (0).
        """
        moves, lifted, phase = self.split(parameters)
        climb, sideways = self.climbs(lifted, phase, height)
        segment = self.segment(phase)
        actions = np.zeros((len(parameters), HORIZON, 4), np.float32)
        actions[..., :2] = moves[np.arange(len(moves))[:, None], segment] * sideways[..., None]
        actions[..., 2] = climb
        length = np.linalg.norm(actions[..., :2], axis=-1)
        low = segment >= lifted[:, None]
        slow = np.minimum(1, self.push_limit / np.maximum(length, 1e-9))
        actions[..., :2] *= np.where(low, slow, 1)[..., None]
        return actions

    def landings(self, actions: np.ndarray, gripper: np.ndarray) -> np.ndarray:
        """
        Find where the gripper comes down: passes LOW + VERTICAL.

        :param actions: (N, HORIZON, 4); gripper: (4,).
        :return: (N, 2) metres; NaN for sequences that stay up or low.
        """
        path = gripper[:3] + actions[..., :3].astype(np.float64).cumsum(1)  # (N, HORIZON, 3)
        before = path[..., 2] - actions[..., 2]
        down = (before > LOW + VERTICAL) & (path[..., 2] <= LOW + VERTICAL)
        first = down.argmax(1)
        return np.where(
            down.any(1)[:, None], path[np.arange(len(path)), first, :2], np.nan)

    def following(self) -> 'SequenceShape':
        """Return the shape one control period later."""
        if self.phase is None:
            return self
        return replace(self, phase=(self.phase + 1) % REPEAT)

    def shift(self, parameters: np.ndarray) -> np.ndarray:
        """
        Carry parameters (D,) over to the next control period.

        :return: (D',) for `following()`: new segments at the end stand still.
        """
        (moves,), (lifted,), (phase,) = self.split(parameters[None])
        phase = (phase + 1) % REPEAT
        if phase == 0:  # the first segment is over
            moves, lifted = moves[1:], max(lifted - 1, 0)
        return self.following().join(moves, lifted, phase)
