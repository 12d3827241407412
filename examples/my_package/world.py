# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0

import numpy as np
from tap_ros import Camera, GymWorld


class Dot(GymWorld):
    """One object that is where the fingertips are; its goal is 10 cm to the right."""

    task_name, object_names = 'dot', ('dot',)

    def __init__(self, task='dot', image_size=256):
        self.camera = Camera(image_size, image_size)

    def begin(self, seed):
        self.place = np.random.default_rng(seed).uniform(-0.1, 0.1, 3) * (1, 1, 0)
        self.wanted = self.place + (0.1, 0, 0)

    def move(self, target, opening):
        self.place = target

    def gripper(self):
        return np.append(self.place, 1.0)

    def object_poses(self):
        return np.append(self.place, (0, 0, 0, 1))[None]

    def goal_places(self):
        return self.wanted[None]

    def succeeds(self):
        return np.linalg.norm(self.place - self.wanted) < 0.01

    def draw(self):
        shape = (self.camera.height, self.camera.width)
        return np.full((*shape, 3), 90, np.uint8), np.zeros(shape, np.uint8)

    def solve(self):
        self.place = self.wanted

    def close(self):
        pass
