# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The camera's geometry, and off-screen rendering."""

import contextlib
from dataclasses import dataclass
import os
import warnings

import mujoco
import numpy as np
from numpy.typing import ArrayLike
from sim_bridge.world.opengl import GL_PROBLEM
from sim_bridge.world.scene import CAMERA_FOVY, CAMERA_POSITION, CAMERA_TILT
from tap_ros.base.errors import SceneError
from tap_ros.base.text import escaped


@dataclass(frozen=True)
class Camera:
    """A pinhole camera; pixel (0, 0) is the centre of the top-left pixel."""

    width: int
    height: int
    tilt: float = CAMERA_TILT  # rad from straight down
    fovy: float = CAMERA_FOVY  # degrees
    position: tuple[float, float, float] = CAMERA_POSITION  # m
    turn: float = 0.0  # rad about the vertical; at 0 it looks along y

    @property
    def K(self) -> np.ndarray:
        """Intrinsics, 3x3, in pixels."""
        focal = 0.5 * self.height / np.tan(np.radians(self.fovy) / 2)
        return np.array([
            [focal, 0, (self.width - 1) / 2], [0, focal, (self.height - 1) / 2], [0, 0, 1]])

    @property
    def extrinsics(self) -> np.ndarray:
        """World to camera, 3x4, metres; the camera looks along +z, x right, y down."""
        c, s = np.cos(self.tilt), np.sin(self.tilt)
        tilt = np.array([[1, 0, 0], [0, -c, -s], [0, s, -c]])
        c, s = np.cos(self.turn), np.sin(self.turn)
        rotation = tilt @ np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]])
        return np.column_stack([rotation, -rotation @ np.array(self.position)])

    @property
    def pose(self) -> np.ndarray:
        """Pose (4, 4) of the optical frame in the world: z ahead, x right, y down (REP 103)."""
        pose = np.eye(4)
        pose[:3, :3] = self.extrinsics[:, :3].T
        pose[:3, 3] = self.position
        return pose

    @property
    def quaternion(self) -> np.ndarray:
        """Orientation w, x, y, z of MuJoCo's camera, which looks along -z."""
        tilt = np.array([np.cos(self.tilt / 2), np.sin(self.tilt / 2), 0, 0])
        turn = np.array([np.cos(self.turn / 2), 0, 0, np.sin(self.turn / 2)])
        product = np.zeros(4)
        mujoco.mju_mulQuat(product, turn, tilt)
        return product

    def project(self, points: ArrayLike) -> np.ndarray:
        """
        Project points of the world into the picture.

        :param points: (..., 3) metres.
        :return: (..., 2) pixels (u, v) = (column, row).
        """
        rotation, translation = self.extrinsics[:, :3], self.extrinsics[:, 3]
        rays = (np.asarray(points) @ rotation.T + translation) @ self.K.T
        return rays[..., :2] / rays[..., 2:]

    def on_table(self, pixels: ArrayLike, height: ArrayLike = 0.0) -> np.ndarray:
        """
        Return where the rays of pixels meet the table's plane, z = 0, or one above it.

        :param pixels: (..., 2) (u, v).
        :param height: z of the plane in m, beneath the camera, or one for each pixel (...).
        :return: (..., 2) x, y in m; infinite for rays that do not meet it.
        """
        pixels = np.asarray(pixels, np.float64)
        rays = np.concatenate([pixels, np.ones_like(pixels[..., :1])], -1)
        rays = rays @ np.linalg.inv(self.K).T @ self.extrinsics[:, :3]
        with np.errstate(divide='ignore', invalid='ignore'):
            far = np.where(
                rays[..., 2] < 0, (np.asarray(height) - self.position[2]) / rays[..., 2], np.inf)
            return np.array(self.position[:2]) + far[..., None] * rays[..., :2]


class OneCamera:
    """A world whose pictures one camera takes, as protocol.World tells of it."""

    camera: Camera

    @property
    def camera_matrix(self) -> np.ndarray:
        """Return the intrinsics (3, 3) in pixels."""
        return self.camera.K

    @property
    def camera_pose(self) -> np.ndarray:
        """Return the pose (4, 4) of the camera's optical frame in the world."""
        return self.camera.pose


def load_triton() -> None:
    """Load triton, if torch's CUDA build brings it: its LLVM has to come before that of Mesa."""
    with contextlib.suppress(ImportError):
        import triton  # noqa: F401


class Renderer(mujoco.Renderer):  # type: ignore[misc]  # MuJoCo has no types
    """
    Draws off-screen without what is slow there, in 7 ms, not 300; belongs to its thread.

    :param model: its framebuffer gets this size.
    :param width: of pictures, in pixels; height, too.
    :param most_geoms: of a scene.
    :raises SceneError: when nothing can be rendered.
    """

    def __init__(self, model: mujoco.MjModel, width: int, height: int,
                 most_geoms: int = 10_000) -> None:
        load_triton()
        model.vis.quality.offsamples = model.vis.quality.shadowsize = 0
        model.vis.global_.offwidth, model.vis.global_.offheight = width, height
        try:
            with warnings.catch_warnings(action='ignore'):
                if GL_PROBLEM:
                    raise OSError(GL_PROBLEM)
                super().__init__(model, height, width, most_geoms)
        except Exception as error:
            raise SceneError(
                f"cannot render off-screen with MUJOCO_GL={escaped(os.environ['MUJOCO_GL'])} "
                f'({escaped(error)}); set MUJOCO_GL=egl, and on Debian and Ubuntu: apt-get '
                'install libegl1 libgl1-mesa-dri') from error
        for flag in (mujoco.mjtRndFlag.mjRND_SHADOW, mujoco.mjtRndFlag.mjRND_REFLECTION):
            self.scene.flags[flag] = False

    def numbers(self) -> np.ndarray:
        """Return the number and kind of what is seen at each pixel, (H, W, 2); -1: nothing."""
        self.enable_segmentation_rendering()
        try:
            return self.render()
        finally:
            self.disable_segmentation_rendering()

    def close(self) -> None:
        """Free what this holds; keep what another thread is drawing with."""
        try:
            super().close()
        except Exception:
            # What failed while it was made has neither.
            _kept.append([vars(self).get(name) for name in ('_mjr_context', '_gl_context')])


_kept: list[object] = []  # freed with another context, they would take away its objects
