# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Records topics into an MCAP bag, as serialized messages."""

import math
from pathlib import Path
import sys
import time
from typing import Any

from rclpy.clock import Clock, ClockType
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from std_srvs.srv import SetBool
from tap_ros.errors import ConfigError, RecordingError, StorageError
from tap_ros.nodes.diagnostics import Diagnostics
from tap_ros.nodes.parameters import (
    declare_arm,
    declare_opening,
    declared_mount,
    Parameters,
)
from tap_ros.nodes.ros_messages import message_class
from tap_ros.nodes.run import run_node
from tap_ros.nodes.subscriptions import AdaptiveSubscription
from tap_ros.nodes.topics import SERVICE_QOS
from tap_ros.recording import topics
from tap_ros.recording.attachments import CARD_TYPE
from tap_ros.recording.mounts import ArmMount, write_mount
from tap_ros.recording.writer import BagWriter
from tap_ros.text import escaped

DEPTH = 100  # messages that may wait while the disk is slow
CARDS = ('predictor_node/model_card', 'visual_mpc_node/model_card')
TYPES = {
    **{name.lstrip('/'): kind for name, kind in topics.TYPES.items()},
    'subgoal': 'tap_msgs/msg/Subgoal',
    'subgoal/image': 'sensor_msgs/msg/Image',
    'subgoal/overlay': 'sensor_msgs/msg/Image',
    'plan/distance': 'std_msgs/msg/Float64',
    **dict.fromkeys(CARDS, CARD_TYPE)}
LATCHED = ('goal/image', 'goal/robot_mask', 'goal/objects', 'subgoal', 'subgoal/image',
           'subgoal/overlay', *CARDS)
PERIODIC = ('camera/image_raw', 'camera/camera_info', 'objects', 'joint_states')
MAX_AGE = 2.0  # s that a periodic topic may be silent until /diagnostics calls it stale
LONG = 1000  # characters of an answer


