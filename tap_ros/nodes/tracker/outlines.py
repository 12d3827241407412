# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Outlines of objects as messages: in answers, and for viewers on objects/outlines."""

from collections.abc import Sequence
from typing import Any

from geometry_msgs.msg import Point, Point32, Polygon
from rclpy.node import Node
from std_msgs.msg import ColorRGBA
from tap_ros.images.drawing import OBJECT_COLOURS
from tap_ros.ros.topics import STREAM
from tap_ros.tracking.protocols import Tracked
from visualization_msgs.msg import ImageMarker


def polygons(tracked: Tracked) -> list[Polygon]:
    """Return the outline of each object, in pixels of the camera."""
    return [Polygon(points=[Point32(x=float(u), y=float(v)) for u, v in outline])
            for outline in tracked.outlines]


class OutlinePublisher:
    """
    Publishes outlines as long as somebody looks at them.

    :param node: rclpy Node.
    """

    def __init__(self, node: Node) -> None:
        self._publisher = node.create_publisher(ImageMarker, 'objects/outlines', STREAM)

    def send(self, names: Sequence[str], tracked: Tracked, header: Any) -> None:
        """Publish a polygon for each object, its name as ns, in the picture of a header."""
        if not self._publisher.get_subscription_count():
            return
        for k, (name, outline) in enumerate(zip(names, tracked.outlines)):
            r, g, b = (value / 255 for value in OBJECT_COLOURS[k % len(OBJECT_COLOURS)])
            self._publisher.publish(ImageMarker(
                header=header, ns=name, id=k, type=ImageMarker.POLYGON, scale=2.0,
                outline_color=ColorRGBA(r=r, g=g, b=b, a=1.0),
                points=[Point(x=float(u), y=float(v)) for u, v in outline]))
