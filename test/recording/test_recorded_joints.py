# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Where the gripper was in a recording whose joint states are those of an arm alone."""

from made_episodes import assert_all_equal
import numpy as np
import pytest
from tap_ros.errors import RecordingError
from tap_ros.messages import topics
from tap_ros.recording.cache import open_recordings
from tap_ros.recording.file_writer import FileWriter
from tap_ros.recording.messages import encode
from tap_ros.recording.metadata import ArmMount, MOUNT_NAME, write_mount
from tap_ros.recording.reader import iter_episodes
from tap_ros.recording.writer import write_metadata
from tap_ros.robots.arm import Mount
from tap_ros.robots.ur10e import UR10E

FRAMES, PERIOD, FAST = 6, 250_000_000, 4_000_000  # ns: of the camera, of the driver
STANDS = ArmMount(Mount((0.3, 0.5, 0.0), 1.0, 0.17), 0.5)


def place(stamp):
    """Return where the gripper is at a time; it moves 0.16 m/s."""
    return np.array([0.16e-9 * (stamp - 10**9) - 0.2, 0.1, 0.05])


def header(stamp):
    return {'stamp': {'sec': stamp // 10**9, 'nanosec': stamp % 10**9}}


def bag(path, mount, extra=(), prefix='ur_'):
    """Write a bag of a driver at 250 Hz whose states never have the stamp of a picture."""
    path.mkdir()
    names = [prefix + name for name in reversed(UR10E.joints)]
    messages = []
    for i in range(FRAMES):
        stamp = 10**9 + i * PERIOD
        messages.append((stamp, topics.IMAGE, {
            'header': header(stamp), 'height': 8, 'width': 8, 'step': 24, 'encoding': 'rgb8',
            'data': np.full((8, 8, 3), i, np.uint8)}))
    for stamp in range(10**9 - 9_000_000, 10**9 + FRAMES * PERIOD, FAST):
        angles = UR10E.joints_at(place(stamp), mount)
        messages.append((stamp + 10, topics.JOINT_STATES, joints(
            stamp, [*names, *extra], [*angles[::-1], *[0.9] * len(extra)])))
        messages.append((stamp + 20, topics.JOINT_STATES, joints(stamp, ['finger'], [0.1])))
    writer = FileWriter(path / f'{path.name}_0.mcap')
    for log, topic, values in sorted(messages, key=lambda one: one[0]):
        writer.write_raw(topic.recorded, topic.type, encode(topic.type, values), log)
    writer.close()
    write_metadata(path)
    return path


def joints(stamp, names, positions):
    return {'header': header(stamp), 'name': names, 'position': np.array(positions, np.float64),
            'velocity': np.empty(0), 'effort': np.empty(0)}


def read(path):
    """Return the one episode, which is the same with the cache and without."""
    found = list(iter_episodes(path))
    assert_all_equal(open_recordings(path), found)
    episode, = found
    return episode


def places():
    return np.array([place(10**9 + i * PERIOD) for i in range(FRAMES)])


def test_the_gripper_follows_from_the_arms_joints_where_it_stood(tmp_path):
    path = bag(tmp_path / 'bag', STANDS.mount)
    write_mount(path, STANDS)
    told = open_recordings(path).data_hash
    grippers = read(path).grippers
    np.testing.assert_allclose(grippers[:, :3], places(), atol=0.16e-9 * FAST)
    np.testing.assert_array_equal(grippers[:, 3], np.float32(0.5))
    (path / MOUNT_NAME).unlink()
    assert np.abs(read(path).grippers[:, :3] - places()).max() > 0.1
    assert open_recordings(path).data_hash != told  # what is trained on is another thing


def test_without_a_word_the_arm_stood_as_the_simulators(tmp_path):
    path = bag(tmp_path / 'bag', UR10E.mount, ['gripper_opening'], prefix='')
    grippers = read(path).grippers
    np.testing.assert_allclose(grippers[:, :3], places(), atol=0.16e-9 * FAST)
    np.testing.assert_array_equal(grippers[:, 3], np.float32(0.9))


def test_a_gripper_that_is_told_counts(tmp_path):
    path = bag(tmp_path / 'bag', UR10E.mount, ['gripper_x', 'gripper_y', 'gripper_z'])
    np.testing.assert_allclose(read(path).grippers, [[0.9, 0.9, 0.9, np.nan]] * FRAMES, rtol=1e-6)


@pytest.mark.parametrize('text', [
    '', '[]', '{"position": [0, 0, 0]}', '[[[', 'null', '7',
    '{"position": [0, 0], "yaw": 0, "tool": 0, "opening": 0}',
    '{"position": [0, 0, NaN], "yaw": 0, "tool": 0, "opening": 0}',
    '{"position": [0, 0, 0], "yaw": "left", "tool": 0, "opening": 0}'])
def test_a_mount_that_cannot_be_used_is_refused_in_one_line(tmp_path, text):
    path = bag(tmp_path / 'bag', UR10E.mount)
    (path / MOUNT_NAME).write_text(text)
    with pytest.raises(RecordingError, match=MOUNT_NAME) as told:
        list(iter_episodes(path))
    assert '\n' not in str(told.value)
    with pytest.raises(RecordingError, match=MOUNT_NAME):
        open_recordings(path)
