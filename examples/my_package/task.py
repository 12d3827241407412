# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0

import numpy as np
from tap_ros import carry_out, random_shape, Task, TaskScene


class Visit(Task):
    """Move the gripper to the left of the table; the object stays."""

    kind = 'visit'

    def draw(self, rng, spread):
        pose = np.array([[*rng.uniform(-0.1, 0.1, 2), 0.0]])  # x, y (m), yaw
        return TaskScene((random_shape(rng),), pose, pose, np.array([0.3, 0.3, 0.1]), (0,))

    def succeeds(self, table):
        return table.target[0] < -0.3

    def demonstrate(self, table, scene, first, rng, how):
        plans = (np.array([[-0.08, 0, 0, 0]]) for _ in range(self.num_frames))
        return carry_out(table, self.succeeds, first, plans, how.num_frames or self.num_frames)


VISIT = Visit('visit', num_objects=1, num_frames=10, stream=1001)
