# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The camera's geometry and the off-screen renderer of the simulator."""

import contextlib
from dataclasses import dataclass

import mujoco
import numpy as np
from numpy.typing import ArrayLike
from sim_bridge.scene import ARM_GEOM_GROUP, CAMERA_FOVY, CAMERA_POSITION, CAMERA_TILT
from tap_ros.errors import SceneError

MAX_SCENE_GEOMS = 200


@dataclass(frozen=True)
class Camera:
    """A pinhole camera; pixel (0, 0) is the centre of the top-left pixel."""

    width: int
    height: int
    tilt: float = CAMERA_TILT  # rad from straight down
    fovy: float = CAMERA_FOVY  # degrees

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
        rotation = np.array([[1, 0, 0], [0, -c, -s], [0, s, -c]])
        return np.column_stack([rotation, -rotation @ np.array(CAMERA_POSITION)])

    def project(self, points: ArrayLike) -> np.ndarray:
        """
        Project points of the world into the picture.

        :param points: (..., 3) metres.
        :return: (..., 2) pixels (u, v) = (column, row).
        """
        rotation, translation = self.extrinsics[:, :3], self.extrinsics[:, 3]
        rays = (np.asarray(points) @ rotation.T + translation) @ self.K.T
        return rays[..., :2] / rays[..., 2:]


class Renderer:
    """
    Renders models that share the visual settings of scene.py with one OpenGL context.

    Building a context costs far more than a picture, so one is kept for all models. It belongs to
    the thread that built it.
    """

    def __init__(self, model: mujoco.MjModel, image_size: int) -> None:
        self._size = image_size
        # Torch's CUDA build brings triton, whose LLVM has to be loaded before that of Mesa.
        with contextlib.suppress(ImportError):
            import triton  # noqa: F401
        try:
            self._gl = mujoco.GLContext(image_size, image_size)
            self._gl.make_current()
            self._context = mujoco.MjrContext(model, mujoco.mjtFontScale.mjFONTSCALE_100)
            mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN, self._context)
        except Exception as error:
            raise SceneError(
                f'cannot render off-screen ({error}); on Debian and Ubuntu: '
                'apt-get install libegl1 libgl1-mesa-dri, and set MUJOCO_GL=egl') from error
        self._viewport = mujoco.MjrRect(0, 0, image_size, image_size)
        self._show, self._hide = mujoco.MjvOption(), mujoco.MjvOption()
        self._hide.geomgroup[ARM_GEOM_GROUP] = 0
        self.use(model)

    def use(self, model: mujoco.MjModel) -> None:
        """Render this model from now on."""
        self._model = model
        self._scene = mujoco.MjvScene(model, MAX_SCENE_GEOMS)
        self._camera = mujoco.MjvCamera()
        self._camera.type = mujoco.mjtCamera.mjCAMERA_FIXED
        self._camera.fixedcamid = 0

    def render(self, data: mujoco.MjData, hide_arm: bool = False) -> np.ndarray:
        """
        Render one picture.

        :param data: mujoco.MjData, after mj_forward.
        :param hide_arm: leave the arm out of the picture.
        :return: uint8 (H, W, 3) rgb.
        """
        self._gl.make_current()
        mujoco.mjv_updateScene(
            self._model, data, self._hide if hide_arm else self._show, None, self._camera,
            mujoco.mjtCatBit.mjCAT_ALL, self._scene)
        picture = np.empty((self._size, self._size, 3), np.uint8)
        mujoco.mjr_render(self._viewport, self._scene, self._context)
        mujoco.mjr_readPixels(picture, None, self._viewport, self._context)
        return np.ascontiguousarray(picture[::-1])

    def close(self) -> None:
        """Free the context."""
        self._gl.make_current()  # else another renderer's objects would be freed
        self._context.free()
        self._gl.free()
