# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Pictures of a scene as a camera in a laboratory would take them, and where the robot is in them.

The physics model of scene.py has neither arm nor furniture. A second model, compiled once, has a
wooden table, a light and perhaps an arm; for each picture the arm is posed so that it carries the
gripper, and the moving things of the physics model are added to its scene. Physics is never
touched: the arm is kinematic. Shadows are those that the light throws on the table's plane: all
that moves is drawn once more, flattened onto it, in a picture of labels, which also tells where
the robot is. That takes a tenth of the time of shadow maps.
"""

import contextlib
from dataclasses import replace
from functools import lru_cache

import mujoco
import numpy as np
from sim_bridge.world.camera import Camera, Renderer
from sim_bridge.world.looks import Appearance, USUAL
from sim_bridge.world.scene import ARM_GEOM_GROUP
from tap_ros.base.contract import ROBOT_MASK_ARM, ROBOT_MASK_FREE, ROBOT_MASK_HAND
from tap_ros.base.errors import SceneError
from tap_ros.robots.arm import Arm, rpy

SAMPLES = 2  # along each side of a pixel
MOST_GEOMS = 400  # with shadows
TABLE_HALF = 0.57  # m, of the table's square top
RIM = (0.015, 0.02)  # m: half its width, its height
FLOOR = -0.75  # m
SHADOW = 0.42  # share of the light that a shadow takes
SHADOW_HEIGHT = 0.002  # m above the table, of what is flattened onto it
AMBIENT, DIFFUSE = 0.42, 0.5  # of the light from everywhere, and from its direction


class Studio:
    """
    Takes pictures of physics models with one OpenGL context, in the thread that built it.

    :param camera: Camera.
    :param arm: Arm.
    :param links: draw it whole; else the hand alone, as if the links were rendered away.
    :param samples: along each side of a pixel.
    :raises SceneError: when nothing can be rendered.
    """

    def __init__(self, camera: Camera, arm: Arm, links: bool, samples: int = SAMPLES) -> None:
        self._camera, self._arm, self._links, self._samples = camera, arm, links, samples
        width, height = samples * camera.width, samples * camera.height
        self._joints = np.zeros(len(arm.joints))
        self._model = _studio_model(arm if links else None)
        self._table_colour = self._model.mat('table').rgba.copy()
        self._data = mujoco.MjData(self._model)
        self._renderer = Renderer(self._model, width, height, MOST_GEOMS)
        self._show, self._hide = mujoco.MjvOption(), mujoco.MjvOption()
        self._hide.geomgroup[ARM_GEOM_GROUP] = 0
        self._perturbation = mujoco.MjvPerturb()

    def use(self, physics: mujoco.MjModel, appearance: Appearance = USUAL) -> Camera:
        """Show a physics model with an Appearance from now on; return the camera as it is then."""
        self._physics = physics
        # What the mask says of each geom of the physics model.
        hand = physics.geom_group == ARM_GEOM_GROUP
        self._labels = np.where(hand, ROBOT_MASK_HAND, ROBOT_MASK_FREE).astype(np.uint8)
        usual = self._camera
        camera = replace(usual, tilt=usual.tilt + appearance.camera_tilt, position=tuple(
            np.add(usual.position, appearance.camera_offset).tolist()))
        model = self._model
        model.cam('camera').pos[:] = camera.position
        model.cam('camera').quat[:] = camera.quaternion
        model.cam('camera').fovy[:] = camera.fovy
        model.mat('table').rgba[:3] = np.clip(self._table_colour[:3] * appearance.table, 0, 1)
        light = np.array(appearance.light)
        model.light('light').dir[:] = light / np.linalg.norm(light)
        model.light('light').diffuse[:] = DIFFUSE * appearance.brightness
        model.vis.headlight.ambient[:] = AMBIENT * appearance.brightness
        self._flatten = np.eye(3)
        self._flatten[:2, 2] = -light[:2] / light[2]
        self._flatten[2, 2] = 1e-4
        self._table = _sees_table(camera, self._samples)
        mujoco.mj_forward(model, self._data)
        return camera

    def render(self, data: mujoco.MjData, hide_arm: bool = False,
               ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """
        Take one picture.

        :param data: mujoco.MjData of the physics model, after mj_forward.
        :param hide_arm: leave arm and hand out of the picture.
        :return: uint8 (H, W, 3) rgb; uint8 (H, W), where the robot is, values as in contract.py;
            (J,) rad of the arm.
        """
        self._pose_arm(data.qpos[:3])
        option, scene = self._hide if hide_arm else self._show, self._renderer.scene
        self._renderer.update_scene(self._data, 'camera', option)
        own = scene.ngeom
        mujoco.mjv_addGeoms(self._physics, data, option, self._perturbation,
                            mujoco.mjtCatBit.mjCAT_DYNAMIC, scene)
        colours = self._renderer.render()
        labels = self._add_shadows(own)
        numbers = self._renderer.numbers()[..., 0]
        # Shadows darken the table; light falls off at their edges as pixels are averaged.
        label, shadow = labels[numbers, 0], labels[numbers, 1]
        shade = np.where((shadow != 0) & self._table, 1 - SHADOW, 1).astype(np.float32)
        shaded = colours * shade[..., None]
        picture = sum(self._parts(shaded)) / self._samples ** 2
        # Of a pixel the robot's if one of its samples is.
        mask = np.maximum.reduce(self._parts(label))
        return np.rint(picture).astype(np.uint8), mask, self._joints.copy()

    def _parts(self, values: np.ndarray) -> list[np.ndarray]:
        """Return the first sample of each pixel (H, W, ...), the second, and so on."""
        side = self._samples
        return [values[row::side, column::side] for row in range(side) for column in range(side)]

    def close(self) -> None:
        """Free the OpenGL context."""
        self._renderer.close()

    def _pose_arm(self, gripper: np.ndarray) -> None:
        """Let the arm carry the gripper at (3,) m."""
        # Contact can press the gripper a little beyond where commands may bring it, and the arm's
        # reach: then the arm stays as it was.
        with contextlib.suppress(SceneError):
            self._joints = self._arm.joints_at(gripper)
        if self._links:
            self._data.qpos[:] = self._joints
            mujoco.mj_kinematics(self._model, self._data)

    def _add_shadows(self, own: int) -> np.ndarray:
        """
        Add the flattened shadow of everything that moves to the scene.

        :param own: number of geoms in the scene that are the studio's.
        :return: uint8 (N + 1, 2): for each geom of the scene the mask's label and whether it is a
            shadow; the last row is for pixels without a geom.
        """
        scene = self._renderer.scene
        count = scene.ngeom
        labels = np.zeros((2 * count + 1, 2), np.uint8)
        for i in range(count):
            geom = scene.geoms[i]
            number, geom.segid, geom.objid = geom.objid, i, i
            if i < own and self._model.geom_group[number] != ARM_GEOM_GROUP:
                continue  # furniture
            label = ROBOT_MASK_ARM if i < own else self._labels[number]
            shadow = scene.geoms[scene.ngeom]
            place = self._flatten @ geom.pos
            place[2] += SHADOW_HEIGHT
            mujoco.mjv_initGeom(shadow, geom.type, geom.size, place,
                                (self._flatten @ geom.mat).ravel(), geom.rgba)
            shadow.size[:] = geom.size  # mjv_initGeom makes cylinders and capsules as long as wide
            shadow.segid = shadow.objid = scene.ngeom
            labels[i] = label, 0
            labels[scene.ngeom] = label, 1
            scene.ngeom += 1
        return labels[[*range(scene.ngeom), -1]]


def _studio_model(arm: Arm | None) -> mujoco.MjModel:
    """Compile table, rim, floor, light, camera and perhaps the arm."""
    spec = mujoco.MjSpec()
    spec.visual.quality.numslices, spec.visual.quality.numstacks = 16, 8
    spec.visual.quality.numquads = 1
    spec.visual.map.znear, spec.visual.map.zfar = 0.1, 10
    spec.stat.extent = 1
    spec.visual.headlight.diffuse = [0.12, 0.12, 0.12]
    spec.visual.headlight.specular = [0, 0, 0]
    world = spec.worldbody
    world.add_camera(name='camera')
    world.add_light(
        name='light', pos=[0, 0, 3], type=mujoco.mjtLightType.mjLIGHT_DIRECTIONAL,
        castshadow=False, ambient=[0, 0, 0], specular=[0.12, 0.12, 0.12])
    spec.add_texture(
        name='walls', type=mujoco.mjtTexture.mjTEXTURE_SKYBOX, width=16, height=96,
        builtin=mujoco.mjtBuiltin.mjBUILTIN_GRADIENT, rgb1=[0.78, 0.79, 0.8],
        rgb2=[0.5, 0.51, 0.53])
    _add_furniture(spec)
    if arm is not None:
        _add_arm(spec, arm)
    return spec.compile()


def _add_arm(spec: mujoco.MjSpec, arm: Arm) -> None:
    """Add the arm's bodies, joints and shapes to a model; nothing of it touches anything."""
    half = arm.mount.yaw / 2
    body = spec.worldbody.add_body(
        name=f'{arm.name}_base', pos=arm.mount.position,
        quat=[np.cos(half), 0, 0, np.sin(half)])
    bodies = [body]
    for joint, link, (place, turn) in zip(arm.joints, arm.links[1:], arm.origins):
        (cr, cp, cy), (sr, sp, sy) = (of(np.array(rpy(turn)) / 2) for of in (np.cos, np.sin))
        body = body.add_body(
            name=link, pos=place, quat=[
                cr * cp * cy + sr * sp * sy, sr * cp * cy - cr * sp * sy,
                cr * sp * cy + sr * cp * sy, cr * cp * sy - sr * sp * cy],
            mass=1.0, inertia=[0.01] * 3, explicitinertial=True)
        body.add_joint(name=joint, type=mujoco.mjtJoint.mjJNT_HINGE, axis=[0, 0, 1])
        bodies.append(body)
    for shape in arm.shapes:
        kind = mujoco.mjtGeom.mjGEOM_CAPSULE if shape.capsule else mujoco.mjtGeom.mjGEOM_CYLINDER
        bodies[shape.link].add_geom(
            type=kind, fromto=[*shape.start, *shape.end], size=[shape.radius, 0, 0],
            rgba=[*shape.colour, 1], contype=0, conaffinity=0, group=ARM_GEOM_GROUP)