class RecorderNode(Node):
    """
    Writes serialized messages unchanged, and finishes the bag on a signal.

    Goal pictures and model cards are attached, too. When the disk is full or gone the node reports
    it, keeps what was written readable, and stays up.
    """

    def __init__(self, **options: Any) -> None:
        super().__init__('recorder_node', **options)
        self.params = declare_parameters(self)
        self._writer: BagWriter | None = None
        # Why the last bag is missing or incomplete.
        self._failure: str | None = None
        self._count = self._unflushed = 0
        self._recorded: dict[str, AdaptiveSubscription] = {}  # by full name of the topic
        # Latched topic -> what write_raw takes, for bags that start later.
        self._last: dict[str, tuple[str, bytes, topics.Qos]] = {}
        self._wanted = list(self.params['topics'])
        if not self._wanted:
            raise ConfigError('parameter topics: is empty; name at least one topic')
        self._diagnostics = Diagnostics(self, {
            name: MAX_AGE if name.lstrip('/') in PERIODIC else math.inf for name in self._wanted})
        if self.params['record_on_start']:
            self._start()
        self._subscribe_known()
        self.create_service(
            SetBool, 'recorder/record', self._on_record, qos_profile=SERVICE_QOS)
        self.create_timer(0.5, self._on_timer, clock=Clock(clock_type=ClockType.STEADY_TIME))
        self.get_logger().info(
            f'ready: recording to {escaped(self._writer.folder)}' if self._writer
            else 'ready: call recorder/record with data true to start')

    def close(self) -> int:
        """Finish the bag; return the exit code, 1 when the last bag is incomplete."""
        self._finish()
        return int(self._failure is not None)

    # Bags

    def _start(self) -> Path:
        """
        Begin a new bag.

        :return: its folder.
        :raises TapError: when it cannot be made, or written to.
        """
        self._failure = None
        folder = free_folder(self.params['folder'])
        self._writer = BagWriter(folder, compression=self.params['compression'])
        self._count = self._unflushed = 0
        now = time.time_ns()
        for topic, (type_name, data, qos) in self._last.items():
            self._write(topic, type_name, data, now, now, qos)
        self._write_mount()
        if self._writer is not None:
            self._flush()  # a full disk is to be known now, not at the first message
        if self._failure is not None:
            raise RecordingError(self._failure)
        return folder

    def _write_mount(self) -> None:
        """Write where the arm stands, unless it is the place that readers assume."""
        arm = ArmMount(
            declared_mount(self.params), self.params['fixed_opening'], self.params['arm'])
        if self._writer is not None and arm != ArmMount():
            try:
                write_mount(self._writer.folder, arm)
            except StorageError as error:
                self._give_up(error)

    def _finish(self) -> str:
        """Finish the bag; return a report for people."""
        self._take_waiting()
        if self._writer is None:
            return self._failure or 'nothing was being recorded'
        writer, self._writer = self._writer, None
        try:
            writer.close()
        except Exception as error:
            self._failure = (
                f'{escaped(writer.folder)}: the bag could not be finished: {escaped(error)}; what '
                'was flushed before stays readable')
            self.get_logger().error(self._failure)
            self._diagnostics.error(self._failure)
            return self._failure
        text = f'{self._count} messages in {escaped(writer.folder)}'
        self.get_logger().info(f'recorded {text}')
        return text

    def _write(self, topic: str, type_name: str, data: bytes, log_time_ns: int,
               publish_time_ns: int, qos: topics.Qos) -> None:
        if self._writer is None:
            return
        try:
            self._writer.write_raw(topic, type_name, data, log_time_ns, publish_time_ns, qos)
        except RecordingError as error:  # of this topic alone
            self._tell(f'{escaped(topic)}: a message was not recorded', error)
            return
        except Exception as error:
            self._give_up(error)
            return
        self._count += 1
        self._unflushed += 1

    def _flush(self) -> None:
        """Write buffered messages to the disk."""
        self._unflushed = 0
        if self._writer is None:
            return
        try:
            self._writer.flush()
        except Exception as error:
            self._give_up(error)

    def _give_up(self, error: Exception) -> None:
        """Stop recording after a failed write."""
        if self._writer is None:
            return
        writer, self._writer = self._writer, None
        writer.abandon()
        self._failure = (
            f'{escaped(writer.folder)}: cannot be written ({escaped(error)}); recording has '
            f'stopped after {self._count} messages, those flushed before stay readable. Make '
            'room, then call recorder/record with data true: it starts a new folder')
        self.get_logger().error(self._failure)
        self._diagnostics.error(self._failure)

    def _on_record(self, request: SetBool.Request, response: SetBool.Response) -> SetBool.Response:
        try:
            if not request.data:
                response.message = self._finish()
            else:
                folder = self._writer.folder if self._writer else self._start()
                response.message = f'recording to {escaped(folder)}'
            response.success = self._failure is None
        except Exception as error:  # whatever it is, the caller gets an answer
            self._failure = response.message = escaped(error, LONG)
            response.success = False
            self.get_logger().error(f'recorder/record: {self._failure}')
        return response

    # Topics

    def _subscribe_known(self) -> None:
        """Subscribe to wanted topics whose type is in TYPES or announced by a publisher."""
        found = dict(self.get_topic_names_and_types())
        for name in list(self._wanted):
            topic = self.resolve_topic_name(name)
            type_name = TYPES.get(name.lstrip('/')) or next(iter(found.get(topic, [])), None)
            if type_name is None:
                continue
            self._wanted.remove(name)
            try:
                self._subscribe(topic, type_name, QoSProfile(
                    depth=DEPTH, reliability=ReliabilityPolicy.RELIABLE,
                    durability=DurabilityPolicy.TRANSIENT_LOCAL
                    if name.lstrip('/') in LATCHED or self._is_latched(topic)
                    else DurabilityPolicy.VOLATILE))
            except ConfigError as error:
                self.get_logger().error(f'{escaped(topic)} is not recorded: {escaped(error)}')

    def _is_latched(self, topic: str) -> bool:
        """Tell whether all publishers of a topic keep messages for late joiners."""
        publishers = self.get_publishers_info_by_topic(topic)
        return {publisher.qos_profile.durability for publisher in publishers} == {
            DurabilityPolicy.TRANSIENT_LOCAL}

    def _subscribe(self, topic: str, type_name: str, qos: QoSProfile) -> None:
        def on_message(data: bytes, info: dict[str, Any]) -> None:
            try:
                self._on_message(topic, type_name, data, info)
            except Exception as error:  # no message ends the node
                self._tell(f'{escaped(topic)}: a message was not recorded', error)

        self._recorded[topic] = AdaptiveSubscription(
            self, message_class(type_name), topic, on_message, qos, raw=True)

    def _on_message(self, topic: str, type_name: str, data: bytes, info: dict[str, Any]) -> None:
        self._diagnostics.received(topic)
        asked = self._recorded[topic].qos
        latched = asked.durability == DurabilityPolicy.TRANSIENT_LOCAL
        qos = topics.Qos(
            depth=1 if latched else 10,
            durability='transient_local' if latched else 'volatile',
            reliability='reliable' if asked.reliability == ReliabilityPolicy.RELIABLE
            else 'best_effort')
        if latched:
            self._last[topic] = (type_name, data, qos)
        if self._writer is not None:
            received = info['received_timestamp'] or time.time_ns()
            self._write(topic, type_name, data, received,
                        info['source_timestamp'] or received, qos)

    def _take_waiting(self) -> None:
        """Record what has arrived and waits for its callback, such as the end of an episode."""
        try:
            for subscription in self._recorded.values():
                for taken in subscription.take(DEPTH):
                    subscription.subscription.callback(*taken)
        except Exception as error:  # the bag is finished all the same
            self._tell('the last messages were not recorded', error)

    def _on_timer(self) -> None:
        """Write buffered messages to the disk; subscribe to topics that appear or change."""
        try:
            if self._writer is not None and self._unflushed:
                self._flush()
            for subscription in self._recorded.values():
                subscription.adapt()
            if self._wanted:
                self._subscribe_known()
        except Exception as error:
            self._tell('the topics could not be updated', error)

    def _tell(self, what: str, error: Exception) -> None:
        """Log an error of a callback, at most once a second."""
        self.get_logger().error(
            f'{what}: {type(error).__name__}: {escaped(error)}', throttle_duration_sec=1.0)


def declare_parameters(node: Node) -> Parameters:
    """Declare the parameters of the node."""
    parameters = Parameters(node)
    parameters.declare('folder', 'bags/recording',
                       'Folder of the bag; if it exists, a number is added to the name.')
    parameters.declare('topics', list(TYPES), 'Topics to record.')
    parameters.declare('compression', 'zstd', 'Compression of chunks.',
                       choices=['zstd', 'lz4', 'none'])
    declare_arm(parameters)
    declare_opening(parameters)
    parameters.declare('record_on_start', True,
                       'Record from the start; else from the call of recorder/record on.')
    return parameters


def free_folder(wanted: str | Path) -> Path:
    """Return this folder, or the first one with a number added that does not exist."""
    folder, number = Path(wanted), 1
    while folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        number += 1
        folder = Path(f'{wanted}-{number}')
    return folder


def main(args: list[str] | None = None) -> int:
    """Run the node; the answer is the exit code of the process."""
    return run_node(RecorderNode, 'recorder_node', args)


if __name__ == '__main__':
    sys.exit(main())
