# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The bags of recorder_node: begun, written, finished, and given up when the disk fails."""

from collections.abc import Callable
from pathlib import Path
import time

from tap_ros.errors import RecordingError, StorageError
from tap_ros.messages.topics import Qos
from tap_ros.nodes.parameters import declared_mount, Parameters
from tap_ros.recording.metadata import ArmMount, write_mount
from tap_ros.recording.writer import BagWriter
from tap_ros.text import escaped


class Bags:
    """
    One bag after the other; each begins with the last message of every latched topic.

    :param params: Parameters of the node.
    :param report: called with the text of every failure.
    :ivar failure: why the last bag is missing or incomplete, None if it is not.
    :ivar count: messages in the last bag.
    """

    def __init__(self, params: Parameters, report: Callable[[str], object]) -> None:
        self._params, self._report = params, report
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
        folder = free_folder(self._params['folder'])
        self._writer = BagWriter(folder, compression=self._params['compression'])
        self.failure = None
        now = time.time_ns()
        for topic, (type_name, data, qos) in self._last.items():
            try:
                self._write(topic, type_name, data, qos, now, now)
            except RecordingError as error:  # of this topic alone
                self._report(f'{escaped(topic)}: a message was not recorded: {escaped(error)}')
        arm = ArmMount(
            declared_mount(self._params), self._params['fixed_opening'], self._params['arm'])
        try:
            if arm != ArmMount():  # which readers assume
                write_mount(folder, arm)
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


def free_folder(wanted: str | Path) -> Path:
    """Return this folder, or the first one with a number added that does not exist."""
    folder, number = Path(wanted), 1
    while folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        number += 1
        folder = Path(f'{wanted}-{number}')
    return folder
