# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0

import numpy as np
from tap_ros import Tracked


class ByColour:
    """Each object is the middle of all pixels of the colour that was clicked."""

    def __init__(self, camera=None):
        self.colours = []

    def select(self, view, pixels, drawn=()):  # drawn: outlines, if a person gave some
        self.colours = [view.image[round(v), round(u)].astype(int) for u, v in pixels]
        return self.find(view)

    def find(self, view):
        places, count = [], len(self.colours)
        for colour in self.colours:
            v, u = np.nonzero(abs(view.image - colour).sum(-1) < 30)
            places.append((u.mean(), v.mean()) if len(u) else (np.nan, np.nan))
        states = tuple('lost' if np.isnan(u) else 'seen' for u, _ in places)
        return Tracked(np.reshape(places, (-1, 2)), states, np.ones(count),
                       (np.zeros((0, 2)),) * count)

    update = find
