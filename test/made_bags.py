# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Bags made message by message, and read twice: decoded, and from the cache.

A message is (topic, type, data, log time in ns). Times are given in seconds; a message is logged
at its stamp unless `log` says when.
"""

import warnings

from made_episodes import assert_all_equal
from mcap.writer import Writer
import numpy as np
from tap_ros.base.contract import GRIPPER_JOINTS
from tap_ros.recording.cache import open_recordings
from tap_ros.recording.file_writer import BagWriter
from tap_ros.recording.messages import encode, schema_text

IMAGE = 'sensor_msgs/msg/Image'
OBJECTS = 'tap_msgs/msg/ObjectStates'
JOINTS = 'sensor_msgs/msg/JointState'
SECOND = 10**9  # ns


def message(topic, kind, t, log=None, **fields):
    """Return a message that has a header; fields that are left out are zero or empty."""
    stamp = round(t * SECOND)
    stamp = {'sec': stamp // SECOND, 'nanosec': stamp % SECOND}
    return topic, kind, encode(kind, {'header': {'stamp': stamp}} | fields), round(
        (t if log is None else log) * SECOND)


def camera(t, value=None, log=None, topic='/camera/image_raw', **changes):
    """Return a picture or a mask: an array, or 2x3 pixels of one value, by default its second."""
    pixels = value
    if not isinstance(value, np.ndarray):
        pixels = np.full((2, 3, 3), t if value is None else value, np.uint8)
    height, width, *channels = pixels.shape
    return message(topic, IMAGE, t, log, **{
        'height': height, 'width': width, 'encoding': 'rgb8' if channels else 'mono8',
        'step': width * (channels or [1])[0], 'data': pixels} | changes)


def command(t, x, log=None):
    return message('/arm/delta_twist_cmds', 'geometry_msgs/msg/TwistStamped', t, log,
                   twist={'linear': {'x': x}})


def gripper(log, opening):
    kind = 'std_msgs/msg/Float64'
    return '/gripper/command', kind, encode(kind, {'data': opening}), round(log * SECOND)


def joints(t, log=None, topic='/joint_states', **positions):
    return message(topic, JOINTS, t, log, name=list(positions), position=list(positions.values()))


def objects(t, topic='/objects', **us):
    """Return objects by their names and columns u."""
    return message(topic, OBJECTS, t, objects=[{'name': name, 'u': u} for name, u in us.items()])


def mark(t, event, outcome='', log=None):
    """Return the mark of the start (event 0) or the end (1) of an episode."""
    return message('/episode', 'tap_msgs/msg/Episode', t, log, event=event, task='push2', seed=3,
                   outcome=outcome)


def record(folder, messages):
    """Write messages into a bag of one file, in their order."""
    with BagWriter(folder) as writer:
        for one in messages:
            writer.write_raw(*one)
    return folder


def record_files(folder, *parts):
    """Write messages into a bag of a file for each part."""
    for number, messages in enumerate(parts):
        record(folder / str(number), messages)
        (folder / str(number) / f'{number}_0.mcap').rename(folder / f'bag_{number}.mcap')
    return folder


def write_mcap(path, messages, topics=(), schema=None, encoding='cdr', **options):
    """
    Write messages as another writer would.

    :param topics: (topic, type) of which there need be no message.
    :param schema: bytes of every definition; by default it is right.
    :param encoding: of the messages.
    :param options: of mcap's Writer.
    """
    messages = list(messages)
    with open(path, 'wb') as stream:
        writer, numbers = Writer(stream, **options), {}
        writer.start('ros2')
        for topic, kind in dict.fromkeys((*topics, *((one[0], one[1]) for one in messages))):
            text = schema_text(kind).encode() if schema is None else schema
            numbers[topic, kind] = writer.register_channel(
                topic, encoding, writer.register_schema(kind, 'ros2msg', text))
        for topic, kind, data, log in messages:
            writer.add_message(numbers[topic, kind], log, data, log)
        writer.finish()
    return path


def read(path, **options):
    """Return (episodes, warnings) of a recording, which are the same from the cache."""
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter('always')
        found = list(open_recordings(path, **options))
    with warnings.catch_warnings():
        warnings.simplefilter('ignore')
        assert_all_equal(open_recordings(path, **options), found)
    return found, [str(one.message) for one in told]


def shown(episodes):
    """Return the first value of each frame of each episode."""
    return [episode.frames[:, 0, 0, 0].tolist() for episode in episodes]


def decode_gripper(message):
    """Return the gripper in a JointState of ours, float32 (4,)."""
    known = dict(zip(message.name, message.position))
    return np.array([known[joint] for joint in GRIPPER_JOINTS], np.float32)
