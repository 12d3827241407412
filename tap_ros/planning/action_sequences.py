# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
What the search varies: a few displacements, each repeated, and for how long the gripper is lifted.

A sequence of `horizon` actions is made of segments of `repeat` control periods. Parameters (D,)
are x, y of every segment in metres per control period, then the number of segments to stay lifted.
A plan that is carried over to the next control period starts inside a segment: with `phase`
periods of the first one already executed, the horizon reaches into one segment more.
"""

from dataclasses import dataclass

import numpy as np

LIFT = 0.15  # m per control period: to the top of the workspace, or down to the table, in one


@dataclass(frozen=True)
class SequenceShape:
    """
    How parameters become actions.

    :param segments: displacements within the horizon; repeat: control periods of each.
    :param phase: periods of the first segment that are past, 0..repeat-1.
    :param move_limit: m per control period, |x| and |y|; max_lift: segments.
    """

    segments: int = 5
    repeat: int = 3
    phase: int = 0
    move_limit: float = 0.08
    max_lift: int = 4

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

    def clip(self, parameters):
        """Limit parameters (N, D) to what the arm may do; the lift becomes a whole number."""
        parameters = parameters.copy()
        parameters[:, :-1] = np.clip(parameters[:, :-1], -self.move_limit, self.move_limit)
        parameters[:, -1] = np.clip(np.rint(parameters[:, -1]), 0, self.max_lift)
        return parameters

    def actions(self, parameters):
        """
        Expand parameters.

        :param parameters: (N, D).
        :return: (N, horizon, 4) float32: metres per control period, gripper closed (0).
        """
        moves, lifted = self.split(parameters)
        segment = (np.arange(self.horizon) + self.phase) // self.repeat  # (horizon,)
        actions = np.zeros((len(parameters), self.horizon, 4), np.float32)
        actions[..., :2] = moves[:, segment]
        actions[..., 2] = np.where(segment[None] < lifted[:, None], LIFT, -LIFT)
        return actions

    def following(self):
        """Return the shape one control period later."""
        return SequenceShape(self.segments, self.repeat, (self.phase + 1) % self.repeat,
                             self.move_limit, self.max_lift)

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
