# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Topics as nodes use them: quality of service, message classes, messages made from fields."""

import array
from collections.abc import Callable, Mapping
from functools import cache
from importlib import import_module
from typing import Any, cast, ParamSpec, TypeVar

from builtin_interfaces.msg import Time
import numpy as np
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import CameraInfo, CompressedImage, Image, JointState
from tap_msgs.msg import ObjectStates, Subgoal
from tap_ros.base.errors import ConfigError
from tap_ros.base.text import escaped
from tap_ros.messages import images, joints, objects, subgoals, topics
from tap_ros.messages.topics import Topic
from tap_ros.ros.parameters import Parameters

P = ParamSpec('P')
M = TypeVar('M')

# Reliable and kept for late joiners: goals, the last subgoal.
LATCHED = QoSProfile(depth=1, reliability=ReliabilityPolicy.RELIABLE,
                     durability=DurabilityPolicy.TRANSIENT_LOCAL)
# Reliable, for everything that happens at control rate.
STREAM = QoSProfile(depth=10, reliability=ReliabilityPolicy.RELIABLE,
                    durability=DurabilityPolicy.VOLATILE)
# Of servers: requests that wait to be taken, answers that wait to be received. Of clients: answers
# that wait to be taken, those to all other clients among them, since every client receives all.
# With the default depth of 10, DDS drops what comes beyond without a word.
SERVICE_QOS = QoSProfile(depth=1000, reliability=ReliabilityPolicy.RELIABLE)

LOCK_STEP = 'sim/lock_step'  # latched: whether simulated time passes with commands alone


def of_topic(topic: Topic) -> tuple[type, str]:
    """Return message class and name of a topic, as subscriptions take them."""
    return message_class(topic.type), topic.name


def camera_image(parameters: Parameters) -> tuple[type, str]:
    """Return message class and name of the topic of the camera's pictures."""
    if parameters['image_transport'] == 'compressed':
        return CompressedImage, f'{topics.IMAGE.name}/compressed'
    return of_topic(topics.IMAGE)


def camera_topics(parameters: Parameters) -> dict[str, tuple[type, str]]:
    """
    Return what belongs to a picture of the camera.

    :param parameters: with image_transport and robot_mask.
    :return: {short name: (message class, topic name)}, the picture first; with the robot mask
        when one is used.
    """
    mask = {'mask': of_topic(topics.ROBOT_MASK)} if parameters['robot_mask'] != 'none' else {}
    return {'image': camera_image(parameters), 'objects': of_topic(topics.OBJECTS), **mask}


def goal_topics(robot_mask: str) -> dict[str, tuple[type, str]]:
    """Return the same for the picture of a goal."""
    mask = {'mask': of_topic(topics.GOAL_ROBOT_MASK)} if robot_mask != 'none' else {}
    return {'image': of_topic(topics.GOAL_IMAGE), 'objects': of_topic(topics.GOAL_OBJECTS), **mask}


def to_stamp(nanoseconds: int) -> Time:
    """Return builtin_interfaces/Time."""
    seconds, rest = divmod(int(nanoseconds), 10**9)
    return Time(sec=seconds, nanosec=rest)


@cache
def message_class(type_name: str) -> type[Any]:
    """
    Import the class of a message type.

    :param type_name: for example 'sensor_msgs/msg/Image'.
    :raises ConfigError: when its package is not installed.
    """
    try:
        package, _, name = type_name.split('/')
        return getattr(import_module(f'{package}.msg'), name)
    except (ImportError, AttributeError, ValueError) as error:
        raise ConfigError(
            f'message type {escaped(type_name)} is not installed; source the workspace that has it'
        ) from error


def make_message(message_type: type[M], fields: Mapping[str, Any]) -> M:
    """
    Make a message.

    :param message_type: its class.
    :param fields: by name, nested; bytes are uint8 arrays. What is left out is as by default.
    """
    return _filled(message_type(), fields)


def _filled(message: M, fields: Mapping[str, Any]) -> M:
    """Set fields of a message; return it."""
    for name, value in fields.items():
        if isinstance(value, dict):  # quicker to tell than a Mapping
            _filled(getattr(message, name), value)
            continue
        if isinstance(value, list) and value and isinstance(value[0], dict):
            kind: Any = _class_in_list(cast(Any, type(message)), name)
            value = [_filled(kind(), one) for one in value]
        elif isinstance(value, np.ndarray):
            # Any other type than array.array is checked byte by byte, which takes milliseconds.
            data, value = value.data, array.array('B')
            value.frombytes(data)
        setattr(message, name, value)
    return message


@cache
def _class_in_list(message_type: Any, name: str) -> type[Any]:
    """Return the class of the messages in a list, the field of this name of a message."""
    kind = message_type.get_fields_and_field_types()[name]
    package, kind = kind.removeprefix('sequence<').removesuffix('>').split('/')
    return message_class(f'{package}/msg/{kind}')


def _encoder(message_type: type[M], fields: Callable[P, dict[str, Any]]) -> Callable[P, M]:
    """Return a function that makes a message of what `fields` returns."""
    def encode(*args: P.args, **kwargs: P.kwargs) -> M:
        return make_message(message_type, fields(*args, **kwargs))
    return encode


encode_image = _encoder(Image, images.image_fields)
encode_mask = _encoder(Image, images.mask_fields)
encode_camera_info = _encoder(CameraInfo, images.camera_info_fields)
encode_joints = _encoder(JointState, joints.joint_fields)
encode_objects = _encoder(ObjectStates, objects.objects_fields)
encode_subgoal = _encoder(Subgoal, subgoals.subgoal_fields)
