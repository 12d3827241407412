# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0

import numpy as np
from tap_ros import Predictor, Subgoal, trained_crop


class HalfWay(Predictor):
    """Shows start and goal one over the other, each object half way."""

    mode, image_size, training = 'bidirectional', (64, 64), {}
    camera_crop = trained_crop(training, image_size)

    @classmethod
    def load(cls, argument, device='cpu'):
        return cls()

    def predict_together(self, requests):
        return [[self.answer(request)] for request in requests]

    def answer(self, request):
        image = np.uint8((request.start.astype(int) + request.goal) // 2)
        count = 0 if request.start_pixels is None else len(request.start_pixels)
        maps, pixels = np.zeros((count, *self.image_size), np.float32), np.zeros((count, 2))
        for k in range(count):
            pixels[k] = (request.start_pixels[k] + request.goal_pixels[k]) / 2
            u, v = pixels[k].round().astype(int)
            maps[k, v, u] = 1
        return Subgoal(image, maps, pixels, np.ones(count), sample=0, level=1)
