# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The URDF of an arm at its table, written from the numbers that the simulator uses."""

from collections.abc import Iterable

import numpy as np
from tap_ros.base.contract import WORLD_FRAME
from tap_ros.robots.arm import Arm, BASE_FRAME, DARK, Mount, Primitive, rpy, TIP_FRAME


def robot_description(arm: Arm, mount: Mount | None = None,
                      hand_radius: float | None = None) -> str:
    """
    Return the URDF.

    A capsule is a cylinder with spheres at its ends.

    :param arm: Arm.
    :param mount: where it stands, and the length of its tool; None: at the simulated table.
    :param hand_radius: m; with a hand, a cylinder around the tool from flange to fingertips; it is
        of the link TIP_FRAME.
    """
    mount = mount or arm.mount
    shapes = {WORLD_FRAME: [], TIP_FRAME: [], **{
        name: [shape for shape in arm.shapes if shape.link == number]
        for number, name in enumerate(arm.links)}}
    if hand_radius is not None:
        shapes[TIP_FRAME] = [Primitive(0, (0, 0, -mount.tool), (0, 0, 0), hand_radius, DARK)]
    parts = ['<?xml version="1.0"?>', f'<robot name="{arm.name}_at_table">']
    for name, seen in shapes.items():
        parts += [f'<link name="{name}">', *(part for shape in seen for part in _shape(shape)),
                  '</link>']
    joints = [('world_joint', 'fixed', WORLD_FRAME, BASE_FRAME,
               _origin(mount.position, (0, 0, mount.yaw)))]
    *origins, (_, tip_turn) = arm.origins
    for i, (place, turn) in enumerate(origins):
        low, high, speed, effort = (_text([number]) for number in (
            *arm.limits[i], arm.speeds[i], arm.efforts[i]))
        joints.append((
            arm.joints[i], 'revolute', arm.links[i], arm.links[i + 1],
            f'{_origin(place, rpy(turn))}<axis xyz="0 0 1"/><limit lower="{low}" '
            f'upper="{high}" velocity="{speed}" effort="{effort}"/>'))
    joints.append(('gripper_joint', 'fixed', arm.links[-1], TIP_FRAME,
                   _origin(arm.tip(mount)[:3, 3], rpy(tip_turn))))
    parts += [f'<joint name="{name}" type="{kind}"><parent link="{parent}"/>'
              f'<child link="{child}"/>{inside}</joint>'
              for name, kind, parent, child, inside in joints]
    return '\n'.join([*parts, '</robot>'])


def _shape(shape: Primitive) -> list[str]:
    """Return what is seen and bumped into of a shape."""
    start, end = np.array(shape.start), np.array(shape.end)
    length = float(np.linalg.norm(end - start))
    x, y, z = (end - start) / length
    # Roll and pitch that turn z into the cylinder's direction.
    parts = [(_origin((start + end) / 2, (0, np.arctan2(np.hypot(x, y), z), np.arctan2(y, x))),
              f'<cylinder radius="{_text([shape.radius])}" length="{_text([length])}"/>')]
    if shape.capsule:
        parts += [(_origin(place, (0, 0, 0)), f'<sphere radius="{_text([shape.radius])}"/>')
                  for place in (start, end)]
    name = '_'.join(f'{round(255 * part):02x}' for part in shape.colour)
    material = f'<material name="{name}"><color rgba="{_text((*shape.colour, 1))}"/></material>'
    return [f'<{use}>{origin}<geometry>{geometry}</geometry>{more}</{use}>'
            for use, more in (('visual', material), ('collision', ''))
            for origin, geometry in parts]


def _origin(place: Iterable[float], turn: Iterable[float]) -> str:
    """Return the element of a place (3,) in m, with roll, pitch, yaw in rad."""
    return f'<origin xyz="{_text(place)}" rpy="{_text(turn)}"/>'


def _text(numbers: Iterable[float]) -> str:
    return ' '.join(repr(float(number)) for number in numbers)
