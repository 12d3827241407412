# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Parameters of robot_mask_node: the robot, its camera, and the light."""

from pathlib import Path

import numpy as np
from rclpy.node import Node
from scipy.spatial.transform import Rotation
from tap_ros.errors import ConfigError
from tap_ros.nodes.parameters import declare_mount, declared_mount, Parameters
from tap_ros.plugins import names
from tap_ros.robots.arm import DEFAULT_ARM, get_arm
from tap_ros.robots.description import robot_description
from tap_ros.robots.silhouette import Light
from tap_ros.robots.urdf import MOST_CHARACTERS, read_urdf, Robot
from tap_ros.text import escaped


def declare_parameters(node: Node) -> Parameters:
    """Declare the parameters of the node."""
    parameters = Parameters(node)
    parameters.declare('urdf', '',
                       'Shape of the robot: a URDF file; the name of an arm: that arm, at '
                       'mount_x and so on; empty: the topic robot_description.')
    parameters.declare('joint_prefix', '',
                       'What names in joint_states begin with, before those of the robot.')
    parameters.declare('hand_link', '',
                       'Link that is the hand, with all that it carries; empty: there is none, or '
                       'with a named arm its own.')
    parameters.declare('hand_radius', 0.06,
                       'With a named arm: radius of a cylinder around the hand, from the flange '
                       'to the fingertips, m.', low=0.001, high=1.0)
    for axis in 'xyz':
        parameters.declare(f'camera_{axis}', 0.0,
                           f'{axis} of the camera in base_frame, m.', low=-100.0, high=100.0)
    for axis, value in zip(('qx', 'qy', 'qz', 'qw'), (1.0, 0.0, 0.0, 0.0)):
        parameters.declare(
            f'camera_{axis}', value, f"{axis[1]} of the quaternion that turns the camera's "
            'optical frame (z forward, x right, y down in the picture) into base_frame.',
            low=-1.0, high=1.0)
    parameters.declare('base_frame', '',
                       'Link of the robot in which the pose of the camera is given; empty: its '
                       'root.')
    parameters.declare('rectified', False,
                       'The pictures are rectified: P of camera_info counts, else K.')
    parameters.declare('dilation', 1.0,
                       'Pixels by which the mask is larger than the shapes on all sides.',
                       low=0.0, high=100.0, read_only=False)
    parameters.declare('shadow', False,
                       'Mark the shadow on the table, too, as of one light from afar.')
    parameters.declare('table_height', 0.0, 'z of the table in base_frame, m.',
                       low=-10.0, high=10.0)
    for axis, value in zip('xyz', (0.0, 0.0, -1.0)):
        parameters.declare(f'light_{axis}', value,
                           f'{axis} of the direction in which the light shines, in base_frame.',
                           low=-100.0, high=100.0)
    parameters.declare('max_silence', 0.35,
                       'Seconds; a picture without joint states nearer to it than this gets no '
                       'mask.', low=0.05, high=60.0, read_only=False)
    named = parameters['urdf'] in names('tap_ros.arms')
    declare_mount(parameters, parameters['urdf'] if named else DEFAULT_ARM)
    return parameters


def named_robot(parameters: Parameters) -> Robot | None:
    """
    Return the robot that the parameter urdf names, None where it comes as a message.

    :raises ConfigError: when the file cannot be used.
    """
    urdf = parameters['urdf']
    if not urdf:
        return None
    if urdf in names('tap_ros.arms'):
        text = robot_description(
            get_arm(urdf), declared_mount(parameters), parameters['hand_radius'])
        return read_urdf(text, urdf)
    path = Path(urdf)
    try:
        if not path.is_file() or path.stat().st_size > MOST_CHARACTERS:
            raise ConfigError(f'parameter urdf: {escaped(urdf)} is no file of at most '
                              f'{MOST_CHARACTERS} bytes; expected a URDF, or '
                              f'one of {", ".join(names("tap_ros.arms"))}')
        return read_urdf(path.read_text('utf-8', 'replace'), escaped(urdf))
    except (OSError, ValueError) as error:
        raise ConfigError(f'parameter urdf: {escaped(urdf)}: {escaped(error)}') from error


def declared_light(parameters: Parameters) -> Light | None:
    """
    Return the light whose shadows are marked, if they are.

    :raises ConfigError: for a light that does not shine down.
    """
    if not parameters['shadow']:
        return None
    direction = np.array([parameters[f'light_{axis}'] for axis in 'xyz'])
    if direction[2] >= 0:
        raise ConfigError(f'parameter light_z: is {direction[2]:g}; expected less than 0: light '
                          'shines down')
    return Light(direction, parameters['table_height'])


def camera_pose(parameters: Parameters) -> np.ndarray:
    """
    Return the pose (4, 4) of the camera in base_frame.

    :raises ConfigError: for a quaternion of length 0.
    """
    quaternion = [parameters[f'camera_{axis}'] for axis in ('qx', 'qy', 'qz', 'qw')]
    if np.linalg.norm(quaternion) < 0.1:
        raise ConfigError('parameters camera_qx to camera_qw: a quaternion of no direction')
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_quat(quaternion).as_matrix()
    pose[:3, 3] = [parameters[f'camera_{axis}'] for axis in 'xyz']
    return pose
