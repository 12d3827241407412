# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
A random tabletop with a Cartesian gripper and one to n objects, as a MuJoCo model of the physics.

The scene follows the cartgripper world of the paper's data: slide joints, objects made of boxes in
L or T form, random colours. Ours differ in three ways: bars and discs are added to the shapes, the
origin of an object is its centre of area, and the camera's field of view is 34 degrees instead of
32 and tilted a little lower, so that the whole workspace is in a square picture.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np
from tap_ros.base.contract import GRIPPER_JOINTS, object_names

SHAPES = ('L', 'T', 'bar', 'disc')
HALF_HEIGHT = 0.03  # m, of every object
HALF_THICKNESS = 0.025  # m, of the boxes an object is made of
FINGER_CLEARANCE = 0.006  # m between fingertips and table at z = 0
FINGER_GAP = 0.001  # m, half the gap between closed fingers
FINGER_TRAVEL = 0.04  # m each finger moves from closed (0) to open (1)
TIMESTEP = 0.0125  # s; a control period is a whole number of these, see simulator.py
SLIDE = {'friction': [1, 0.01, 0.0002]}
GRIP = {'friction': [2, 0.02, 0.0002], 'condim': 4}  # rubber: what is held does not turn either
ARM_GEOM_GROUP = 1  # so that the renderer can leave the arm out of a picture
CAMERA_POSITION = (0.0, -1.1, 1.3)
CAMERA_TILT = 0.68  # rad from straight down
CAMERA_FOVY = 34.0  # degrees


@dataclass(frozen=True)
class Hand:
    """Half sizes (x, y, z) of a finger and of the palm in m, and their colours (r, g, b)."""

    finger: tuple[float, float, float]
    palm: tuple[float, float, float]
    finger_colour: tuple[float, float, float] = (0.93, 0.93, 0.91)
    palm_colour: tuple[float, float, float] = (0.25, 0.26, 0.28)


# Closed, it is as wide along x as along y: objects do not slip off sideways.
PUSHER = Hand((0.017, 0.035, 0.06), (0.04, 0.04, 0.02))
GRIPPER = Hand((0.01, 0.02, 0.06), (0.045, 0.035, 0.02))


@dataclass(frozen=True)
class ObjectShape:
    """The boxes or disc that make one object: sizes and places in metres, colours in [0, 1]."""

    kind: str
    # per part: (x, y, z) of a box, or (radius, half height) of a disc
    half_sizes: tuple[tuple[float, ...], ...]
    centres: tuple[tuple[float, float], ...]  # per part: (x, y)
    colours: tuple[tuple[float, ...], ...]  # per part: (r, g, b)


def random_shape(rng: np.random.Generator, thin: bool = False) -> ObjectShape:
    """
    Draw a shape and its colours.

    :param rng: numpy Generator.
    :param thin: so that fingers can hold it.
    :return: ObjectShape with its centre of area at the origin.
    """
    kind = SHAPES[rng.choice(len(SHAPES), p=(0.35, 0.35, 0.15, 0.15))]
    colours = tuple(tuple(rng.uniform(0.3, 1.0, 3)) for _ in range(2))
    if kind == 'disc':
        radius = rng.uniform(0.02, 0.028) if thin else rng.uniform(0.04, 0.06)
        return ObjectShape(kind, ((radius, HALF_HEIGHT),), ((0, 0),), colours[:1])
    # A bar along y, and its arm for an L or a T; all lengths are halves.
    thickness = rng.uniform(0.014, 0.018) if thin else HALF_THICKNESS
    bar = (thickness, rng.uniform(0.06 if thin else 0.05, 0.09), HALF_HEIGHT)
    arm = (rng.uniform(0.03 if thin else 0.02, 0.05), thickness, HALF_HEIGHT)
    if kind == 'bar':
        return ObjectShape(kind, (bar,), ((0, 0),), colours[:1])
    # The arm sticks out from the bar's side: at its end for L, its middle for T.
    arm_centre = np.array([thickness + arm[0], bar[1] - thickness if kind == 'L' else 0.0])
    areas = np.array([bar[0] * bar[1], arm[0] * arm[1]])
    centroid = arm_centre * areas[1] / areas.sum()
    return ObjectShape(kind, (bar, arm), (tuple(-centroid), tuple(arm_centre - centroid)), colours)


