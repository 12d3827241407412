# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
What the search varies: a few displacements, each repeated, and for how long the gripper is lifted.

A sequence of `horizon` actions is made of segments of `repeat` control periods. Parameters (D,)
are x, y of every segment in metres per control period, then the number of segments to stay lifted.
Like the expert that was recorded, the arm goes up and down on the spot and pushes slowly: what the
forward model has never seen, it cannot foresee. A plan that is carried over to the next control
period starts inside a segment: with `phase` periods of the first one already executed, the horizon
reaches into one segment more.
"""

from dataclasses import dataclass, replace

import numpy as np

LIFTED = 0.13  # m, height of the gripper that clears the objects
LOW = 0.012  # m, height at which it pushes
VERTICAL = 0.06  # m, a change of height beyond which the arm does not move sideways meanwhile
CLIMB_LIMIT = 0.15  # m per control period


@dataclass(frozen=True)
class SequenceShape:
    """
    How parameters become actions.

    :param segments: displacements within the horizon; repeat: control periods of each.
    :param phase: periods of the first segment that are past, 0..repeat-1.
    :param move_limit: m per control period, |x| and |y|; max_lift: segments.
    :param push_limit: m per control period, length of a displacement while the gripper is low.
    :param upright: go up and down without moving sideways.
    :param climb_limit: m per control period, up and down.
    """

    segments: int = 5
    repeat: int = 3
    phase: int = 0
    move_limit: float = 0.08
    max_lift: int = 4
    push_limit: float = 0.05
    upright: bool = True
    climb_limit: float = CLIMB_LIMIT

    @property
    def horizon(self):
        return self.segments * self.repeat

    @property
    def num_moves(self):
        """Number of displacements that the horizon touches."""
        return self.segments + (self.phase > 0)

    @property
    def size(self):
        """Number of parameters."""
        return 2 * self.num_moves + 1

    def split(self, parameters):
        """Return displacements (N, M, 2) and the lifted segments, ints (N,)."""
        moves = parameters[:, :-1].reshape(len(parameters), self.num_moves, 2)
        return moves, np.rint(parameters[:, -1]).astype(int)

    def clip(self, parameters, least_lift=0):
        """
        Limit parameters (N, D) to what the arm may do; the lift becomes a whole number.

        :param least_lift: segments to stay lifted at least.
        """
        parameters = parameters.copy()
        parameters[:, :-1] = np.clip(parameters[:, :-1], -self.move_limit, self.move_limit)
        parameters[:, -1] = np.clip(np.rint(parameters[:, -1]), least_lift, self.max_lift)
        return parameters

    def least_lift(self, height):
        """
        Return how many segments the gripper has to be lifted at least.

        Neither low nor lifted, it stands upon something: then it must go up before it can push.
        Where it takes several periods to come down, it passes these heights every time.
        """
        return int(self.upright and self.climb_limit >= LIFTED - LOW
                   and LOW + 0.02 < height < LIFTED - 0.03)

    def segment(self):
        """Return the segment (horizon,) of each control period."""
        return (np.arange(self.horizon) + self.phase) // self.repeat

    def climbs(self, lifted, height):
        """
        Plan the heights.

        :param lifted: (N,) segments; height: of the gripper now, m.
        :return: climb (N, horizon) m per control period, and whether the arm may move sideways.
        """
        heights = np.where(self.segment()[None] < lifted[:, None], LIFTED, LOW)
        missing, climb = np.empty(heights.shape), np.empty(heights.shape)
        now = np.full(len(lifted), height, float)
        for t in range(self.horizon):
            missing[:, t] = heights[:, t] - now
            climb[:, t] = np.clip(missing[:, t], -self.climb_limit, self.climb_limit)
            now = now + climb[:, t]
        near = min(VERTICAL, max(self.climb_limit, 0.02))  # slow ones wait until it is done
        return climb, (np.abs(missing) < near) | (not self.upright)

    def actions(self, parameters, height):
        """
        Expand parameters.

        :param parameters: (N, D); height: of the gripper now, m.
        :return: (N, horizon, 4) float32: metres per control period, gripper closed (0).
        """
        moves, lifted = self.split(parameters)
        climb, sideways = self.climbs(lifted, height)
        actions = np.zeros((len(parameters), self.horizon, 4), np.float32)
        actions[..., :2] = moves[:, self.segment()] * sideways[..., None]
        actions[..., 2] = climb
        length = np.linalg.norm(actions[..., :2], axis=-1)
        low = self.segment()[None] >= lifted[:, None]
        slow = np.minimum(1, self.push_limit / np.maximum(length, 1e-9))
        actions[..., :2] *= np.where(low, slow, 1)[..., None]
        return actions

    def landings(self, actions, gripper):
        """
        Find where the gripper comes down: passes LOW + VERTICAL.

        :param actions: (N, horizon, 4); gripper: (4,).
        :return: (N, 2) metres; NaN for sequences that stay up or low.
        """
        path = gripper[:3] + actions[..., :3].astype(np.float64).cumsum(1)  # (N, horizon, 3)
        before = path[..., 2] - actions[..., 2]
        down = (before > LOW + VERTICAL) & (path[..., 2] <= LOW + VERTICAL)
        first = down.argmax(1)
        return np.where(
            down.any(1)[:, None], path[np.arange(len(path)), first, :2], np.nan)

    def following(self):
        """Return the shape one control period later."""
        return replace(self, phase=(self.phase + 1) % self.repeat)

    def shift(self, parameters):
        """
        Carry parameters (D,) over to the next control period.

        :return: (D',) for `following()`: new segments at the end stand still.
        """
        moves, lifted = self.split(parameters[None])
        following = self.following()
        if following.phase == 0:  # the first segment is over
            moves, lifted = moves[:, 1:], np.maximum(lifted - 1, 0)
        out = np.zeros(following.size)
        kept = moves[0][:following.num_moves].ravel()
        out[:len(kept)] = kept
        out[-1] = lifted[0]
        return out