def _add_furniture(spec: mujoco.MjSpec) -> None:
    """Add a wooden table with a rim, and the floor."""
    box, world = mujoco.mjtGeom.mjGEOM_BOX, spec.worldbody
    wood = _wood()
    texture = spec.add_texture(
        name='wood', type=mujoco.mjtTexture.mjTEXTURE_2D, width=wood.shape[1],
        height=wood.shape[0], nchannel=3)
    texture.data = wood.tobytes()
    # Half bright: factors of an Appearance above 1 have room.
    material = spec.add_material(name='table', texrepeat=[1, 1], specular=0.1, shininess=0.2,
                                 rgba=[0.62, 0.62, 0.62, 1])
    material.textures[mujoco.mjtTextureRole.mjTEXROLE_RGB] = 'wood'
    world.add_geom(type=mujoco.mjtGeom.mjGEOM_PLANE, size=[TABLE_HALF, TABLE_HALF, 0.1],
                   material='table')
    world.add_geom(type=box, size=[TABLE_HALF, TABLE_HALF, 0.02], pos=[0, 0, -0.021],
                   rgba=[0.35, 0.26, 0.18, 1])
    width, height = RIM
    for x, y in ((1, 0), (-1, 0), (0, 1), (0, -1)):
        long = TABLE_HALF + 2 * width
        world.add_geom(
            type=box, pos=[x * (TABLE_HALF + width), y * (TABLE_HALF + width), 0],
            size=[width if x else long, width if y else long, height],
            rgba=[0.72, 0.70, 0.66, 1])
        world.add_geom(
            type=box, pos=[0.5 * (x + y), 0.5 * (x - y), FLOOR / 2 - 0.04],
            size=[0.03, 0.03, -FLOOR / 2 - 0.04], rgba=[0.5, 0.5, 0.5, 1])
    world.add_geom(type=mujoco.mjtGeom.mjGEOM_PLANE, size=[6, 6, 0.1], pos=[0, 0, FLOOR],
                   rgba=[0.46, 0.47, 0.49, 1])


