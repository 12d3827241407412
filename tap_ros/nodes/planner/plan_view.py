# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Plans as markers and as a picture, for rviz2, Foxglove and any other viewer."""

from typing import TYPE_CHECKING

import cv2
from geometry_msgs.msg import Point
import numpy as np
from sensor_msgs.msg import Image
from std_msgs.msg import ColorRGBA
from tap_ros.contract import WORKSPACE_HIGH, WORKSPACE_LOW, WORLD_FRAME
from tap_ros.images.drawing import draw_crosses, enlarge
from tap_ros.nodes.ros_messages import encode_image
from tap_ros.nodes.topics import STREAM, to_stamp
from tap_ros.planning.table import project
import torch
from visualization_msgs.msg import Marker, MarkerArray

if TYPE_CHECKING:
    from builtin_interfaces.msg import Time
    from rclpy.node import Node
    from tap_ros.planning.forward_model import ForwardModelConfig
    from tap_ros.planning.hierarchy import Target
    from tap_ros.planning.reach import Command
    from tap_ros.planning.visual_mpc import Plan

SCALE, LARGEST = 6, 640  # times that a picture is enlarged, unless it gets wider than so many px
SHIFT = 4  # bits of a pixel's fractions, for cv2
FARTHEST = 2**14  # px; what is farther away is not seen, but could be too far for cv2
EDGE = (20, 20, 20)  # rgb, around what has to stand out
CHOSEN, ELITES, GRIPPER = (255, 225, 40), (150, 225, 255), (255, 50, 50)
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


def draw_plan(image: np.ndarray, config: 'ForwardModelConfig', plan: 'Plan', gripper: np.ndarray,
              targets: np.ndarray) -> np.ndarray:
    """
    Draw where a plan and those it was chosen from lead the fingertips, and where objects shall be.

    :param image: uint8 (H, W, 3) rgb, as the planner sees it.
    :param config: of the forward model that sees these pictures.
    :param plan: visual_mpc.Plan.
    :param gripper: (4,) m, opening: where the plan begins.
    :param targets: (K, 2) (u, v), where the objects shall be.
    :return: uint8 (H * scale, W * scale, 3), enlarged by scale_of(W): the elites' ways thin, the
        chosen one bold, the gripper a dot, the targets crosses in OBJECT_COLOURS.
    """
    scale = scale_of(image.shape[1])
    canvas = enlarge(image, scale)

    def seen(actions: np.ndarray) -> np.ndarray:
        """Return where actions lead, (N + 1, 2) in fractions of the canvas' pixels, for cv2."""
        pixels = fingertip_pixels(config, way(actions, gripper))
        at = np.nan_to_num((pixels + 0.5) * scale - 0.5, nan=-FARTHEST)
        return np.rint(at.clip(-FARTHEST, FARTHEST) * 2**SHIFT).astype(np.int32)

    thin = max(scale // 4, 1)
    for actions in plan.elites:
        cv2.polylines(canvas, [seen(actions)], False, ELITES, thin, cv2.LINE_AA, SHIFT)
    chosen = seen(plan.actions)
    for colour, width in ((EDGE, 5 * thin), (CHOSEN, 3 * thin)):
        cv2.polylines(canvas, [chosen], False, colour, width, cv2.LINE_AA, SHIFT)
    draw_crosses(canvas, targets, scale, EDGE)
    here = chosen[0].tolist()
    for colour, radius in ((EDGE, scale + thin), (GRIPPER, scale)):
        cv2.circle(canvas, here, radius << SHIFT, colour, cv2.FILLED, cv2.LINE_AA, SHIFT)
    return canvas


def scale_of(width: int) -> int:
    """Return how many times a picture of this width in pixels is enlarged."""
    return max(min(SCALE, LARGEST // width), 1)


def fingertip_pixels(config: 'ForwardModelConfig', points: np.ndarray) -> np.ndarray:
    """
    Return where fingertips are in the picture, as far as the forward model knows.

    Its table says where in the picture they touch what lies there. Its arm is about the middle of
    hand and shadow, so that it only says how the picture changes with their height.

    :param points: (N, 3) m.
    :return: (N, 2) (u, v).
    """
    at = torch.from_numpy(points)
    low = at * torch.tensor([1.0, 1.0, 0.0])
    table = torch.tensor(config.table, dtype=at.dtype).view(3, 3)
    arm = torch.tensor(config.arm, dtype=at.dtype).view(3, 4)
    return (project(table, at[:, :2]) + project(arm, at) - project(arm, low)).numpy()


def way(actions: np.ndarray, gripper: np.ndarray) -> np.ndarray:
    """
    Return where actions lead the fingertips.

    :param actions: (N, 4) m per control period.
    :param gripper: (4,), where they begin.
    :return: (N + 1, 3) m, within the workspace.
    """
    points = np.empty((len(actions) + 1, 3))
    points[0] = gripper[:3]
    for step, move in enumerate(np.asarray(actions, float)[:, :3]):
        points[step + 1] = np.clip(points[step] + move, WORKSPACE_LOW, WORKSPACE_HIGH)
    return points
