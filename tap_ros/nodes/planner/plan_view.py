# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Plans as markers and as a picture, for rviz2, Foxglove and any other viewer."""

from typing import TYPE_CHECKING

from geometry_msgs.msg import Point
import numpy as np
from sensor_msgs.msg import Image
from std_msgs.msg import ColorRGBA
from tap_ros.contract import WORLD_FRAME
from tap_ros.nodes.ros_messages import encode_image
from tap_ros.nodes.topics import STREAM, to_stamp
from tap_ros.planning.plan_picture import draw_plan, way
from visualization_msgs.msg import Marker, MarkerArray

if TYPE_CHECKING:
    from builtin_interfaces.msg import Time
    from rclpy.node import Node
    from tap_ros.planning.forward_model import ForwardModelConfig
    from tap_ros.planning.hierarchy import Target
    from tap_ros.planning.reach import Command
    from tap_ros.planning.visual_mpc import Plan

_STYLES = {  # name: type, colour, width in m; a marker's id is its place
    'chosen': (Marker.LINE_STRIP, (1.0, 0.75, 0.0, 1.0), 0.01),
    'elites': (Marker.LINE_LIST, (0.3, 0.7, 1.0, 0.5), 0.003),
    'targets': (Marker.SPHERE_LIST, (0.2, 0.9, 0.3, 0.8), 0.03),
    'gripper': (Marker.SPHERE, (1.0, 0.2, 0.2, 1.0), 0.025)}


class PlanView:
    """Publishes plan/markers and plan/overlay while somebody listens."""

    def __init__(self, node: 'Node') -> None:
        self._markers = node.create_publisher(MarkerArray, 'plan/markers', STREAM)
        self._overlay = node.create_publisher(Image, 'plan/overlay', STREAM)

    def show(self, command: 'Command', target: 'Target', config: 'ForwardModelConfig',
             frame_id: str) -> None:
        """
        Publish a plan.

        :param command: that was sent; target: that it leads to.
        :param config: of the forward model.
        :param frame_id: of the picture.
        """
        plan, seen = command.plan, command.seen
        stamp = to_stamp(seen.stamp_ns)
        if self._markers.get_subscription_count():
            self._markers.publish(encode_plan(plan, seen.gripper, stamp, WORLD_FRAME))
        if self._overlay.get_subscription_count():
            picture = draw_plan(seen.image, config, plan, seen.gripper, target.pixels)
            self._overlay.publish(encode_image(picture, stamp, frame_id))


def encode_plan(plan: 'Plan', gripper: np.ndarray, stamp: 'Time', frame_id: str) -> MarkerArray:
    """
    Draw the way of the fingertips in a plan and in its elites, and the targets of the objects.

    :param plan: visual_mpc.Plan.
    :param gripper: (4,) m, opening: where the plan begins.
    :param stamp: builtin_interfaces/Time of the picture that it answers.
    :param frame_id: of the world.
    :return: visualization_msgs/MarkerArray of four: the chosen way, the other elites, the places
        of the objects on the table, the gripper.
    """
    chosen, *others = (way(actions, gripper) for actions in (plan.actions, *plan.elites))
    points = {
        'chosen': chosen,
        'elites': np.concatenate([np.repeat(one, 2, 0)[1:-1] for one in others] or [chosen[:0]]),
        'targets': np.pad(np.asarray(plan.places, float), ((0, 0), (0, 1)))}
    markers = MarkerArray()
    for number, (name, (kind, colour, width)) in enumerate(_STYLES.items()):
        marker = Marker(ns=name, id=number, type=kind, action=Marker.ADD)
        marker.header.stamp, marker.header.frame_id = stamp, frame_id
        marker.pose.orientation.w = 1.0
        marker.color = ColorRGBA(**dict(zip('rgba', colour)))
        marker.scale.x = width
        if kind not in (Marker.LINE_STRIP, Marker.LINE_LIST):
            marker.scale.y = marker.scale.z = width
        if name == 'gripper':
            marker.pose.position = _point(gripper)
        else:
            marker.points = [_point(each) for each in points[name]]
        markers.markers.append(marker)
    return markers


def _point(values: np.ndarray) -> Point:
    x, y, z = (float(value) for value in values[:3])
    return Point(x=x, y=y, z=z)
