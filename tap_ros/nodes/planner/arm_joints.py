# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Parameters of nodes that say where a UR10e stands whose joint states have its joints alone."""

import math
from typing import TYPE_CHECKING

from tap_ros.contract import GRIPPER_JOINTS
from tap_ros.robots import ur10e

if TYPE_CHECKING:
    from tap_ros.nodes.parameters import Parameters

PLACE, OPENING = GRIPPER_JOINTS[:3], GRIPPER_JOINTS[3]


def declare_mount(parameters: 'Parameters') -> None:
    """Declare where an arm stands whose joint states do not tell where the gripper is."""
    default = ur10e.SIMULATED
    for axis, value in zip('xyz', default.position):
        parameters.declare(
            f'mount_{axis}', value, f'{axis} of the base of a UR10e in the world, m; of its '
            'controller\'s frame "base". Heeded where joint_states has the six joints of the arm '
            'and not gripper_x.', low=-10.0, high=10.0)
    parameters.declare('mount_turn', default.yaw,
                       'Turn of that frame about the vertical, rad; the base stands upright.',
                       low=-2 * math.pi, high=2 * math.pi)
    parameters.declare('tool_length', default.tool,
                       'From the flange to the fingertips along its z, m.', low=0.0, high=2.0)


def declare_opening(parameters: 'Parameters') -> None:
    """Declare how far the gripper is open where nothing tells it."""
    parameters.declare('fixed_opening', 0.0,
                       'Opening of the gripper, 0 to 1, where no joint_states has '
                       'gripper_opening; 0 is closed, as for pushing.', low=0.0, high=1.0)


def declared_mount(parameters: 'Parameters') -> ur10e.Mount:
    """Return the Mount that the parameters say."""
    x, y, z = (parameters[f'mount_{axis}'] for axis in 'xyz')
    return ur10e.Mount((x, y, z), parameters['mount_turn'], parameters['tool_length'])
