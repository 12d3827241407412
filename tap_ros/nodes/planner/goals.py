# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Where a reach_goal request leads: its goal, sent along or by topic, and the subgoals."""

from collections.abc import Callable
from dataclasses import replace
import time

import numpy as np
from rclpy.node import Node
from tap_msgs.action import ReachGoal
from tap_msgs.msg import ObjectStates
from tap_ros.base.errors import PlanningError
from tap_ros.images.pixels import resize_image, resize_pixels
from tap_ros.messages.images import decode_image, is_empty
from tap_ros.messages.objects import check_found, match_objects
from tap_ros.messages.subgoals import decode_subgoals, Subgoal
from tap_ros.nodes.planner.planner_inputs import PlannerInputs
from tap_ros.planning.hierarchy import choose_sample, Target, targets_by
from tap_ros.planning.reach import Observation, ReachConfig
from tap_ros.planning.visual_mpc import Goal, Memory, Plan, Scene, VisualMPC
from tap_ros.ros.client import Client
from tap_ros.ros.diagnostics import Diagnostics
from tap_ros.ros.observations import Observations
from tap_ros.ros.parameters import Parameters
from tap_ros.ros.topics import encode_image, encode_objects, goal_topics, LATCHED, to_stamp


class GoalSource:
    """
    Goal and subgoals of one request at a time.

    :param params: Parameters of the node.
    :param inputs: PlannerInputs, which knows how the planner sees pictures.
    :param client: Client that asks for subgoals.
    """

    def __init__(self, node: Node, params: Parameters, inputs: PlannerInputs, client: Client,
                 diagnostics: Diagnostics) -> None:
        self._params, self._inputs, self._client = params, inputs, client
        self._diagnostics = diagnostics
        types = goal_topics(params['robot_mask'])
        self._newest = Observations(*types, latched=True)
        self._newest.subscribe(node, types, LATCHED, on_message=diagnostics.received)

    def begin(self, request: ReachGoal.Goal, mode: str) -> None:
        """Begin a request; the fields that it leaves empty come from their topics."""
        self._request, self._mode = request, mode
        self._needed = tuple(topic for topic, empty in (
            ('image', mode == 'subgoal' and is_empty(request.goal_image)),
            ('objects', not request.goal_objects.objects)) if empty)
        self._stamp: int | None = None  # of what was taken from topics

    def changed(self, since: float) -> bool:
        """
        Return whether the goal is another one now, received before `since`.

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

    def targets(self, seen: Observation, mpc: VisualMPC, config: ReachConfig,
                go_on: Callable[[], None]) -> list[Target]:
        """
        Return what to go to from what is seen: subgoals in that mode, then the goal.

        :param go_on: called while this waits or plans; what it raises ends that.
        :raises TapError: when nothing comes, or it cannot be used.
        """
        if not seen.names:
            raise PlanningError('objects: none are seen, so there is nothing to push; publish '
                                'their pixels')
        picture, objects = self._take(go_on)
        check_found(objects, 'goal_objects')
        names, pixels = self._inputs.decode_positions(
            objects, 'goal_objects', None if picture is None else picture.shape[:2])
        goal_pixels = match_objects(seen.names, names, pixels, 'objects', 'goal_objects')
        if self._mode != 'subgoal' or picture is None:
            return targets_by([], seen.pixels, goal_pixels)

        def plan(scene: Scene, goal: Goal) -> Plan:
            go_on()
            return mpc.plan(scene, goal, Memory(self._request.seed), config.limits)

        begin = time.perf_counter()
        subgoals = self._ask_subgoals(seen, picture, goal_pixels, go_on)
        self._diagnostics.took(1e3 * (time.perf_counter() - begin), 'predict_subgoal')
        scene = Scene(seen.image, seen.gripper, seen.pixels)
        return targets_by(choose_sample(mpc, scene, goal_pixels, subgoals, plan), seen.pixels,
                          goal_pixels)

    def _take(self, go_on: Callable[[], None]) -> tuple[np.ndarray | None, ObjectStates]:
        """
        Return goal picture, uint8 (H, W, 3), and goal objects; a direct goal may lack the picture.

        The picture is without the robot where a mask is used and one with its stamp has come.
        """
        needed, robot, timeout_s = self._needed, self._inputs.robot, self._params['image_timeout']
        image, objects, mask = self._request.goal_image, self._request.goal_objects, None
        if needed:
            found = self._newest.wait(needed, timeout_s, give_up=go_on)
            if found is None:
                missing = self._newest.missing(needed) or needed
                raise PlanningError(
                    f'goal: nothing has come on {self._newest.names(missing, explained=True)}; '
                    'publish there (the simulator does at sim/reset), or send goal_image and '
                    'goal_objects along')
            self._stamp = found.stamp_ns
            if 'image' in needed and robot.used and not self._newest.missing(['mask']):
                found = self._newest.wait(
                    (*needed, 'mask'), timeout_s, self._stamp - 1, go_on) or found
                mask = found.messages.get('mask')
            # Where it is not needed, it says how large the picture is that the objects are in.
            image = found.messages.get('image', image) if is_empty(image) else image
            objects = found.messages['objects'] if 'objects' in needed else objects
        picture = None if is_empty(image) else decode_image(image, 'goal')
        if picture is not None and mask is not None:
            picture = robot.fill_goal(picture, mask)
        return picture, objects

    def _ask_subgoals(self, seen: Observation, goal: np.ndarray, goal_pixels: np.ndarray,
                      go_on: Callable[[], None]) -> list[Subgoal]:
        """
        Return the Subgoals of all samples, their objects in the order in which they are seen.

        Pictures are sent cut as the planner sees them: so the maps of the answer are in its
        pixels, whatever the predictor makes of a camera's. They are as sharp as the camera's, for
        people; what comes back is made as small as what the planner sees.
        """
        header, size = (to_stamp(seen.stamp_ns), self._inputs.frame_id), seen.image.shape[:2]
        pictures = self._inputs.sharp(seen), self._inputs.part(goal, 'goal')
        start_objects, goal_objects = (encode_objects(
            seen.names, resize_pixels(pixels, size, picture.shape[:2]), None, *header,
            ObjectStates.SOURCE_TRACKED)
            for pixels, picture in zip((seen.pixels, goal_pixels), pictures))
        response = self._client.call(
            'predict', self._params['predictor_timeout'], go_on,
            start=encode_image(pictures[0], *header), goal=encode_image(pictures[1], *header),
            start_objects=start_objects, goal_objects=goal_objects,
            num_samples=self._request.num_samples, seed=self._request.seed,
            recursion_depth=self._request.recursion_depth)
        return [replace(
            one, image=resize_image(one.image, size),
            expected_pixels=resize_pixels(one.expected_pixels, one.image.shape[:2], size))
            if one.image.shape[:2] != size else one
            for one in decode_subgoals(response, seen.names, size)]
