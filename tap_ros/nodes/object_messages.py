# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Objects, gripper and camera geometry: messages to arrays and back."""

from geometry_msgs.msg import Point, Pose, Quaternion
import numpy as np
from sensor_msgs.msg import CameraInfo, JointState
from tap_msgs.msg import ObjectState, ObjectStates
from tap_ros.errors import PlanningError

GRIPPER_JOINTS = ('gripper_x', 'gripper_y', 'gripper_z', 'gripper_opening')


def encode_objects(names, pixels, poses, stamp, frame_id, source):
    """
    Turn objects into a message.

    :param names: K strings.
    :param pixels: (K, 2) as (u, v).
    :param poses: (K, 7) x, y, z in metres and quaternion x, y, z, w.
    :param stamp: builtin_interfaces/Time of the image that the pixels belong to.
    :param frame_id: frame of the poses.
    :param source: one of the SOURCE_ constants of ObjectStates.
    :return: tap_msgs/ObjectStates.
    """
    message = ObjectStates(source=source)
    message.header.stamp = stamp
    message.header.frame_id = frame_id
    for name, pixel, pose in zip(names, pixels, poses):
        x, y, z, qx, qy, qz, qw = (float(value) for value in pose)
        message.objects.append(ObjectState(
            name=name, u=float(pixel[0]), v=float(pixel[1]),
            pose=Pose(position=Point(x=x, y=y, z=z),
                      orientation=Quaternion(x=qx, y=qy, z=qz, w=qw))))
    return message


def decode_objects(message, name):
    """
    Turn a message into names and pixels.

    :param message: tap_msgs/ObjectStates.
    :param name: how an error calls it, for example 'goal_objects'.
    :return: names, a tuple of K strings, and pixels, float32 (K, 2) as (u, v).
    :raises PlanningError: for names that are empty or used twice, and for unknown pixels.
    """
    names = tuple(state.name for state in message.objects)
    pixels = np.array([(state.u, state.v) for state in message.objects], np.float32)
    pixels = pixels.reshape(len(names), 2)
    for index, object_name in enumerate(names):
        if not object_name or object_name in names[:index]:
            raise PlanningError(
                f'{name}: objects[{index}].name is {object_name!r}; '
                'every object needs a name of its own')
        if not np.isfinite(pixels[index]).all():
            u, v = pixels[index]
            raise PlanningError(
                f'{name}: {object_name} has the pixel ({u}, {v}); expected finite numbers, '
                'leave out objects that are not seen')
    return names, pixels


def match_objects(names, other_names, other_pixels, name, other_name):
    """
    Put pixels of the same objects into the same order.

    :param names: K strings, the order wanted.
    :param other_names: at least the same strings, in any order.
    :param other_pixels: (len(other_names), 2).
    :param name: how an error calls the first list.
    :param other_name: how an error calls the second list.
    :return: (K, 2).
    :raises PlanningError: if one of `names` is not among `other_names`.
    """
    missing = [object_name for object_name in names if object_name not in other_names]
    if missing:
        raise PlanningError(
            f'{other_name}: lacks {", ".join(missing)} of {name}; it has '
            f'{", ".join(other_names) or "no objects"}')
    return other_pixels[[other_names.index(object_name) for object_name in names]]


def encode_gripper(gripper, stamp, frame_id):
    """
    Turn the gripper's state into a message.

    :param gripper: (4,) x, y, z in metres and opening from 0 to 1.
    :param stamp: builtin_interfaces/Time.
    :param frame_id: frame of the position.
    :return: sensor_msgs/JointState with the names GRIPPER_JOINTS.
    """
    message = JointState(name=list(GRIPPER_JOINTS), position=[float(x) for x in gripper])
    message.header.stamp = stamp
    message.header.frame_id = frame_id
    return message


def decode_gripper(message, name='joint_states'):
    """
    Find the gripper among joints.

    :param message: sensor_msgs/JointState.
    :param name: how an error calls it.
    :return: float32 (4,) x, y, z in metres and opening from 0 to 1.
    :raises PlanningError: when a joint of GRIPPER_JOINTS is missing or not finite.
    """
    positions = dict(zip(message.name, message.position))
    missing = [joint for joint in GRIPPER_JOINTS if joint not in positions]
    if missing:
        raise PlanningError(
            f'{name}: lacks {", ".join(missing)}; it has {", ".join(positions) or "no joints"}')
    gripper = np.array([positions[joint] for joint in GRIPPER_JOINTS], np.float32)
    if not np.isfinite(gripper).all():
        raise PlanningError(f'{name}: the gripper is at {gripper}; expected finite numbers')
    return gripper


def encode_camera_info(K, size, stamp, frame_id):
    """
    Describe a pinhole camera without distortion.

    :param K: (3, 3) intrinsics in pixels.
    :param size: (height, width) of its pictures.
    :param stamp: builtin_interfaces/Time of the picture.
    :param frame_id: frame of the camera.
    :return: sensor_msgs/CameraInfo.
    """
    message = CameraInfo(height=size[0], width=size[1], distortion_model='plumb_bob')
    message.header.stamp = stamp
    message.header.frame_id = frame_id
    message.d = [0.0] * 5
    message.k = [float(x) for x in np.ravel(K)]
    message.r = [float(x) for x in np.ravel(np.eye(3))]
    message.p = [float(x) for x in np.ravel(np.column_stack([K, np.zeros(3)]))]
    return message
