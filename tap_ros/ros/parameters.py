# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Parameters with a description and a range, and those that several nodes have."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, fields
import math
import re
from typing import Any

import numpy as np
from rcl_interfaces.msg import (
    FloatingPointRange,
    IntegerRange,
    ParameterDescriptor,
    SetParametersResult,
)
from rclpy.exceptions import InvalidParameterTypeException, InvalidParameterValueException
from rclpy.node import Node
from rclpy.parameter import Parameter
from tap_ros.base import plugins
from tap_ros.base.contract import CONTROL_PERIOD, ROBOT_MASKS
from tap_ros.base.errors import ConfigError
from tap_ros.base.text import listing
from tap_ros.robots.arm import DEFAULT_ARM, get_arm, Mount

FARTHEST = 100.0  # m; no camera is there
MOUNT = 'mount_x', 'mount_y', 'mount_z', 'mount_turn'  # parameters that tf_static can replace
OF_RCLPY = {'use_sim_time', 'start_type_description_service'}  # parameters of any node


def setting(default: Any, **limits: Any) -> Any:
    """
    Return a field of a dataclass of parameters, whose `:param` lines describe them.

    :param limits: what else Parameters.declare takes; plugins: the choices are the names of this
        group of entry points.
    """
    return field(default=default, metadata=limits)


@dataclass(frozen=True)
class Shared:
    """
    Parameters that several nodes have.

    :param autostart: Load the weights and be active at once; false: wait for the transitions
        configure and activate.
    :param device: Where the network runs, as torch names it: cpu, cuda.
    :param image_transport: How the camera sends pictures: sensor_msgs/Image on camera/image_raw
        (raw), or CompressedImage (JPEG, PNG, WebP) on camera/image_raw/compressed (compressed).
    :param robot_mask: What camera/robot_mask takes out of the pictures: nothing (none), the arm
        with its shadow (arm), or the whole robot (all). What was seen there free last takes its
        place.
    :param control_period: Seconds (of image stamps) that the arm takes for one command: it moves
        by its velocity times this.
    :param joint_prefix: What the names of the robot's joints begin with in joint_states, before
        shoulder_pan_joint and so on.
    :param arm: The arm. Heeded, as where it stands, where joint_states has its joints and not
        gripper_x.
    :param fixed_opening: Opening of the gripper, 0 to 1, where no joint_states has
        gripper_opening; 0 is closed, as for pushing.
    """

    autostart: bool = True
    device: str = setting('cpu', choices=('cpu', 'cuda'))
    image_transport: str = setting('raw', choices=('raw', 'compressed'))
    robot_mask: str = setting('none', choices=ROBOT_MASKS)
    control_period: float = setting(CONTROL_PERIOD, between=(0.05, 10.0))
    joint_prefix: str = ''
    arm: str = setting(DEFAULT_ARM, plugins='tap_ros.arms')
    fixed_opening: float = setting(0.0, between=(0.0, 1.0))


@dataclass(frozen=True)
class MountParameters:
    """
    Where an arm stands; given none of mount_x to mount_turn, where tf_static says that it does.

    :param mount_x: x of the base of the arm in the world, m; of its controller's frame "base".
    :param mount_y: y of the base of the arm in the world, m; of its controller's frame "base".
    :param mount_z: z of the base of the arm in the world, m; of its controller's frame "base".
    :param mount_turn: Turn of that frame about the vertical, rad; the base stands upright.
    :param mount_frame: The base on tf_static, where "world" is another frame of it; empty:
        joint_prefix and "base".
    :param tool_length: From the flange to the fingertips along its z, m.
    """

    mount_x: float = setting(0.0, between=(-10.0, 10.0))
    mount_y: float = setting(0.0, between=(-10.0, 10.0))
    mount_z: float = setting(0.0, between=(-10.0, 10.0))
    mount_turn: float = setting(0.0, between=(-2 * math.pi, 2 * math.pi))
    mount_frame: str = ''
    tool_length: float = setting(0.0, between=(0.0, 2.0))


@dataclass(frozen=True)
class CameraParameters:
    """
    Where the camera is, and what counts of its camera_info.

    :param camera_x: x of the camera in the world, for robot_mask_node in base_frame, m.
    :param camera_y: y of the camera in that frame, m.
    :param camera_z: z of the camera in that frame, m. With 0 tracker_node takes camera/pose, or
        the pose that tf_static tells; robot_mask_node does with x, y and z of 0.
    :param camera_qx: x of the quaternion that turns the camera's optical frame (z forward, x
        right, y down in the picture) into that frame.
    :param camera_qy: y of that quaternion.
    :param camera_qz: z of that quaternion.
    :param camera_qw: w of that quaternion.
    :param rectified: The pictures are rectified: P of camera_info counts, else K.
    """

    camera_x: float = setting(0.0, between=(-FARTHEST, FARTHEST))
    camera_y: float = setting(0.0, between=(-FARTHEST, FARTHEST))
    camera_z: float = setting(0.0, between=(-FARTHEST, FARTHEST))
    camera_qx: float = setting(1.0, between=(-1.0, 1.0))
    camera_qy: float = setting(0.0, between=(-1.0, 1.0))
    camera_qz: float = setting(0.0, between=(-1.0, 1.0))
    camera_qw: float = setting(0.0, between=(-1.0, 1.0))
    rectified: bool = False


