# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Records topics into MCAP bags, as serialized messages; what happens when the disk fails."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
import struct
import time
from typing import Any

from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile
from std_srvs.srv import SetBool
from tap_ros.base.errors import ConfigError, KinematicsError, RecordingError, StorageError
from tap_ros.base.files import free_folder
from tap_ros.base.text import escaped
from tap_ros.messages.topics import (
    BY_NAME,
    COMPRESSED_TYPE,
    CONTROL_PERIOD,
    default_qos,
    IMAGE,
    OBJECTS,
    Qos,
    ROBOT_MASK,
    Topic,
)
from tap_ros.recording.file_writer import BagWriter
from tap_ros.recording.messages import encode
from tap_ros.recording.metadata import ArmMount, write_mount
from tap_ros.ros.arm_place import ArmPlace
from tap_ros.ros.calls import answering
from tap_ros.ros.diagnostics import Diagnostics
from tap_ros.ros.parameters import declared_mount, Parameters, setting
from tap_ros.ros.polling import take_messages
from tap_ros.ros.subscriptions import AdaptiveSubscription, steady_timer
from tap_ros.ros.topics import camera_image, message_class, SERVICE_QOS

DEPTH = 100  # messages that may wait while the disk is slow
HEADED = 12  # bytes of a serialized message up to the end of its stamp
MASK_S = 1.0  # that the mask of a bag's last picture is waited for
TRANSIENT_LOCAL = DurabilityPolicy.TRANSIENT_LOCAL


class Bags:
    """
    One bag after the other; each begins with the last message of every latched topic.

    :param params: Parameters of the node.
    :param report: called with the text of every failure.
    :param period: full name of the topic that says of what unit the commands are.
    :param place: where the arm stands.
    :ivar failure: why the last bag is missing or incomplete, None if it is not.
    :ivar count: messages in the last bag.
    """

    def __init__(self, params: Parameters, report: Callable[[str], object],
                 period: str, place: ArmPlace) -> None:
        self._params, self._report, self._period = params, report, period
        self._place, self._stands = place, ArmMount()
        self._writer: BagWriter | None = None
        self._last: dict[str, tuple[str, bytes, Qos]] = {}  # of latched topics
        self._unflushed = False
        self.failure: str | None = None
        self.count = 0

    @property
    def folder(self) -> Path | None:
        """Folder of the bag that is being written, if there is one."""
        return self._writer.folder if self._writer else None

    def start(self) -> Path:
        """
        Begin a new bag, unless one is being written.

        :return: its folder.
        :raises TapError: when it cannot be made, or written to.
        """
        if self._writer is not None:
            return self._writer.folder
        self.failure, self.count = 'the recording could not be begun', 0  # until it is
        self._stands = ArmMount()
        folder = free_folder(self._params['folder'])
        self._writer = BagWriter(folder, compression=self._params['compression'])
        self.failure = None
        now = time.time_ns()
        self._write(self._period, CONTROL_PERIOD.type, encode(CONTROL_PERIOD.type, {
            'data': self._params['control_period']}), default_qos(self._period), now, now)
        self.count = 0  # that is of nobody
        for topic, (type_name, data, qos) in self._last.items():
            try:
                self._write(topic, type_name, data, qos, now, now)
            except RecordingError as error:  # of this topic alone
                self._report(f'{escaped(topic)}: a message was not recorded: {escaped(error)}')
        try:
            self._write_mount(folder)
        except StorageError as error:
            self._give_up(error)
        self._unflushed = True
        self.flush()  # a full disk is to be known now, not at the first message
        if self.failure is not None:
            raise RecordingError(self.failure)
        return folder

    def take(self, topic: str, type_name: str, data: bytes, qos: Qos, received_ns: int,
             sent_ns: int) -> None:
        """
        Write a message, if a bag is open, and remember it if its topic is latched.

        :param topic: full name; type_name: for example 'sensor_msgs/msg/Image'.
        :param data: serialized.
        :param received_ns: log time; sent_ns: publish time.
        :raises RecordingError: when this topic cannot be recorded; others can.
        """
        if qos.durability == 'transient_local':
            self._last[topic] = type_name, data, qos
        self._write(topic, type_name, data, qos, received_ns, sent_ns)

    def _write_mount(self, folder: Path) -> None:
        """Write where the arm stands, unless that is what readers assume or was written."""
        try:
            mount = self._place.usual()
        except KinematicsError as error:
            mount = declared_mount(self._params)
            self._report(f'the arm is recorded where mount_x to mount_turn say: {error}')
        arm = ArmMount(mount, self._params['fixed_opening'], self._params['arm'])
        if arm != self._stands:
            write_mount(folder, arm)
            self._stands = arm

    def flush(self) -> None:
        """Write buffered messages to the disk."""
        if self._writer is not None and self._unflushed:
            self._unflushed = False
            try:
                self._writer.flush()
            except Exception as error:
                self._give_up(error)

    def finish(self) -> str:
        """Finish the bag; return a report for people."""
        if self._writer is None:
            return self.failure or 'nothing was being recorded'
        writer, self._writer = self._writer, None
        try:
            writer.close()
            self._write_mount(writer.folder)  # by now tf_static may have told it
        except Exception as error:
            return self._fail(
                f'{escaped(writer.folder)}: the bag could not be finished: {escaped(error)}; what '
                'was flushed before stays readable')
        if not self.count:
            return self._fail(f'{escaped(writer.folder)}: nothing was recorded, as nothing has '
                              'come on any topic')
        return f'{self.count} messages in {escaped(writer.folder)}'

    def _write(self, topic: str, type_name: str, data: bytes, qos: Qos, received_ns: int,
               sent_ns: int) -> None:
        if self._writer is None:
            return
        try:
            self._writer.write_raw(topic, type_name, data, received_ns, sent_ns, qos)
        except RecordingError:
            raise
        except Exception as error:
            self._give_up(error)
            return
        self.count += 1
        self._unflushed = True

    def _give_up(self, error: Exception) -> None:
        """Stop recording after a failed write."""
        if self._writer is None:
            return
        writer, self._writer = self._writer, None
        writer.abandon()
        self._fail(
            f'{escaped(writer.folder)}: cannot be written ({escaped(error)}); recording has '
            f'stopped after {self.count} messages, those flushed before stay readable. Make '
            'room, then call recorder/record with data true: it starts a new folder')

    def _fail(self, failure: str) -> str:
        """Report a failure, and return it."""
        self.failure = failure
        self._report(failure)
        return failure


