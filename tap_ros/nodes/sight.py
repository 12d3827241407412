# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What visual_mpc_node sees: messages put together by their stamp, and decoded once."""

from collections.abc import Callable, Collection, Sequence
from dataclasses import replace
import time
from typing import Any, TYPE_CHECKING

from sensor_msgs.msg import Image, JointState
from tap_msgs.msg import Episode, ObjectStates
from tap_ros.errors import PlanningError
from tap_ros.nodes.image_messages import decode_image
from tap_ros.nodes.object_messages import decode_gripper, decode_objects, match_objects
from tap_ros.nodes.observations import JUMP_NS, Moment, Observations
from tap_ros.nodes.topics import STREAM, to_nanoseconds
from tap_ros.planning.reach import Seen

if TYPE_CHECKING:
    from rclpy.node import Node
    from tap_ros.nodes.parameters import Parameters

TOPICS = {'image': (Image, 'camera/image_raw'), 'objects': (ObjectStates, 'objects'),
          'joints': (JointState, 'joint_states')}


class Sight:
    """
    The newest picture with its objects and joints, for one goal at a time.

    :param node: rclpy Node.
    :param params: its Parameters.
    :param image_size: (height, width) that pictures must have.
    :param on_message: called with the topic name after each message.
    :ivar sensors: Observations.
    :ivar messages: {topic: message} that the newest Seen was decoded from.
    """

    def __init__(self, node: 'Node', params: 'Parameters', image_size: Sequence[int],
                 on_message: Callable[[str], object]) -> None:
        self._node, self._params, self._size = node, params, image_size
        self._mark = 0, 0  # that an episode begins: stamp, and jumps of the clock until then
        self.sensors = Observations(*TOPICS)
        self.begin(0.0)
        node.create_subscription(Episode, 'episode', self._on_episode, STREAM)
        self.sensors.subscribe(node, TOPICS, STREAM, on_message=on_message)

    def begin(self, since: float) -> None:
        """Begin a goal: only what is received from this monotonic time on is seen."""
        self._since = since
        self._seen: Seen | None = None
        self.messages: dict[str, Any] = {}
        self._publishers = self._count_publishers()

    def look(self, topics: Collection[str]) -> tuple[Seen | None, str]:
        """
        Return what was seen last.

        :param topics: those of TOPICS that are needed; without objects their pixels are None.
        :return: Seen, or None when nothing was; which sensors are silent, '' if none is.
        :raises TapError: for messages that cannot be used.
        """
        self._check_publishers()
        moment = self.sensors.moment(topics, since=self._since)
        lacking = self._lacking(topics)
        if moment is None:
            return None, lacking or (
                f'no messages of the same stamp on {self._names(topics)} since the goal was '
                'accepted')
        times: dict[str, Any] = {
            'received': moment.received, 'scene_ns': self._scene_ns(moment.stamp_ns),
            'jumps': self.sensors.jumps}
        if self._seen is not None and (self._seen.stamp_ns, self._seen.jumps) == (
                moment.stamp_ns, times['jumps']):
            self._seen = replace(self._seen, **times)
        else:
            self._seen = self._decode(moment, topics, times)
            self.messages = moment.messages
        return self._seen, lacking

    def newest_stamp(self) -> int:
        """Return the stamp of the newest picture that has come with its joints, in ns."""
        moment = self.sensors.moment(('image', 'joints'))
        return moment.stamp_ns if moment is not None else -1

    def _scene_ns(self, stamp_ns: int) -> int:
        """Return when the scene began, 0 if that is unknown or of another clock."""
        begun_ns, jumps = self._mark
        known = jumps == self.sensors.jumps and begun_ns <= stamp_ns + JUMP_NS
        return begun_ns if known else 0

    def _decode(self, moment: Moment, topics: Collection[str], times: dict[str, Any]) -> Seen:
        """Return a Seen; the objects keep the order in which they were seen first."""
        first, pixels = self._seen, None
        names = first.names if first else ()
        if 'objects' in topics:
            found, pixels = decode_objects(moment.messages['objects'], 'objects', self._size)
            if set(found) == set(names):
                pixels = match_objects(names, found, pixels, 'the first objects', 'objects')
            else:
                names = found
        image = decode_image(moment.messages['image'], 'camera/image_raw', self._size)
        gripper = decode_gripper(moment.messages['joints'])
        return Seen(image, gripper, names, pixels, moment.stamp_ns, **times)

    def _lacking(self, topics: Collection[str]) -> str:
        missing = self.sensors.missing(topics)
        if missing:
            return f'nothing has come on {self._names(missing)}'
        ages = self.sensors.ages(topics, time.monotonic())
        silent = [topic for topic in topics if ages[topic] > self._params['max_silence']]
        return f'nothing new has come on {self._names(silent)}' if silent else ''

    def _count_publishers(self) -> dict[str, int]:
        return {topic: self._node.count_publishers(name) for topic, (_, name) in TOPICS.items()}

    def _check_publishers(self) -> None:
        """Refuse to go on by two cameras that take turns; their stamps need not differ."""
        for topic, count in self._count_publishers().items():
            if count > max(self._publishers[topic], 1):
                raise PlanningError(
                    f'the scene has changed: {count} nodes publish on {self._names([topic])} '
                    'now; leave one, and send the goal again')

    def _names(self, topics: Collection[str]) -> str:
        return ', '.join(self._node.resolve_topic_name(TOPICS[topic][1]) for topic in topics)

    def _on_episode(self, message: Episode) -> None:
        if message.event == Episode.START:
            self._mark = to_nanoseconds(message.header.stamp), self.sensors.jumps
            self.sensors.wake()
