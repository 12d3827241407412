# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""How far a robot is from what it moves, by the shapes that collide."""

import mujoco
import numpy as np

FAR = 0.03  # m; what is farther is told as this


class Gap:
    """
    The gap between a robot and things of a model.

    :param robot: name of the body that the robot's others hang on.
    """

    def __init__(self, model: mujoco.MjModel, robot: str) -> None:
        self._model = model
        self._robot = model.body_rootid == model.body(robot).rootid
        self._collides = (model.geom_contype != 0) | (model.geom_conaffinity != 0)

    def __call__(self, data: mujoco.MjData, thing: str = '') -> float:
        """Return the least gap in m, FAR at most, to a body or, without one, all that moves."""
        model, welded = self._model, self._model.body_weldid  # 0: to the world
        moves = welded == model.body(thing).id if thing else (welded != 0) & ~self._robot
        ours, theirs = (np.flatnonzero(self._collides & bodies[model.geom_bodyid])
                        for bodies in (self._robot, moves))
        apart = np.linalg.norm(data.geom_xpos[ours, None] - data.geom_xpos[theirs], axis=-1)
        reach = model.geom_rbound[ours, None] + model.geom_rbound[theirs]
        gap = FAR
        for i, j in np.argwhere(apart - reach < FAR):
            gap = min(gap, mujoco.mj_geomDistance(
                model, data, int(ours[i]), int(theirs[j]), gap, None))
        return gap
