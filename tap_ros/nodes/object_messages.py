# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Objects, gripper and camera geometry: messages to arrays and back."""

from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING

from geometry_msgs.msg import Point, Pose, Quaternion
import numpy as np
from sensor_msgs.msg import CameraInfo, JointState
from tap_msgs.msg import ObjectState, ObjectStates
from tap_ros.contract import GRIPPER_JOINTS
from tap_ros.errors import ImageError, PlanningError
from tap_ros.images.crop import Crop
from tap_ros.images.pixels import in_picture
from tap_ros.robots import ur10e
from tap_ros.text import escaped, listing

if TYPE_CHECKING:
    from builtin_interfaces.msg import Time

MAX_OBJECTS = 32  # in one list; every one costs a map of each picture that is predicted
MAX_NAME = 100  # characters
MAX_PIXELS = 2**24  # of a camera


def encode_objects(names: Iterable[str], pixels: np.ndarray, poses: np.ndarray, stamp: 'Time',
                   frame_id: str, source: str) -> ObjectStates:
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


def decode_objects(message: ObjectStates, name: str,
                   size: Sequence[int] | None = None) -> tuple[tuple[str, ...], np.ndarray]:
    """
    Turn a message into names and pixels.

    :param message: tap_msgs/ObjectStates.
    :param name: how an error calls it, for example 'goal_objects'.
    :param size: (height, width) of the picture that the pixels must be in, or None for any.
    :return: names, a tuple of K strings, and pixels, float32 (K, 2) as (u, v).
    :raises PlanningError: for too many objects, for names that are empty, too long or used twice,
        and for pixels that are unknown or outside the picture.
    """
    if len(message.objects) > MAX_OBJECTS:
        raise PlanningError(
            f'{name}: has {len(message.objects)} objects; at most {MAX_OBJECTS} are taken')
    names = tuple(state.name for state in message.objects)
    pixels = np.array([(state.u, state.v) for state in message.objects]).reshape(len(names), 2)
    for index, object_name in enumerate(names):
        if not object_name or object_name in names[:index]:
            raise PlanningError(
                f"{name}: objects[{index}].name is '{escaped(object_name, MAX_NAME)}'; "
                'every object needs a name of its own')
        if len(object_name) > MAX_NAME:
            raise PlanningError(
                f'{name}: objects[{index}].name has {len(object_name)} characters; '
                f'at most {MAX_NAME} are taken')
        _check_pixel(f'{name}: {escaped(object_name)}', pixels[index], size)
    return names, pixels.astype(np.float32)


def decode_cut_objects(message: ObjectStates, name: str, size: Sequence[int],
                       crop: Crop) -> tuple[tuple[str, ...], np.ndarray]:
    """
    Decode objects of a picture of which only a part is used.

    :param message: tap_msgs/ObjectStates, pixels in the whole picture.
    :param name: how an error calls it.
    :param size: (height, width) of the whole picture.
    :param crop: Crop.
    :return: names, and pixels float32 (K, 2) in the part, scaled like it.
    :raises PlanningError: as decode_objects, and for an object that is not in the part.
    """
    names, pixels = decode_objects(message, name, size)
    cut = crop.pixels(pixels, size)
    outside = [names[i] for i in np.flatnonzero(~in_picture(cut, crop.cut_size(size)))]
    if outside:
        left, top, width, height = crop.window(size)
        raise PlanningError(
            f'{name}: {listing(outside)} not in the part of the picture that the weights see, '
            f'{width}x{height} pixels from ({left}, {top}) on; leave it out')
    return names, cut