class Parameters:
    """
    The parameters of one node: declare each once, then read them by name.

    :param node: rclpy Node.
    :ivar given: names of those that were given at the start, where rclpy has declared them for
        that; they are declared anew, as the node has them.
    """

    def __init__(self, node: Node) -> None:
        self._node = node
        self.given = set(node.list_parameters([], 0).names) - OF_RCLPY
        for name in self.given:
            node.undeclare_parameter(name)
        self._choices: dict[str, tuple[str, ...]] = {}
        node.add_on_set_parameters_callback(self._check_choices)

    def __getitem__(self, name: str) -> Any:
        """Return the present value."""
        return self._node.get_parameter(name).value

    def declare(self, name: str, default: Any, description: str,
                between: tuple[float, float] | None = None, choices: Sequence[str] | None = None,
                read_only: bool = True) -> Any:
        """
        Declare one parameter and return its value.

        :param name: name of the parameter.
        :param default: its value unless one is given at the start; also sets the type.
        :param description: one sentence with the unit.
        :param between: smallest and largest value of a number.
        :param choices: the only values of a string.
        :param read_only: False if a running node heeds a change.
        :return: the value.
        :raises ConfigError: when the value given at the start is of another type or out of range.
        """
        descriptor = ParameterDescriptor(description=description, read_only=read_only)
        if between is not None and isinstance(default, float):
            low, high = map(float, between)
            descriptor.floating_point_range = [FloatingPointRange(from_value=low, to_value=high)]
        elif between is not None:
            low, high = map(int, between)
            descriptor.integer_range = [IntegerRange(from_value=low, to_value=high)]
        if choices is not None:
            self._choices[name] = tuple(choices)
            descriptor.additional_constraints = 'one of: ' + ', '.join(choices)
        try:
            return self._node.declare_parameter(name, default, descriptor).value
        except (InvalidParameterTypeException, InvalidParameterValueException) as error:
            reason = str(error).split('Reason: ')[-1].removesuffix(f': {name}')
            raise ConfigError(
                f'parameter {name}: {reason}. {description} Default: {default!r}') from error

    def declare_fields(self, kind: type, *names: str, **defaults: Any) -> None:
        """
        Declare the fields of a dataclass.

        :param names: of those to declare; by default all. defaults: other ones than the usual.
        """
        about = dict(re.findall(
            r':param (\w+): (.*?)\s*(?=:param|\Z)', kind.__doc__ or '', re.DOTALL))
        for one in fields(kind):
            if not names or one.name in names:
                limits = dict(one.metadata)
                if 'plugins' in limits:
                    limits['choices'] = plugins.names(limits.pop('plugins'))
                self.declare(one.name, defaults.get(one.name, one.default),
                             ' '.join(about[one.name].split()), **limits)

    def declare_shared(self, *names: str, **defaults: Any) -> None:
        """Declare some of Shared, with their usual or with other defaults."""
        self.declare_fields(Shared, *names, *defaults, **defaults)

    def declare_arm(self) -> None:
        """Declare arm, mount and opening: used for joint states that lack the gripper's."""
        self.declare_shared('arm', 'fixed_opening')
        self.declare_mount(self['arm'])

    def declare_mount(self, arm: str) -> None:
        """Declare the place of an arm; by default at the simulated table."""
        mount = get_arm(arm).mount
        x, y, z = mount.position
        self.declare_fields(MountParameters, mount_x=x, mount_y=y, mount_z=z,
                            mount_turn=mount.yaw, tool_length=mount.tool)

    def camera_pose(self) -> np.ndarray:
        """
        Return the pose (4, 4) of the camera, by CameraParameters.

        :raises ConfigError: for a quaternion of length 0, and for numbers of no pose.
        """
        place, quaternion = ([self[f'camera_{axis}'] for axis in axes]
                             for axes in ('xyz', ('qx', 'qy', 'qz', 'qw')))
        try:
            return pose_matrix(place, quaternion)
        except ConfigError as error:
            raise ConfigError(f'parameters camera_x to camera_qw: {error}') from error

    def _check_choices(self, parameters: Iterable[Parameter]) -> SetParametersResult:
        """Refuse strings that are none of the choices."""
        for parameter in parameters:
            choices = self._choices.get(parameter.name, (parameter.value,))
            if parameter.value not in choices:
                return SetParametersResult(
                    successful=False,
                    reason=f'{parameter.name} is {parameter.value!r}; '
                           f'valid choices: {", ".join(choices)}')
        return SetParametersResult(successful=True)


def check_device(device: str) -> None:
    """
    Raise ConfigError for a device that is not available.

    :param device: 'cpu' or 'cuda'.
    """
    import torch  # here, since it takes seconds, and not every node has a device
    if device == 'cuda' and not torch.cuda.is_available():
        raise ConfigError('parameter device: torch finds no GPU for cuda; valid here: cpu')


def pose_matrix(place: Sequence[float], quaternion: Sequence[float]) -> np.ndarray:
    """
    Return a pose (4, 4) of a place (3,), m, and a quaternion x, y, z, w of any length.

    :raises ConfigError: for a quaternion of length 0, and for numbers of no pose.
    """
    from scipy.spatial.transform import Rotation  # later, since not every node needs it
    if not (np.abs([*place, *quaternion]) <= FARTHEST).all():
        raise ConfigError(f'a pose of {listing([*place, *quaternion])}; expected numbers up to '
                          f'{FARTHEST:g}')
    if not np.linalg.norm(quaternion) > 0.1:
        raise ConfigError('a quaternion of no direction')
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_quat(quaternion).as_matrix()
    pose[:3, 3] = place
    return pose


def declared_mount(parameters: Parameters) -> Mount:
    """Return the place of the arm, by the parameters of declare_mount."""
    x, y, z, turn = (parameters[name] for name in MOUNT)
    return Mount((x, y, z), turn, parameters['tool_length'])
