# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
What the UR10e looks like: cylinders and capsules in the frames of its links.

Link 0 is the base; link i turns about its own z with joint i and carries the following link at the
place that the Denavit-Hartenberg parameters say, see ur10e.py. Radii and offsets are near those of
the real arm.
"""

from dataclasses import dataclass

import mujoco
import numpy as np
from tap_ros.robots import ur10e
from tap_ros.robots.ur10e import A2, A3, D1, D4, D5, D6

SILVER = (0.80, 0.81, 0.82)
BLUE = (0.36, 0.58, 0.74)
DARK = (0.16, 0.17, 0.18)
UPPER = 0.176  # m from the shoulder's axis to the middle of the upper arm, along joint 2
FORE = 0.039  # m to the middle of the forearm, along joint 3


@dataclass(frozen=True)
class Primitive:
    """A cylinder, or with round ends a capsule, in the frame of a link; metres."""

    link: int  # 0 to 6
    start: tuple[float, float, float]
    end: tuple[float, float, float]
    radius: float
    colour: tuple[float, float, float]
    capsule: bool = False


def _along_z(link: int, low: float, high: float, radius: float,
             colour: tuple[float, float, float]) -> Primitive:
    """Return a cylinder along a link's z."""
    return Primitive(link, (0, 0, low), (0, 0, high), radius, colour)


PRIMITIVES = (
    _along_z(0, -0.1, 0.0, 0.11, DARK),  # pedestal
    _along_z(0, 0.0, 0.1, 0.095, DARK),
    _along_z(1, 0.1, D1 + 0.085, 0.082, SILVER),
    _along_z(2, 0.0, UPPER - 0.088, 0.08, BLUE),
    _along_z(2, UPPER - 0.088, UPPER + 0.085, 0.084, SILVER),
    _along_z(2, UPPER + 0.085, UPPER + 0.1, 0.078, BLUE),
    Primitive(2, (0, 0, UPPER), (A2, 0, UPPER), 0.062, SILVER, capsule=True),
    Primitive(2, (A2, 0, UPPER - 0.075), (A2, 0, UPPER + 0.075), 0.07, SILVER),
    Primitive(2, (A2, 0, UPPER + 0.075), (A2, 0, UPPER + 0.09), 0.066, BLUE),
    _along_z(3, FORE - 0.075, FORE - 0.06, 0.062, BLUE),
    _along_z(3, FORE - 0.06, FORE + 0.068, 0.066, SILVER),
    Primitive(3, (0, 0, FORE), (A3, 0, FORE), 0.047, SILVER, capsule=True),
    Primitive(3, (A3, 0, FORE - 0.055), (A3, 0, FORE + 0.055), 0.052, SILVER),
    _along_z(4, FORE + 0.055, D4 + 0.05, 0.048, SILVER),
    _along_z(4, D4 + 0.05, D4 + 0.062, 0.045, BLUE),
    _along_z(5, 0.03, D5 + 0.05, 0.048, SILVER),
    _along_z(5, D5 + 0.05, D5 + 0.062, 0.045, BLUE),
    _along_z(6, 0.045, D6 - 0.03, 0.047, SILVER),
    _along_z(6, D6 - 0.03, D6, 0.046, DARK),
    _along_z(6, D6, D6 + 0.05, 0.034, DARK),  # between flange and palm
)


def add_arm(spec: mujoco.MjSpec) -> None:
    """Add the arm's bodies, joints and primitives to a model; nothing of it touches anything."""
    half = ur10e.SIMULATED.yaw / 2
    body = spec.worldbody.add_body(
        name='ur10e_base', pos=ur10e.SIMULATED.position, quat=[np.cos(half), 0, 0, np.sin(half)])
    bodies = [body]
    place, turn = [0.0, 0.0, 0.0], [1.0, 0.0, 0.0, 0.0]
    for name, (a, alpha, d) in zip(ur10e.JOINTS, ur10e.DH):
        body = body.add_body(name=name.replace('_joint', '_link'), pos=place, quat=turn)
        body.mass, body.inertia, body.explicitinertial = 1.0, [0.01] * 3, True
        body.add_joint(name=name, type=mujoco.mjtJoint.mjJNT_HINGE, axis=[0, 0, 1])
        bodies.append(body)
        place, turn = [a, 0, d], [np.cos(alpha / 2), np.sin(alpha / 2), 0, 0]
    for shape in PRIMITIVES:
        kind = mujoco.mjtGeom.mjGEOM_CAPSULE if shape.capsule else mujoco.mjtGeom.mjGEOM_CYLINDER
        bodies[shape.link].add_geom(
            type=kind, fromto=[*shape.start, *shape.end], size=[shape.radius, 0, 0],
            rgba=[*shape.colour, 1], contype=0, conaffinity=0)
