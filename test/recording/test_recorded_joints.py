# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Where the gripper was in a recording whose joint states are those of an arm alone."""

from made_bags import camera, joints, read, record
import numpy as np
import pytest
from tap_ros.messages.joints import contradicted
from tap_ros.recording.cache import open_recordings
from tap_ros.recording.metadata import ArmMount, MOUNT_NAME, write_mount
from tap_ros.robots.arm import Mount
from tap_ros.robots.ur10e import UR10E

FRAMES, PERIOD, FAST = 6, 0.25, 0.004  # s: of the camera, of the driver
STANDS = ArmMount(Mount((0.3, 0.5, 0.0), 1.0, 0.17), 0.5)


def place(t):
    """Return where the gripper is at a time; it moves 0.16 m/s."""
    return np.array([0.16 * (t - 1) - 0.2, 0.1, 0.05])


def bag(path, mount, extra=(), prefix='ur_'):
    """Write a bag of a driver at 250 Hz whose states never have the stamp of a picture."""
    messages = [camera(1 + i * PERIOD, i) for i in range(FRAMES)]
    for t in np.arange(1 - 0.009, 1 + FRAMES * PERIOD, FAST).tolist():
        angles = dict(zip(UR10E.joints, UR10E.joints_at(place(t), mount), strict=True))
        states = {prefix + name: angles[name] for name in reversed(UR10E.joints)}
        messages += [joints(t, log=t + 1e-8, **states, **dict.fromkeys(extra, 0.9)),
                     joints(t, log=t + 2e-8, finger=0.1)]
    return record(path, sorted(messages, key=lambda one: one[3]))


def episode_of(path):
    (episode,), _ = read(path)
    return episode


def places():
    return np.array([place(1 + i * PERIOD) for i in range(FRAMES)])


def test_the_gripper_follows_from_the_arms_joints_where_it_stood(tmp_path):
    path = bag(tmp_path / 'bag', STANDS.mount)
    write_mount(path, STANDS)
    told = open_recordings(path).data_hash
    grippers = episode_of(path).grippers
    np.testing.assert_allclose(grippers[:, :3], places(), atol=0.16 * FAST)
    np.testing.assert_array_equal(grippers[:, 3], np.float32(0.5))
    (path / MOUNT_NAME).unlink()
    assert np.abs(episode_of(path).grippers[:, :3] - places()).max() > 0.1
    assert open_recordings(path).data_hash != told  # what is trained on is another thing


def test_a_gripper_that_is_told_counts(tmp_path):
    path = bag(tmp_path / 'bag', UR10E.mount, ['gripper_x', 'gripper_y', 'gripper_z'])
    np.testing.assert_allclose(
        episode_of(path).grippers, [[0.9, 0.9, 0.9, np.nan]] * FRAMES, rtol=1e-6)


REST = (0.4, -1.3, 0.2, -1.57, 0.1, 0.3)


@pytest.mark.parametrize(('sent', 'known', 'told'), [
    (lambda i, real: [], FRAMES, False),
    (lambda i, real: [(0.0,) * 6], FRAMES, True),  # of a second node
    (lambda i, real: [(0.0,) * 6] * 2 if i % 3 == 0 else [], FRAMES, True),
    (lambda i, real: [(*real[:2], 0.0, *real[3:])], FRAMES, True),
    (lambda i, real: [REST] if i == 9 else [], FRAMES, True),
    (lambda i, real: [REST], 1, True),  # nothing tells which of two is right
    (lambda i, real: [(0.0,) * 6] * 80 if i == 0 else [], FRAMES, True)])
def test_joint_states_that_contradict_others_move_no_gripper(tmp_path, sent, known, told):
    messages = [camera(1.013 + i * PERIOD, i) for i in range(FRAMES)]
    for i, t in enumerate(np.arange(1, 1 + FRAMES * PERIOD, 0.02).tolist()):
        real = UR10E.joints_at(place(t), UR10E.mount)
        for k, one in enumerate([real, *sent(i, real)]):
            at = t + 1e-4 * k + 0.005 * (k > 0)
            messages.append(joints(at, **dict(zip(UR10E.joints, one))))
    (episode,), said = read(record(tmp_path / 'bag', sorted(messages, key=lambda one: one[3])))
    found = np.isfinite(episode.grippers[:, :3]).all(1)
    right = np.array([place(t / 1e9) for t in episode.stamps])
    assert found.sum() == FRAMES if known == FRAMES else found.sum() <= known
    np.testing.assert_allclose(episode.grippers[found, :3], right[found], atol=0.01)
    assert [text for text in said if 'contradict' in text] == said and bool(said) == told


def test_an_arm_that_is_at_zero_is_believed():
    times = np.arange(200) * 20 * 10**6
    for values in (np.zeros(200), np.maximum(np.arange(200) - 100, 0) * 0.02,
                   np.round(np.arange(200) * 0.01 - 1, 2), np.sin(np.arange(200) / 6),
                   np.repeat([0.0, 1.0], 100)[::-1]):
        assert not contradicted(times, values)[:100].any()