@lru_cache(1)
def _wood(size: int = 256, planks: int = 7) -> np.ndarray:
    """Paint planks with grain along x: uint8 (size, size, 3)."""
    rng = np.random.default_rng(3)
    y, x = np.mgrid[:size, :size] / size
    plank = np.minimum((y * planks).astype(int), planks - 1)
    across = y * planks - plank
    tone = rng.uniform(-0.1, 0.1, planks)[plank]
    bend = rng.uniform(0, 2 * np.pi, planks)[plank]
    knots = across + 0.25 * np.sin(2 * np.pi * x + bend)
    grain = sum(np.sin(2 * np.pi * frequency * knots + frequency * bend) / frequency ** 0.5
                for frequency in (2, 5, 11))
    fibre = rng.normal(size=(size, size))
    fibre = sum(np.roll(fibre, shift, 1) for shift in range(32)) / 32  # longer than thick
    bright = 1 + tone + 0.035 * grain + 0.16 * fibre - 0.22 * (across < 0.035)
    return np.clip(255 * bright[..., None] * (0.92, 0.68, 0.46), 0, 255).astype(np.uint8)


@lru_cache(4)
def _sees_table(camera: Camera, samples: int) -> np.ndarray:
    """Say which samples of a picture look at the table's top: bool (H, W), of all samples."""
    fine = replace(camera, width=samples * camera.width, height=samples * camera.height)
    pixels = np.stack(np.meshgrid(np.arange(fine.width), np.arange(fine.height)), -1)
    return (np.abs(fine.on_table(pixels)) < TABLE_HALF).all(-1)
