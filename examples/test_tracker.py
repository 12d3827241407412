# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0

from types import SimpleNamespace

import numpy as np
from tap_ros import load_plugin


def test_it_follows_a_square():
    tracker = load_plugin('tap_ros.trackers', 'by_colour')()
    image = np.zeros((64, 64, 3), np.uint8)
    image[10:20, 30:40] = 200
    tracker.select(SimpleNamespace(image=image), [(35.0, 15.0)])
    moved = tracker.update(SimpleNamespace(image=np.roll(image, 5, 0)))
    assert moved.pixels.tolist() == [[34.5, 19.5]]
