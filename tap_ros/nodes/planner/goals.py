# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Where a reach_goal request leads: its goal, sent along or by topic, and the subgoals."""

from collections.abc import Callable

import numpy as np
from rclpy.node import Node
from tap_msgs.action import ReachGoal
from tap_msgs.msg import ObjectStates
from tap_ros.base.errors import PlanningError
from tap_ros.messages.images import decode_image, is_empty
from tap_ros.messages.subgoals import decode_subgoals, Subgoal
from tap_ros.nodes.planner.planner_inputs import PlannerInputs
from tap_ros.planning.reach import Observation
from tap_ros.ros.client import Client
from tap_ros.ros.observations import Observations
from tap_ros.ros.robot_view import RobotView
from tap_ros.ros.ros_messages import encode_image, encode_objects
from tap_ros.ros.topics import goal_topics, LATCHED, to_stamp


class GoalSource:
    """
    Goal picture and goal objects, for one request at a time.

    :param robot: PlannerInputs.robot, which knows what the robot hides in a goal picture.
    :param on_message: called with the topic name after each message.
    """

    def __init__(self, node: Node, robot: RobotView, on_message: Callable[[str], object]) -> None:
        self._robot = robot
        types = goal_topics(robot.robot_mask)
        self._newest = Observations(*types, latched=True)
        self._newest.subscribe(node, types, LATCHED, on_message=on_message)

    def begin(self, request: ReachGoal.Goal, mode: str) -> None:
        """Begin a request; the fields that it leaves empty come from their topics."""
        self._request = request
        self._needed = tuple(topic for topic, empty in (
            ('image', mode == 'subgoal' and is_empty(request.goal_image)),
            ('objects', not request.goal_objects.objects)) if empty)
        self._stamp: int | None = None  # of what was taken from topics

    def take(self, timeout_s: float,
             give_up: Callable[[], bool]) -> tuple[np.ndarray | None, ObjectStates]:
        """
        Return goal picture, uint8 (H, W, 3), and goal objects; a direct goal may lack the picture.

        The picture is without the robot where a mask is used and one with its stamp has come.

        :param timeout_s: most seconds to wait; give_up: asked whether to stop waiting.
        :raises TapError: when nothing comes, or the picture cannot be used.
        """
        needed, mask = self._needed, None
        image, objects = self._request.goal_image, self._request.goal_objects
        if needed:
            found = self._newest.wait(needed, timeout_s, give_up=give_up)
            if found is None:
                missing = self._newest.missing(needed) or needed
                raise PlanningError(
                    f'goal: nothing has come on {self._newest.names(missing, explained=True)}; '
                    'publish there (the simulator does at sim/reset), or send goal_image and '
                    'goal_objects along')
            self._stamp = found.stamp_ns
            if 'image' in needed and self._robot.used and not self._newest.missing(['mask']):
                found = self._newest.wait(
                    (*needed, 'mask'), timeout_s, self._stamp - 1, give_up) or found
                mask = found.messages.get('mask')
            # Where it is not needed, it says how large the picture is that the objects are in.
            image = found.messages.get('image', image) if is_empty(image) else image
            objects = found.messages['objects'] if 'objects' in needed else objects
        picture = None if is_empty(image) else decode_image(image, 'goal')
        if picture is not None and mask is not None:
            picture = self._robot.fill_goal(picture, mask)
        return picture, objects

    def changed(self, since: float) -> bool:
        """
        Tell whether take would return another goal now, received before `since`.

        :param since: monotonic time at which the request was accepted.
        :raises PlanningError: if the other goal was received later.
        """
        newest = self._newest.newest(*self._needed) if self._stamp is not None else None
        if newest is None or newest.stamp_ns == self._stamp:
            return False
        if newest.received > since:
            raise PlanningError('the scene has changed: a new goal has come on '
                                f'{self._newest.names(self._needed)}')
        return True


def ask_subgoals(client: Client, inputs: PlannerInputs, request: ReachGoal.Goal, seen: Observation,
                 goal: np.ndarray, goal_pixels: np.ndarray, timeout_s: float,
                 give_up: Callable[[], bool]) -> list[Subgoal]:
    """
    Return the Subgoals of all samples, their objects in the order in which they are seen.

    Pictures are sent cut and scaled as the planner sees them: so the maps of the answer are in its
    pixels, whatever the predictor makes of a camera's.

    :param request: says how many samples and levels, and the seed.
    :param seen: the start.
    :param goal: picture, uint8 (H, W, 3); goal_pixels: (K, 2) of the objects of `seen`.
    :param timeout_s: most seconds to wait; give_up: asked whether to stop waiting.
    :raises TapError: when there is no answer, or a refusal.
    """
    stamp, frame_id = to_stamp(seen.stamp_ns), inputs.frame_id
    objects, goal_objects = (encode_objects(
        seen.names, pixels, None, stamp, frame_id, ObjectStates.SOURCE_TRACKED)
        for pixels in (seen.pixels, goal_pixels))
    response = client.call(
        'predict', timeout_s, give_up, start=encode_image(seen.image, stamp, frame_id),
        goal=encode_image(inputs.cut(goal, 'goal'), stamp, frame_id),
        start_objects=objects, goal_objects=goal_objects, num_samples=request.num_samples,
        recursion_depth=request.recursion_depth, seed=request.seed)
    return decode_subgoals(response, seen.names, seen.image.shape[:2])
