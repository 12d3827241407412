# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The goal of a reach_goal request: what it sends along, else what came by topic."""

from collections.abc import Callable, Iterable
from typing import Any, TYPE_CHECKING

from sensor_msgs.msg import Image
from tap_msgs.msg import ObjectStates
from tap_ros.errors import PlanningError
from tap_ros.messages.images import is_empty
from tap_ros.messages.stamps import to_nanoseconds
from tap_ros.nodes.observations import Observations
from tap_ros.nodes.robot_view import GOAL_MASK
from tap_ros.nodes.topics import LATCHED

if TYPE_CHECKING:
    from rclpy.node import Node
    from tap_msgs.action import ReachGoal

TOPICS = {'image': (Image, 'goal/image'), 'objects': (ObjectStates, 'goal/objects')}
MASK_TIMEOUT = 0.1  # s that the robot mask of a goal picture may come after it


def goal_topics(robot_mask: str) -> dict[str, tuple[type, str]]:
    """Return TOPICS, and that of the robot mask when one is used."""
    return TOPICS | (GOAL_MASK if robot_mask != 'none' else {})


class GoalSource:
    """
    Goal picture and goal objects, for one request at a time.

    :param node: rclpy Node.
    :param robot_mask: parameter of the node.
    :param on_message: called with the topic name after each message.
    """

    def __init__(self, node: 'Node', robot_mask: str, on_message: Callable[[str], object]) -> None:
        self._node = node
        self._types = goal_topics(robot_mask)
        self._newest = Observations(*self._types, latched=True)
        self._newest.subscribe(node, self._types, LATCHED, on_message=on_message)
        self.begin(())

    def begin(self, needed: Iterable[str]) -> None:
        """Begin a request that takes these of TOPICS from their topics."""
        self._needed = tuple(needed)
        self._stamp: int | None = None

    def take(self, request: 'ReachGoal.Goal', timeout_s: float,
             give_up: Callable[[], bool]) -> dict[str, Any]:
        """
        Return the goal as {'image': message, 'objects': message}.

        With 'mask' where a robot mask is used and one with the stamp of the picture has come.

        :param request: ReachGoal goal.
        :param timeout_s: most seconds to wait; give_up: asked whether to stop waiting.
        :raises PlanningError: when nothing comes.
        """
        goal = {'image': request.goal_image, 'objects': request.goal_objects}
        if not self._needed:
            return goal
        found = self._newest.wait(self._needed, timeout_s, give_up=give_up)
        if found is None:
            missing = self._newest.missing(self._needed) or self._needed
            raise PlanningError(
                f'goal: nothing has come on {self._explained(missing)}; publish there (the '
                'simulator does at sim/reset), or send goal_image and goal_objects along')
        self._stamp = to_nanoseconds(found[self._needed[0]].header.stamp)
        if 'image' not in self._needed and is_empty(goal['image']):
            # Not needed, but it says how large the picture is that the objects are in.
            beside = self._newest.newest('image', 'objects')
            if beside and to_nanoseconds(beside['image'].header.stamp) == self._stamp:
                goal['image'] = beside['image']
        masks = [topic for topic in self._types if topic == 'mask' and 'image' in self._needed]
        if masks and 'mask' not in found and not self._newest.missing(masks):
            found = self._newest.wait((*self._needed, *masks), MASK_TIMEOUT, self._stamp - 1,
                                      give_up) or found
        return goal | {topic: found[topic] for topic in (*self._needed, *masks) if topic in found}

    def changed(self, since: float) -> bool:
        """
        Tell whether take would return another goal now, which had come before.

        :param since: monotonic time at which the request was accepted.
        :raises PlanningError: if the other goal has come since then.
        """
        newest = self._newest.moment(self._needed) if self._stamp is not None else None
        if newest is None or newest.stamp_ns == self._stamp:
            return False
        if newest.received > since:
            raise PlanningError('the scene has changed: a new goal has come on '
                                f'{self._names(self._needed)}')
        return True

    def _explained(self, topics: Iterable[str]) -> str:
        return ', '.join(self._newest.explained(topic, self._names([topic])) for topic in topics)

    def _names(self, topics: Iterable[str]) -> str:
        return ', '.join(self._node.resolve_topic_name(TOPICS[topic][1]) for topic in topics)


def needed_topics(request: 'ReachGoal.Goal', mode: str) -> list[str]:
    """Return those of TOPICS that a request leaves to them."""
    return [topic for topic, empty in (
        ('image', mode == 'subgoal' and is_empty(request.goal_image)),
        ('objects', not request.goal_objects.objects)) if empty]
