# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Asking predictor_node for subgoals, in the planner's own pixels."""

from collections.abc import Callable
from typing import Any, TYPE_CHECKING

import numpy as np
from tap_msgs.msg import ObjectStates
from tap_msgs.srv import PredictSubgoal
from tap_ros.errors import PlanningError
from tap_ros.messages.subgoals import decode_subgoals
from tap_ros.nodes.clients import call
from tap_ros.nodes.heartbeat import Liveness
from tap_ros.nodes.ros_messages import encode_image, encode_objects
from tap_ros.nodes.topics import SERVICE_QOS, to_stamp
from tap_ros.text import escaped

if TYPE_CHECKING:
    from rclpy.callback_groups import CallbackGroup
    from rclpy.node import Node
    from tap_msgs.action import ReachGoal
    from tap_ros.messages.subgoals import Subgoal
    from tap_ros.nodes.planner.planner_inputs import PlannerInputs
    from tap_ros.planning.reach import Seen


class SubgoalClient:
    """
    Client of predict_subgoal.

    :param inputs: PlannerInputs, whose pictures are sent cut and scaled as the planner sees them:
        so the maps of the answer are in its pixels, whatever the predictor makes of a camera's.
    :param callback_group: of its callbacks, which have to run while a goal is executed.
    """

    def __init__(self, node: 'Node', inputs: 'PlannerInputs',
                 callback_group: 'CallbackGroup') -> None:
        self._inputs = inputs
        self._client = node.create_client(PredictSubgoal, 'predict_subgoal',
                                          qos_profile=SERVICE_QOS, callback_group=callback_group)
        self._alive = Liveness(node, 'predictor_node', callback_group=callback_group)

    def ask(self, request: 'ReachGoal.Goal', seen: 'Seen', goal: dict[str, Any],
            goal_pixels: np.ndarray, timeout_s: float,
            give_up: Callable[[], bool]) -> list['Subgoal']:
        """
        Return the Subgoals of all samples, their objects in the order in which they are seen.

        :param request: says how many samples and levels, and the seed.
        :param seen: the start.
        :param goal: of GoalSource.take; goal_pixels: (K, 2) of the objects of `seen`.
        :param timeout_s: most seconds to wait; give_up: asked whether to stop waiting.
        :raises TapError: when there is no answer, or a refusal.
        """
        picture = goal['image']
        if 'mask' in goal:
            picture = self._inputs.robot.fill_goal(picture, goal['mask'])
        stamp = to_stamp(seen.stamp_ns)
        frame_id = self._inputs.messages['image'].header.frame_id
        assert seen.pixels is not None
        objects, goal_objects = (encode_objects(
            seen.names, pixels, np.full((len(pixels), 7), np.nan), stamp, frame_id,
            ObjectStates.SOURCE_TRACKED) for pixels in (seen.pixels, goal_pixels))
        response = call(self._client, PredictSubgoal.Request(
            start=encode_image(seen.image, stamp, frame_id),
            goal=encode_image(self._inputs.cut(picture, 'goal'), stamp, frame_id),
            start_objects=objects, goal_objects=goal_objects,
            num_samples=request.num_samples, recursion_depth=request.recursion_depth,
            seed=request.seed), timeout_s, give_up, self._alive)
        if not response.success:
            raise PlanningError(f'service {self._client.service_name}: '
                                f'{escaped(response.message, 1000)}')
        return decode_subgoals(response, seen.names, seen.image.shape[:2])
