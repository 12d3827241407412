# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""A plan as markers, for rviz2, Foxglove and any other viewer of visualization_msgs."""

from typing import TYPE_CHECKING

from geometry_msgs.msg import Point
import numpy as np
from std_msgs.msg import ColorRGBA
from tap_ros.planning.plan_picture import way
from visualization_msgs.msg import Marker, MarkerArray

if TYPE_CHECKING:
    from builtin_interfaces.msg import Time
    from tap_ros.planning.visual_mpc import Plan

CHOSEN, ELITES, TARGETS, GRIPPER = range(4)  # ids
_COLOURS = {CHOSEN: (1.0, 0.75, 0.0, 1.0), ELITES: (0.3, 0.7, 1.0, 0.5),
            TARGETS: (0.2, 0.9, 0.3, 0.8), GRIPPER: (1.0, 0.2, 0.2, 1.0)}
_NAMES = {CHOSEN: 'chosen', ELITES: 'elites', TARGETS: 'targets', GRIPPER: 'gripper'}
_KINDS = {CHOSEN: Marker.LINE_STRIP, ELITES: Marker.LINE_LIST, TARGETS: Marker.SPHERE_LIST,
          GRIPPER: Marker.SPHERE}
_WIDTHS = {CHOSEN: 0.01, ELITES: 0.003, TARGETS: 0.03, GRIPPER: 0.025}  # m


def encode_plan(plan: 'Plan', gripper: np.ndarray, stamp: 'Time', frame_id: str) -> MarkerArray:
    """
    Draw where a plan and those it was chosen from lead the fingertips, and where objects shall be.

    :param plan: visual_mpc.Plan.
    :param gripper: (4,) m, opening: where the plan begins.
    :param stamp: builtin_interfaces/Time of the picture that it answers.
    :param frame_id: of the world.
    :return: visualization_msgs/MarkerArray of four: the chosen way, the other elites, the places
        of the objects on the table, the gripper.
    """
    chosen, *others = (way(actions, gripper) for actions in (plan.actions, *plan.elites))
    points = {
        CHOSEN: chosen,
        ELITES: np.concatenate([np.repeat(one, 2, 0)[1:-1] for one in others] or [chosen[:0]]),
        TARGETS: np.pad(np.asarray(plan.places, float), ((0, 0), (0, 1)))}
    markers = MarkerArray()
    for number, kind in _KINDS.items():
        marker = Marker(ns=_NAMES[number], id=number, type=kind, action=Marker.ADD)
        marker.header.stamp, marker.header.frame_id = stamp, frame_id
        marker.pose.orientation.w = 1.0
        marker.color = ColorRGBA(**dict(zip('rgba', _COLOURS[number])))
        width = _WIDTHS[number]
        marker.scale.x = width
        if kind not in (Marker.LINE_STRIP, Marker.LINE_LIST):
            marker.scale.y = marker.scale.z = width
        if number == GRIPPER:
            marker.pose.position = _point(gripper)
        else:
            marker.points = [_point(each) for each in points[number]]
        markers.markers.append(marker)
    return markers


def _point(values: np.ndarray) -> Point:
    x, y, z = (float(value) for value in values[:3])
    return Point(x=x, y=y, z=z)
