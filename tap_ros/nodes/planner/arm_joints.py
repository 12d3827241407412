# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The gripper's state from the six joints of a UR10e, as its driver publishes them."""

import math
from typing import TYPE_CHECKING

from sensor_msgs.msg import JointState
from tap_ros.contract import GRIPPER_JOINTS, WORLD_FRAME
from tap_ros.errors import PlanningError
from tap_ros.nodes.joint_history import JointHistory
from tap_ros.nodes.object_messages import encode_joints
from tap_ros.nodes.topics import to_stamp
from tap_ros.robots import ur10e
from tap_ros.text import listing

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


def tells_gripper(message: JointState) -> bool:
    """Tell whether joint states say where the gripper is, as those of the simulator do."""
    return not set(PLACE).isdisjoint(message.name)


class ArmJoints:
    """
    Find the gripper by forward kinematics at the moment of a picture.

    :param params: Parameters of the node, with those of declare_mount, joint_prefix and
        max_silence.
    :ivar used: whether joint states of the arm have come.
    """

    def __init__(self, params: 'Parameters') -> None:
        self._params = params
        self._mount = declared_mount(params)
        prefix = params['joint_prefix']
        self._history = JointHistory([prefix + name for name in ur10e.JOINTS])
        self._opening: float | None = None
        self.used = False

    @property
    def received(self) -> float:
        """Monotonic time at which the joint heard least recently was heard."""
        return self._history.received

    def take(self, message: JointState, received: float) -> bool:
        """
        Take joint states that do not tell where the gripper is.

        :return: whether they tell something new of the arm.
        :raises TapError: when there is nothing in them, or nothing that can be used.
        """
        known = dict(zip(message.name, message.position))
        opening = known.get(OPENING)
        if opening is not None and math.isfinite(opening):
            self._opening = opening
        new = self._history.add(message, received)
        self.used |= not self._history.missing()
        if not self.used and set(self._history.names).isdisjoint(known) and OPENING not in known:
            raise PlanningError(
                f'has neither {", ".join(PLACE)} nor '
                f'{", ".join(self._history.names)}; it has {listing(known) or "no joints"}')
        return new

    def state(self, stamp_ns: int) -> tuple[JointState, float]:
        """
        Return the gripper's state at the time of a picture, and when it was received.

        :return: sensor_msgs/JointState of GRIPPER_JOINTS with the stamp of the picture, and a
            monotonic time.
        :raises KinematicsError: when the arm's joints are not known for that time.
        """
        found = self._history.at(stamp_ns, self._params['max_silence'])
        opening = self._params['fixed_opening'] if self._opening is None else self._opening
        gripper = [*ur10e.gripper_at(found.positions, self._mount), opening]
        return encode_joints(gripper, to_stamp(stamp_ns), WORLD_FRAME), found.received
