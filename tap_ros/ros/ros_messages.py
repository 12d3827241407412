# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Messages of ROS made from the fields that tap_ros/messages/ encodes arrays to."""

import array
from collections.abc import Callable, Mapping
from functools import cache
from importlib import import_module
from typing import Any, ParamSpec, TypeVar

import numpy as np
from sensor_msgs.msg import CameraInfo, Image, JointState
from tap_msgs.msg import ObjectStates, Subgoal
from tap_ros.base.errors import ConfigError
from tap_ros.base.text import escaped
from tap_ros.messages import images, joints, objects, subgoals

P = ParamSpec('P')
M = TypeVar('M')


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
    message = message_type()
    for name, value in fields.items():
        if isinstance(value, Mapping):
            value = make_message(type(getattr(message, name)), value)
        elif isinstance(value, list) and value and isinstance(value[0], Mapping):
            kind = message_type.get_fields_and_field_types()[name]  # type: ignore[attr-defined]
            package, kind = kind.removeprefix('sequence<').removesuffix('>').split('/')
            value = [make_message(message_class(f'{package}/msg/{kind}'), one) for one in value]
        elif isinstance(value, np.ndarray):
            # Any other type than array.array is checked byte by byte, which takes milliseconds.
            value = array.array('B', value.tobytes())
        setattr(message, name, value)
    return message


def _encoder(message_type: type[M], fields: Callable[P, dict[str, Any]]) -> Callable[P, M]:
    """Return a function that makes a message of what `fields` returns."""
    def encode(*args: P.args, **kwargs: P.kwargs) -> M:
        return make_message(message_type, fields(*args, **kwargs))
    return encode


encode_image = _encoder(Image, images.image_fields)
encode_map = _encoder(Image, images.map_fields)
encode_mask = _encoder(Image, images.mask_fields)
encode_camera_info = _encoder(CameraInfo, images.camera_info_fields)
encode_joints = _encoder(JointState, joints.joint_fields)
encode_objects = _encoder(ObjectStates, objects.objects_fields)
encode_subgoal = _encoder(Subgoal, subgoals.subgoal_fields)
