# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Moments of a recording as messages, in a file that viewers open together with it.

Foxglove's log panel shows each moment and goes there on a click; its panel of state transitions
shows the subtasks, and the ends of demonstrations as ''.
"""

from collections.abc import Iterable
from pathlib import Path
from typing import NamedTuple

from tap_ros.messages.stamps import stamp_fields
from tap_ros.recording.file_writer import new_file
from tap_ros.recording.messages import encode

MOMENTS, SUBTASK = '/labels', '/labels/subtask'  # topics
_LOG, _TEXT = 'rcl_interfaces/msg/Log', 'std_msgs/msg/String'
_INFO, _WARN = 20, 30  # levels of Log


class Event(NamedTuple):
    """
    What happens at a picture of a recording.

    :param log: when the picture was logged, ns; viewers play by it.
    :param stamp: of the picture, ns.
    :param subtask: that begins; '': none goes on.
    :param name: of the moment; '': it is the first or the last picture of a demonstration.
    :param text: that is said of it.
    :param doubtful: shown as a warning.
    """

    log: int
    stamp: int
    subtask: str
    name: str = ''
    text: str = ''
    doubtful: bool = False


def write_events(path: str | Path, events: Iterable[Event]) -> None:
    """
    Write events into an MCAP file, in order of time.

    :param path: of the file; replaced when it exists.
    :raises StorageError: when it cannot be written.
    """
    with new_file(path) as file:
        for one in sorted(events, key=lambda one: one.log):
            if one.name:
                file.write_raw(MOMENTS, _LOG, encode(_LOG, {
                    'stamp': stamp_fields(one.stamp), 'level': _WARN if one.doubtful else _INFO,
                    'name': one.name, 'msg': one.text}), one.log)
            file.write_raw(SUBTASK, _TEXT, encode(_TEXT, {'data': one.subtask}), one.log)
