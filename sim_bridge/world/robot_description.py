# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The URDF of the UR10e at its table, written from the numbers that the simulator uses."""

from xml.etree import ElementTree

import numpy as np
from sim_bridge.world.arm_shape import DARK, PRIMITIVES
from tap_ros.contract import WORLD_FRAME
from tap_ros.robots import ur10e

BASE_FRAME = 'base'  # of the arm, as its controller has it
TIP_FRAME = 'gripper_tip'  # between the fingertips
LINKS = (BASE_FRAME, *(name.replace('_joint', '_link') for name in ur10e.JOINTS))
MAX_EFFORT = (330, 330, 150, 56, 56, 56)  # N m, as published for this arm


def robot_description(mount: ur10e.Mount = ur10e.SIMULATED,
                      hand_radius: float | None = None) -> str:
    """
    Return the URDF.

    Links and joints have the names that Universal Robots' own description gives them. A capsule
    is a cylinder with spheres at its ends.

    :param mount: where the arm stands, and the length of its tool.
    :param hand_radius: m; with a hand, a cylinder around the tool from flange to fingertips; it is
        of the link TIP_FRAME.
    """
    robot = ElementTree.Element('robot', name='ur10e_at_table')
    ElementTree.SubElement(robot, 'link', name=WORLD_FRAME)
    for number, name in enumerate(LINKS):
        link = ElementTree.SubElement(robot, 'link', name=name)
        for shape in PRIMITIVES:
            if shape.link == number:
                _add_cylinder(link, np.array(shape.start), np.array(shape.end), shape.radius,
                              shape.colour, shape.capsule)
    tip = ElementTree.SubElement(robot, 'link', name=TIP_FRAME)
    if hand_radius is not None:
        _add_cylinder(tip, np.array([0, 0, -mount.tool]), np.zeros(3), hand_radius, DARK, False)
    _add_joint(robot, 'world_joint', 'fixed', WORLD_FRAME, BASE_FRAME,
               mount.position, (0, 0, mount.yaw))
    *origins, tip_origin = joint_origins(mount)
    for i, (name, (place, roll)) in enumerate(zip(ur10e.JOINTS, origins)):
        joint = _add_joint(
            robot, name, 'revolute', LINKS[i], LINKS[i + 1], place, (roll, 0, 0))
        ElementTree.SubElement(joint, 'axis', xyz='0 0 1')
        limit = ur10e.JOINT_LIMITS[i]
        ElementTree.SubElement(
            joint, 'limit', lower=_text(-limit), upper=_text(limit),
            velocity=_text(ur10e.SPEED_LIMITS[i]), effort=_text(MAX_EFFORT[i]))
    place, roll = tip_origin
    _add_joint(robot, 'gripper_joint', 'fixed', LINKS[-1], TIP_FRAME, place, (roll, 0, 0))
    ElementTree.indent(robot)
    return ElementTree.tostring(robot, 'unicode', xml_declaration=True)


def joint_origins(
        mount: ur10e.Mount = ur10e.SIMULATED) -> list[tuple[tuple[float, float, float], float]]:
    """
    Return where the frame of each link is in the one before while its joint is at 0.

    A URDF's joint turns about the z of its own link; Denavit-Hartenberg's about that before.

    :param mount: where the arm stands, and the length of its tool.
    :return: x, y, z (m) and roll (rad) of the links behind LINKS[0], then of TIP_FRAME.
    """
    origins = [((0.0, 0.0, 0.0), 0.0), *(((a, 0.0, d), alpha) for a, alpha, d in ur10e.DH)]
    (x, y, z), roll = origins[-1]
    return [*origins[:-1], ((x, y, z + mount.tool), roll)]


def _add_joint(robot: ElementTree.Element, name: str, kind: str, parent: str, child: str,
               place: np.ndarray | tuple[float, float, float],
               turn: tuple[float, float, float]) -> ElementTree.Element:
    """Add a joint at a place (3,) in m with roll, pitch, yaw in rad."""
    joint = ElementTree.SubElement(robot, 'joint', name=name, type=kind)
    ElementTree.SubElement(joint, 'parent', link=parent)
    ElementTree.SubElement(joint, 'child', link=child)
    ElementTree.SubElement(joint, 'origin', xyz=_text(*place), rpy=_text(*turn))
    return joint


def _add_cylinder(link: ElementTree.Element, start: np.ndarray, end: np.ndarray, radius: float,
                  colour: tuple[float, float, float], capsule: bool) -> None:
    """Add a cylinder between two points, to be seen and to be bumped into."""
    along = end - start
    length = float(np.linalg.norm(along))
    x, y, z = along / length
    # Roll and pitch that turn z into the cylinder's direction.
    turn = (0.0, float(np.arctan2(np.hypot(x, y), z)), float(np.arctan2(y, x)))
    for use in ('visual', 'collision'):
        parts = [((start + end) / 2, turn, 'cylinder', {'radius': radius, 'length': length})]
        if capsule:
            parts += [(place, (0.0, 0.0, 0.0), 'sphere', {'radius': radius})
                      for place in (start, end)]
        for place, turned, kind, sizes in parts:
            element = ElementTree.SubElement(link, use)
            ElementTree.SubElement(element, 'origin', xyz=_text(*place), rpy=_text(*turned))
            geometry = ElementTree.SubElement(element, 'geometry')
            ElementTree.SubElement(
                geometry, kind, {name: _text(size) for name, size in sizes.items()})
            if use == 'visual':
                name = '_'.join(f'{round(255 * part):02x}' for part in colour)
                material = ElementTree.SubElement(element, 'material', name=name)
                ElementTree.SubElement(material, 'color', rgba=_text(*colour, 1))


def _text(*numbers: float) -> str:
    """Return numbers as URDF writes them."""
    return ' '.join(repr(float(number)) for number in numbers)