def build_scene(shapes: Sequence[ObjectShape], gripping: bool = False) -> mujoco.MjModel:
    """
    Compile the MuJoCo model of a table with a gripper and the given objects.

    Generalised positions: gripper x, y, z, left and right finger (5 slide joints), then one free
    joint for each object. Controls: targets of gripper x, y, z and of the two fingers, in metres.

    :param shapes: sequence of ObjectShape.
    :param gripping: take the hand that grips, and let friction hold what is in it; pushing does
        without, for speed.
    :return: mujoco.MjModel.
    """
    spec = mujoco.MjSpec()
    spec.option.timestep = TIMESTEP
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    spec.option.cone = mujoco.mjtCone.mjCONE_PYRAMIDAL
    # Soft friction lets what is held creep down: solve for no slip.
    spec.option.iterations, spec.option.ls_iterations, spec.option.noslip_iterations = (
        (50, 20, 5) if gripping else (20, 8, 0))
    world = spec.worldbody
    world.add_geom(
        name='table', type=mujoco.mjtGeom.mjGEOM_PLANE, size=[3, 3, 0.1],
        friction=[1, 0.01, 0.0002])
    _add_gripper(spec, world, *(GRIPPER, GRIP) if gripping else (PUSHER, SLIDE))
    for name, shape in zip(object_names(len(shapes)), shapes):
        _add_object(world, name, shape)
    return spec.compile()


def _add_gripper(spec: mujoco.MjSpec, world: mujoco.MjsBody, hand: Hand,
                 surface: dict[str, Any]) -> None:
    """Add the gripper on three slide joints, and two fingers that open along x."""
    gripper = world.add_body(
        name='gripper', pos=[0, 0, FINGER_CLEARANCE], gravcomp=1, mass=0.5, inertia=[1e-3] * 3,
        explicitinertial=True)
    arm = {'group': ARM_GEOM_GROUP, 'density': 0, **surface}
    gripper.add_geom(
        name='palm', type=mujoco.mjtGeom.mjGEOM_BOX, size=list(hand.palm),
        pos=[0, 0, 2 * hand.finger[2] + hand.palm[2]], rgba=[*hand.palm_colour, 1],
        contype=0, conaffinity=0, **arm)
    # Weak downwards: fingers that come down on an object rest on it and do not shoot it away.
    for name, axis, limit in zip(GRIPPER_JOINTS[:3], np.eye(3), (30, 30, 8)):
        gripper.add_joint(name=name, type=mujoco.mjtJoint.mjJNT_SLIDE, axis=list(axis))
        _add_servo(spec, name, kp=1500, kv=60, limit=limit)
    for side, sign in (('left', -1), ('right', 1)):
        finger = gripper.add_body(
            name=f'{side}_finger', pos=[sign * (hand.finger[0] + FINGER_GAP), 0, hand.finger[2]],
            gravcomp=1, mass=0.05, inertia=[1e-4] * 3, explicitinertial=True)
        # Fingers touch objects (bit 1), neither each other nor the table.
        finger.add_geom(
            name=f'{side}_finger', type=mujoco.mjtGeom.mjGEOM_BOX, size=list(hand.finger),
            rgba=[*hand.finger_colour, 1], contype=2, conaffinity=0, **arm)
        finger.add_joint(
            name=f'{side}_finger', type=mujoco.mjtJoint.mjJNT_SLIDE, axis=[sign, 0, 0])
        _add_servo(spec, f'{side}_finger', kp=400, kv=10, limit=20)


def _add_servo(spec: mujoco.MjSpec, joint: str, kp: float, kv: float, limit: float) -> None:
    """Add a position servo on a joint: force = kp (target - position) - kv velocity."""
    actuator = spec.add_actuator(
        name=joint, target=joint, trntype=mujoco.mjtTrn.mjTRN_JOINT, forcelimited=True,
        forcerange=[-limit, limit])
    actuator.set_to_position(kp=kp, kv=kv)


def _add_object(world: mujoco.MjsBody, name: str, shape: ObjectShape) -> None:
    """Add one free object; its parts share a body."""
    body = world.add_body(name=name, pos=[0, 0, HALF_HEIGHT])
    body.add_freejoint(name=name)
    for i, (size, centre, colour) in enumerate(
            zip(shape.half_sizes, shape.centres, shape.colours)):
        disc = shape.kind == 'disc'
        # With rolling friction (condim 6), else a disc that is tipped onto its rim rolls away.
        rolling = {'condim': 6, 'friction': [1, 0.01, 0.005]} if disc else SLIDE
        body.add_geom(
            name=f'{name}_part_{i}', pos=[*centre, 0],
            type=mujoco.mjtGeom.mjGEOM_CYLINDER if disc else mujoco.mjtGeom.mjGEOM_BOX,
            size=[*size, 0] if disc else list(size), rgba=[*colour, 1],
            density=300, contype=1, conaffinity=3, **rolling)
