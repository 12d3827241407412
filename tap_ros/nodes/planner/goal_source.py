# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The goal of a reach_goal request: its own fields, or what came by topic."""

from collections.abc import Callable
from typing import Any, TYPE_CHECKING

from tap_ros.errors import PlanningError
from tap_ros.messages.images import is_empty
from tap_ros.messages.stamps import to_nanoseconds
from tap_ros.nodes.observations import Observations
from tap_ros.nodes.topics import goal_topics, LATCHED

if TYPE_CHECKING:
    from rclpy.node import Node
    from tap_msgs.action import ReachGoal

MASK_TIMEOUT = 0.1  # s that the robot mask of a goal picture may come after it


class GoalSource:
    """
    Goal picture and goal objects, for one request at a time.

    :param robot_mask: parameter of the node.
    :param on_message: called with the topic name after each message.
    """

    def __init__(self, node: 'Node', robot_mask: str, on_message: Callable[[str], object]) -> None:
        self._masked = robot_mask != 'none'
        types = goal_topics(robot_mask)
        self._newest = Observations(*types, latched=True)
        self._newest.subscribe(node, types, LATCHED, on_message=on_message)

    def begin(self, request: 'ReachGoal.Goal', mode: str) -> None:
        """Begin a request; the fields that it leaves empty come from their topics."""
        self._request = request
        self._needed = tuple(topic for topic, empty in (
            ('image', mode == 'subgoal' and is_empty(request.goal_image)),
            ('objects', not request.goal_objects.objects)) if empty)
        self._stamp: int | None = None  # of what was taken from topics

    def take(self, timeout_s: float, give_up: Callable[[], bool]) -> dict[str, Any]:
        """
        Return the goal as {'image': message, 'objects': message}.

        With 'mask' where a robot mask is used and one with the stamp of the picture has come.

        :param timeout_s: most seconds to wait; give_up: asked whether to stop waiting.
        :raises PlanningError: when nothing comes.
        """
        goal = {'image': self._request.goal_image, 'objects': self._request.goal_objects}
        if not self._needed:
            return goal
        found = self._newest.wait(self._needed, timeout_s, give_up=give_up)
        if found is None:
            missing = self._newest.missing(self._needed) or self._needed
            raise PlanningError(
                f'goal: nothing has come on {self._newest.names(missing, explained=True)}; '
                'publish there (the simulator does at sim/reset), or send goal_image and '
                'goal_objects along')
        self._stamp = to_nanoseconds(found[self._needed[0]].header.stamp)
        taken = list(self._needed)
        if 'image' not in self._needed and is_empty(goal['image']):
            # Not needed, but it says how large the picture is that the objects are in.
            beside = self._newest.newest('image', 'objects')
            if beside and to_nanoseconds(beside['image'].header.stamp) == self._stamp:
                goal['image'] = beside['image']
        if self._masked and 'image' in self._needed:
            taken.append('mask')
            if 'mask' not in found and not self._newest.missing(['mask']):
                found = self._newest.wait(taken, MASK_TIMEOUT, self._stamp - 1, give_up) or found
        return goal | {topic: found[topic] for topic in taken if topic in found}

    def changed(self, since: float) -> bool:
        """
        Tell whether take would return another goal now, received before `since`.

        :param since: monotonic time at which the request was accepted.
        :raises PlanningError: if the other goal was received later.
        """
        newest = self._newest.moment(self._needed) if self._stamp is not None else None
        if newest is None or newest.stamp_ns == self._stamp:
            return False
        if newest.received > since:
            raise PlanningError('the scene has changed: a new goal has come on '
                                f'{self._newest.names(self._needed)}')
        return True
