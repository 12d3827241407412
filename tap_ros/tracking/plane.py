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

    Places (..., 3) are metres in the frame of the table: x, y, and how far an object was lifted;
    without a camera, pixels of the working picture over PIXELS_A_METRE, and 0.

    :param camera: PinholeCamera in the frame of the table, or None.
    :param size: (height, width) of the pictures.
    :ivar working: (height, width) of the working picture.
    :ivar blur: px of it that an edge is wide at most, where it is enlarged.
    :ivar matrix: (3, 4) projection of places to working pixels, lifted from the table's top.
    :ivar eye: (2,) m, the place that the camera is above.
    """

    def __init__(self, camera: PinholeCamera | None, size: tuple[int, int]) -> None:
        self.calibrated = camera is not None
        height, width = size
        scale = SIDE / max(size)
        self.working = max(round(height * scale), 1), max(round(width * scale), 1)
        self.blur = round(scale / 2) if scale > 1.5 else 0
        self._scale = np.array([self.working[1] / width, self.working[0] / height])
        self.matrix = self._projection(camera)
        self._inverse = {height: np.linalg.inv(np.column_stack([
            self.matrix[:, :2], self.matrix @ (0, 0, height, 1)])) for height in (
                TOP, MIDDLE, 0.0)}
        self.eye = np.zeros(2) if camera is None else camera.pose[:2, 3]

    def _projection(self, camera: PinholeCamera | None) -> np.ndarray:
        if camera is None:
            return np.diag([PIXELS_A_METRE, -PIXELS_A_METRE, 0.0, 1.0])[[0, 1, 3]]
        u, v = np.divide(self.working, camera.size)[::-1]
        K = np.array([[u, 0, u / 2 - 0.5], [0, v, v / 2 - 0.5], [0, 0, 1]]) @ camera.K
        matrix = K @ np.linalg.inv(camera.pose)[:3]
        return np.asarray(matrix / matrix[2, 3])

    def shrink(self, pixels: ArrayLike) -> np.ndarray:
        """Return camera pixels (..., 2) in the working picture."""
        return (np.asarray(pixels, np.float64) + 0.5) * self._scale - 0.5

    def enlarge(self, pixels: ArrayLike) -> np.ndarray:
        """Return pixels (..., 2) of the working picture in that of the camera."""
        return (np.asarray(pixels, np.float64) + 0.5) / self._scale - 0.5

    def places(self, pixels: ArrayLike, height: float = TOP) -> np.ndarray:
        """Return the places (..., 3), not lifted, that pixels show of TOP, MIDDLE or 0."""
        rays = _homogeneous(pixels) @ self._inverse[height].T
        return np.append(rays[..., :2] / rays[..., 2:], 0 * rays[..., 2:], -1)

    def pixels(self, places: ArrayLike, height: float = TOP) -> np.ndarray:
        """Return the working pixels (..., 2) of places at a height, m above their lift."""
        rays = _homogeneous(places + np.array([0, 0, height])) @ self.matrix.T
        return np.asarray(rays[..., :2] / rays[..., 2:])

    def apart(self, other: 'Plane') -> float:
        """Return how far corners of the table are from those of another plane, working px."""
        corners = np.array([(x, y, 0) for x in (-EDGE, EDGE) for y in (-EDGE, EDGE)])
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


def _homogeneous(points: ArrayLike) -> np.ndarray:
    """Return points (..., N) with a 1 behind."""
    points = np.asarray(points, np.float64)
    return np.append(points, np.ones((*points.shape[:-1], 1)), -1)