class RecorderNode(Node):
    """
    Writes serialized messages unchanged, and finishes the bag on a signal.

    When the disk is full or gone the node reports it, keeps what was written readable, and stays
    up.
    """

    def __init__(self, **options: Any) -> None:
        super().__init__('recorder_node', **options)
        self.params = declare_parameters(self)
        self._recorded: dict[str, AdaptiveSubscription] = {}  # by full name of the topic
        image = camera_image(self.params)[1]
        self._wanted = [image if name == IMAGE.name else name for name in self.params['topics']]
        if not self._wanted:
            raise ConfigError('parameter topics: is empty; name at least one topic')
        # Who needs pictures alone has no objects, and who tracks them selects them first.
        streams = {name for name in self._wanted if (known := _known(name)) and known.periodic
                   and known is not OBJECTS}
        period = self.resolve_topic_name(CONTROL_PERIOD.name)
        self._image, self._mask = map(self.resolve_topic_name, (image, ROBOT_MASK.name))
        self._stamps: dict[str, tuple[int, ...]] = {}  # of the newest picture and mask
        self._diagnostics = Diagnostics(
            self, streams, {*self._wanted, period} - streams,
            expected=self._wanted if self.params['topics'] != [*BY_NAME] else ())
        if period not in map(self.resolve_topic_name, self._wanted):
            self._wanted = [*self._wanted, period]  # what the arm tells goes before the parameter
        self._bags = Bags(self.params, self._report, period, ArmPlace(self, self.params))
        if self.params['record_on_start']:
            self._bags.start()
        self._subscribe_known()
        self.create_service(SetBool, 'recorder/record', answering(self, self._on_record),
                            qos_profile=SERVICE_QOS)
        steady_timer(self, 0.5, self._on_timer)
        self.get_logger().info(
            f'ready: recording to {escaped(self._bags.folder)}' if self._bags.folder
            else 'ready: call recorder/record with data true to start')

    def close(self) -> int:
        """Finish the bag; return the exit code, 1 when the last bag is incomplete."""
        self._finish()
        return int(self._bags.failure is not None)

    def _finish(self) -> str:
        """Record what has arrived, such as the end of an episode, and finish the bag."""
        self._take(*self._recorded)
        end = time.monotonic() + MASK_S
        # Without its mask the last picture would cost the episode all of them.
        while (self._bags.folder and time.monotonic() < end and self._mask in self._stamps
               and self._stamps[self._mask] < self._stamps.get(self._image, ())):
            time.sleep(0.01)
            self._take(self._mask)
        recorded, text = self._bags.folder, self._bags.finish()
        if recorded and self._bags.failure is None:
            self.get_logger().info(f'recorded {text}')
        return text

    def _take(self, *names: str) -> None:
        """Record what has arrived on topics."""
        for name in names:
            subscription = self._recorded[name].subscription
            for message, info in take_messages(subscription, DEPTH):
                subscription.callback(message, info)

    def _on_record(self, request: SetBool.Request, response: SetBool.Response) -> SetBool.Response:
        response.message = (f'recording to {escaped(self._bags.start())}' if request.data
                            else self._finish())
        response.success = self._bags.failure is None
        return response

    def _report(self, failure: str) -> None:
        self.get_logger().error(failure)
        self._diagnostics.error(failure)

    # Topics

    def _subscribe_known(self) -> None:
        """Subscribe to wanted topics whose type is known or announced by a publisher."""
        found = dict(self.get_topic_names_and_types())
        for name in list(self._wanted):
            topic = self.resolve_topic_name(name)
            known = _known(name)
            type_name = next(iter(found.get(topic, [])), None)
            if known is not None:
                type_name = COMPRESSED_TYPE if name.endswith('/compressed') else known.type
            if type_name is None:
                continue
            self._wanted.remove(name)
            latched = {publisher.qos_profile.durability for publisher in
                       self.get_publishers_info_by_topic(topic)} == {TRANSIENT_LOCAL}
            try:
                self._recorded[topic] = AdaptiveSubscription(
                    self, message_class(type_name), topic,
                    partial(self._on_message, topic, type_name), QoSProfile(
                        depth=DEPTH, durability=TRANSIENT_LOCAL if latched or (
                            known and known.latched) else DurabilityPolicy.VOLATILE), raw=True)
            except ConfigError as error:
                self.get_logger().error(f'{escaped(topic)} is not recorded: {escaped(error)}')

    def _on_message(self, topic: str, type_name: str, data: bytes, info: dict[str, Any]) -> None:
        self._diagnostics.received(topic)
        if topic in (self._image, self._mask) and len(data) >= HEADED:
            self._stamps[topic] = struct.unpack_from('<iI', data, 4)
        asked = self._recorded[topic].qos
        qos = Qos(depth=1 if asked.durability == TRANSIENT_LOCAL else 10,
                  durability=asked.durability.name.lower(),
                  reliability=asked.reliability.name.lower())
        received = info['received_timestamp'] or time.time_ns()
        try:
            self._bags.take(topic, type_name, data, qos, received,
                            info['source_timestamp'] or received)
        except Exception as error:  # no message ends the node
            self.get_logger().error(
                f'{escaped(topic)}: a message was not recorded: {type(error).__name__}: '
                f'{escaped(error)}', throttle_duration_sec=1.0)

    def _on_timer(self) -> None:
        """Write buffered messages to the disk; subscribe to topics that appear or change."""
        self._bags.flush()
        for subscription in self._recorded.values():
            subscription.adapt()
        if self._wanted:
            self._subscribe_known()


def _known(name: str) -> Topic | None:
    """Return the Topic of this name, compressed or not, None for others."""
    return BY_NAME.get(name.lstrip('/').removesuffix('/compressed'))


@dataclass(frozen=True)
class RecorderParameters:
    """
    Parameters that this node alone has.

    :param folder: Folder of the bag; if it exists, a number is added to the name.
    :param compression: Compression of chunks.
    :param record_on_start: Record from the start; else from the call of recorder/record on.
    """

    folder: str = 'bags/recording'
    compression: str = setting('zstd', choices=('zstd', 'lz4', 'none'))
    record_on_start: bool = True


def declare_parameters(node: Node) -> Parameters:
    """Declare the parameters of the node."""
    parameters = Parameters(node)
    parameters.declare_fields(RecorderParameters)
    parameters.declare('topics', list(BY_NAME), 'Topics to record.')
    parameters.declare_shared('image_transport', 'control_period', 'joint_prefix')
    parameters.declare_arm()
    return parameters
