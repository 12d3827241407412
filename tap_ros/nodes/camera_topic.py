# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The topic of the camera's pictures, raw or compressed."""

from typing import TYPE_CHECKING

from sensor_msgs.msg import CompressedImage, Image

if TYPE_CHECKING:
    from tap_ros.nodes.parameters import Parameters

_TRANSPORTS: dict[str, tuple[type, str]] = {
    'raw': (Image, 'camera/image_raw'),
    'compressed': (CompressedImage, 'camera/image_raw/compressed')}


def declare_transport(parameters: 'Parameters') -> None:
    """Declare the parameter image_transport of a node."""
    parameters.declare(
        'image_transport', 'raw',
        'How the camera sends pictures: sensor_msgs/Image on camera/image_raw (raw), or '
        'CompressedImage (JPEG, PNG, WebP) on camera/image_raw/compressed (compressed).',
        choices=tuple(_TRANSPORTS))


def camera_topic(parameters: 'Parameters') -> tuple[type, str]:
    """Return message type and name of the topic, as the parameter says."""
    return _TRANSPORTS[parameters['image_transport']]