def _check_pixel(name: str, pixel: np.ndarray, size: Sequence[int] | None) -> None:
    """Refuse a pixel (u, v) that is unknown, or not in a picture of this (height, width)."""
    if size is None:
        with np.errstate(over='ignore'):  # what float32 cannot hold becomes infinite
            pixel = pixel.astype(np.float32)
    u, v = pixel
    if not np.isfinite(pixel).all():
        raise PlanningError(f'{name} has the pixel ({u}, {v}); expected finite numbers, '
                            'leave out objects that are not seen')
    if size is None:
        return
    height, width = size
    if not in_picture(pixel, size):
        raise PlanningError(
            f'{name} has the pixel ({u}, {v}), which is outside the picture; expected u from -0.5 '
            f'to {width - 0.5} and v from -0.5 to {height - 0.5}, leave out objects that are not '
            'seen')


def match_objects(names: Sequence[str], other_names: Sequence[str], other_pixels: np.ndarray,
                  name: str, other_name: str) -> np.ndarray:
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
            f'{other_name}: lacks {listing(missing)} of {name}; it has '
            f'{listing(other_names) or "no objects"}')
    return other_pixels[[other_names.index(object_name) for object_name in names]]


def encode_joints(gripper: Iterable[float], stamp: 'Time', frame_id: str,
                  arm: Iterable[float] | None = None) -> JointState:
    """
    Turn the state of gripper and arm into a message.

    :param gripper: (4,) x, y, z in metres and opening from 0 to 1.
    :param stamp: builtin_interfaces/Time.
    :param frame_id: frame of the position.
    :param arm: (6,) rad of the UR10e, or None without one.
    :return: sensor_msgs/JointState with the names GRIPPER_JOINTS, then the arm's.
    """
    names, positions = [*GRIPPER_JOINTS], [*gripper]
    if arm is not None:
        names, positions = [*names, *ur10e.JOINTS], [*positions, *arm]
    message = JointState(name=names, position=[float(x) for x in positions])
    message.header.stamp = stamp
    message.header.frame_id = frame_id
    return message


def decode_gripper(message: JointState, name: str = 'joint_states') -> np.ndarray:
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
            f'{name}: lacks {", ".join(missing)}; it has {listing(positions) or "no joints"}')
    gripper = np.array([positions[joint] for joint in GRIPPER_JOINTS], np.float32)
    for joint, position in zip(GRIPPER_JOINTS, gripper):
        if not np.isfinite(position):
            raise PlanningError(f'{name}: {joint} is at {position}; expected finite numbers')
    return gripper


def encode_camera_info(K: np.ndarray, size: Sequence[int], stamp: 'Time',
                       frame_id: str) -> CameraInfo:
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


def decode_camera_info(message: CameraInfo,
                       rectified: bool) -> tuple[np.ndarray, tuple[int, int]]:
    """
    Return the intrinsics of the pictures that a camera sends, after its region and binning.

    :param rectified: the pictures are rectified: P counts, else K.
    :return: (3, 3) in pixels, and (height, width).
    :raises ImageError: for lenses that bend lines, and for numbers that no camera has.
    """
    name = 'camera/camera_info'
    if not rectified and any(message.d):
        raise ImageError(f'{name}: its lens bends straight lines (d is not zero); rectify the '
                         'pictures (image_proc), and set the parameter rectified')
    K = np.array(message.p if rectified else message.k).reshape(3, -1)[:, :3].copy()
    roi = message.roi
    region = (roi.height or message.height, roi.width or message.width)
    bins = np.array([max(message.binning_x, 1), max(message.binning_y, 1)])
    height, width = region[0] // int(bins[1]), region[1] // int(bins[0])
    K[:2, 2] -= roi.x_offset, roi.y_offset
    K[:2] /= bins[:, None]
    if not (np.isfinite(K).all() and (np.abs(K) < 1e6).all() and K[0, 0] > 0 and K[1, 1] > 0
            and np.array_equal(K[2], [0, 0, 1])):
        raise ImageError(f'{name}: {"p" if rectified else "k"} is not that of a camera; expected '
                         'focal lengths above 0 in pixels, and 0, 0, 1 in its last row')
    if not 0 < height * width <= MAX_PIXELS:
        raise ImageError(f'{name}: pictures of {width}x{height} pixels (width x height); expected '
                         f'1 to {MAX_PIXELS} pixels')
    return K, (height, width)
