# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Between pixels and the table: the plane of the objects' tops, and that of their middles."""

import numpy as np
from numpy.typing import ArrayLike
from tap_ros.base.errors import TrackingError
from tap_ros.robots.silhouette import PinholeCamera

SIDE = 256  # px of the longer side of the working picture, in which all of this folder is done
TOP, MIDDLE = 0.06, 0.03  # m above the table: what most of a silhouette shows, and its middle
STEEP = 0.1  # sine of the angle at which a camera looks down on the middle of the table, at least
EDGE = 0.47  # m, |x| and |y| on a calibrated table
PIXELS_A_METRE = 160.0  # without calibration, in the working picture


class Plane:
    """
    The geometry of pictures of one size.

    Places are metres in the frame of the table; without a camera, pixels of the working picture
    over PIXELS_A_METRE.

    :param camera: PinholeCamera in the frame of the table, or None.
    :param size: (height, width) of the pictures.
    :ivar working: (height, width) of the working picture.
    :ivar blur: px of it that an edge is wide at most, where it is enlarged.
    :ivar levels: (3, 3) homographies of places at TOP, MIDDLE and 0 to working pixels.
    :ivar eye: (2,) m, the place that the camera is above.
    """

    def __init__(self, camera: PinholeCamera | None, size: tuple[int, int]) -> None:
        self.calibrated = camera is not None
        height, width = size
        scale = SIDE / max(size)
        self.working = max(round(height * scale), 1), max(round(width * scale), 1)
        self.blur = round(scale / 2) if scale > 1.5 else 0
        self._scale = np.array([self.working[1] / width, self.working[0] / height])
        self.levels = {z: self._homography(camera, z) for z in (TOP, MIDDLE, 0.0)}
        self._inverse = {z: np.linalg.inv(level) for z, level in self.levels.items()}
        self.eye = np.zeros(2) if camera is None else camera.pose[:2, 3]

    def _homography(self, camera: PinholeCamera | None, height: float) -> np.ndarray:
        """Return the homography of a level plane to the working picture."""
        if camera is None:
            return np.diag([PIXELS_A_METRE, -PIXELS_A_METRE, 1.0])
        u, v = np.divide(self.working, camera.size)[::-1]
        K = np.array([[u, 0, u / 2 - 0.5], [0, v, v / 2 - 0.5], [0, 0, 1]]) @ camera.K
        seen = np.linalg.inv(camera.pose)[:3]
        matrix = K @ np.column_stack([seen[:, 0], seen[:, 1], seen[:, 2] * height + seen[:, 3]])
        return matrix / matrix[2, 2]

    def shrink(self, pixels: ArrayLike) -> np.ndarray:
        """Return camera pixels (..., 2) in the working picture."""
        return (np.asarray(pixels, np.float64) + 0.5) * self._scale - 0.5

    def enlarge(self, pixels: ArrayLike) -> np.ndarray:
        """Return pixels (..., 2) of the working picture in that of the camera."""
        return (np.asarray(pixels, np.float64) + 0.5) / self._scale - 0.5

    def places(self, pixels: ArrayLike, height: float = TOP) -> np.ndarray:
        """Return the places (..., 2) that working pixels show, of TOP, MIDDLE or 0."""
        return _project(self._inverse[height], pixels)

    def pixels(self, places: ArrayLike, height: float = TOP) -> np.ndarray:
        """Return the working pixels (..., 2) of places at TOP, MIDDLE or 0."""
        return _project(self.levels[height], places)

    def apart(self, other: 'Plane') -> float:
        """Return how far corners of the table are from those of another plane, working px."""
        corners = np.array([(x, y) for x in (-EDGE, EDGE) for y in (-EDGE, EDGE)])
        return float(np.abs(self.pixels(corners) - other.pixels(corners)).max())


def check_pose(pose: np.ndarray) -> None:
    """
    Refuse a camera from which places on the table cannot be told.

    :param pose: (4, 4) of the camera in the frame of the table.
    :raises TrackingError: unless it looks down on the middle of the table.
    """
    at = pose[:3, 3] - (0, 0, TOP)
    if not (-at @ pose[:3, 2] > 0 and at[2] > STEEP * np.linalg.norm(at)):
        raise TrackingError(
            'a camera at ({:g}, {:g}, {:g}) m that looks along ({:.2g}, {:.2g}, {:.2g}) does not '
            'look down on the middle of the table, (0, 0, 0); correct its pose'.format(
                *pose[:3, 3], *pose[:3, 2]))


def _project(matrix: np.ndarray, points: ArrayLike) -> np.ndarray:
    """Map points (..., 2) by a homography (3, 3)."""
    points = np.asarray(points, np.float64)
    rays = points @ matrix[:, :2].T + matrix[:, 2]
    return rays[..., :2] / rays[..., 2:]
