# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""How far objects have been from their goals, for the chart of the explorer's page."""

from collections import deque
from collections.abc import Mapping
import math
from typing import Any

LONGEST = 600.0  # s that are kept
POINTS = 300  # that are shown of them

Place = tuple[float, ...]  # x, y, z in m, or u, v in pixels


class Distances:
    """Distances from objects to their goals over time; a new goal or scene begins anew."""

    def __init__(self) -> None:
        self._unit = ''
        self._names: tuple[str, ...] = ()
        self._points: deque[tuple[float, tuple[float, ...]]] = deque()

    def clear(self) -> None:
        """Forget what was."""
        self._points.clear()

    def add(self, time: float, objects: Mapping[str, tuple[Place, Place]],
            goals: Mapping[str, tuple[Place, Place]]) -> None:
        """
        Note where objects are; in centimetres where all their poses are known, else in pixels.

        :param time: s; one that is before the newest begins anew.
        :param objects: name to ((x, y, z) m, (u, v) px); NaN where unknown.
        :param goals: likewise; objects without one are left out.
        """
        names = tuple(name for name in objects if name in goals)
        metres = all(math.isfinite(x) for name in names for side in (objects, goals)
                     for x in side[name][0])
        unit, which, factor = ('cm', 0, 100.0) if metres else ('px', 1, 1.0)
        if (names, unit) != (self._names, self._unit) or (
                self._points and time < self._points[-1][0]):
            self.clear()
        self._names, self._unit = names, unit
        values = tuple(factor * math.dist(objects[name][which], goals[name][which])
                       for name in names)
        if not names or not all(map(math.isfinite, values)):
            return
        if self._points and self._points[-1][0] == time:
            self._points.pop()
        self._points.append((time, values))
        while self._points[0][0] < time - LONGEST:
            self._points.popleft()

    def shown(self) -> dict[str, Any]:
        """Return unit, names, times (s) and values (a list for each name) of POINTS moments."""
        points = list(self._points)
        points = points[::-1][::max(1, math.ceil(len(points) / POINTS))][::-1]  # with the newest
        return {'unit': self._unit if points else '', 'names': list(self._names),
                'times': [round(time, 2) for time, _ in points],
                'values': [[round(values[k], 2) for _, values in points]
                           for k in range(len(self._names))]}
