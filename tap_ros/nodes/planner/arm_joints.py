# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Parameters of nodes that say which arm it is, and where it stands."""

from dataclasses import replace
import math
from typing import TYPE_CHECKING

from tap_ros.contract import GRIPPER_JOINTS
from tap_ros.plugins import names
from tap_ros.robots.arm import Arm, DEFAULT_ARM, get_arm, Mount

if TYPE_CHECKING:
    from tap_ros.nodes.parameters import Parameters

PLACE, OPENING = GRIPPER_JOINTS[:3], GRIPPER_JOINTS[3]


def declare_arm(parameters: 'Parameters') -> None:
    """Declare which arm it is whose joint states do not tell where the gripper is, and where."""
    arm = parameters.declare(
        'arm', DEFAULT_ARM, 'The arm. Heeded, as where it stands, where joint_states has its '
        'joints and not gripper_x.', choices=names('tap_ros.arms'))
    declare_mount(parameters, arm)


def declare_mount(parameters: 'Parameters', arm: str) -> None:
    """Declare where an arm stands; by default at the simulated table."""
    default = get_arm(arm).mount
    for axis, value in zip('xyz', default.position):
        parameters.declare(
            f'mount_{axis}', value, f'{axis} of the base of the arm in the world, m; of its '
            'controller\'s frame "base".', low=-10.0, high=10.0)
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


def declared_arm(parameters: 'Parameters') -> Arm:
    """Return the Arm that declare_arm's parameters say, which stands where they say."""
    return replace(get_arm(parameters['arm']), mount=declared_mount(parameters))


def declared_mount(parameters: 'Parameters') -> Mount:
    """Return the Mount that the parameters say."""
    x, y, z = (parameters[f'mount_{axis}'] for axis in 'xyz')
    return Mount((x, y, z), parameters['mount_turn'], parameters['tool_length'])
