# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Laws of finding joints, and by them the gripper, at the moment of a picture."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from tap_ros.base.errors import KinematicsError
from tap_ros.messages.joints import GripperHistory, JointHistory, positions_at
from tap_ros.messages.stamps import MAX_GAP, stamp_fields
from tap_ros.robots.arm import Mount
from tap_ros.robots.ur10e import UR10E

MS = 10**6


def joints(stamp_ns, **positions):
    return SimpleNamespace(
        header=SimpleNamespace(stamp=SimpleNamespace(**stamp_fields(stamp_ns))),
        name=list(positions), position=list(positions.values()))


def history(*states, names='ab'):
    """Return a JointHistory of (ms, positions); each is received at its time in ms."""
    found = JointHistory(names)
    for ms, positions in states:
        found.add(joints(ms * MS, **positions), ms)
    return found


def test_joints_are_found_between_the_states_before_and_after():
    known = JointHistory(['a', 'b'])
    for ms, a, b in ((100, 1, 5), (110, 2, 3), (120, 4, 3)):
        known.add(joints(ms * MS, a=a, other=9.0), ms)
        known.add(joints(ms * MS, b=b), ms + 1)  # another driver
    found = known.at(104 * MS, 1)
    np.testing.assert_allclose(found.positions, [1.4, 4.2])
    assert found.received == 100  # of the oldest that it comes from
    np.testing.assert_array_equal(known.at(120 * MS, 1).positions, [4, 3])
    assert known.at(120 * MS, 1).received == 120
    assert known.received == 120


def test_recorded_joints_are_found_by_the_same_rule():
    random = np.random.default_rng(0)
    times = np.sort(random.integers(0, 2 * 10**9, 40))
    times[7] = times[6]  # of states of the same time the last counts
    values, at = random.normal(size=40), random.integers(0, 2 * 10**9, 300)
    at[:20] = times[:20]
    live, expected = history(names='a'), []
    for time, value in zip(times.tolist(), values.tolist()):
        live.add(joints(time, a=value), 0)
    for time in at.tolist():
        try:
            expected.append(live.at(time, MAX_GAP).positions[0])
        except KinematicsError:
            expected.append(np.nan)
    np.testing.assert_array_equal(positions_at(times, values, at, -1), expected)
    assert 0 < np.isnan(expected).sum() < 100
    held = positions_at(times, values, at, 10**9)
    unknown = np.isnan(expected)
    np.testing.assert_array_equal(held[~unknown], np.array(expected)[~unknown])
    assert np.isin(held[unknown], values[[0, -1]]).all()
    assert np.isnan(positions_at(times[:0], values[:0], at, 10**9)).all()


def test_a_picture_without_states_around_it_is_refused_with_the_reason():
    known = history(*((at, {'a': 1.0}) for at in (100, 100, 200)), names='a')
    for ms, words in (
            (90, 'the first state of a is 0.010 s newer than the picture'),
            (290, 'the newest state of a is 0.090 s older than the picture'),
            (140, 'the nearest newer state of a is 0.060 s from the picture; .* at most 0.05 s')):
        with pytest.raises(KinematicsError, match=words):
            known.at(ms * MS, 0.05)


def test_new_states_are_told_from_those_sent_again():
    known = JointHistory(['a'])
    for ms, received, new in ((100, 1, True), (110, 2, True), (110, 3, False), (100, 4, False)):
        assert known.add(joints(ms * MS, a=1.0), received) == new
    assert known.at(105 * MS, 1).received == 1  # as old as the first
    assert not known.add(joints(120 * MS, other=1.0), 5)


def test_joints_of_other_names_are_named():
    known = JointHistory(['left_a', 'left_b'])
    known.add(joints(100 * MS, a=1.0, b=2.0), 0)
    with pytest.raises(KinematicsError, match='of left_a; joint states tell of a, b; is the pre'):
        known.at(100 * MS, 1)
    known.add(joints(100 * MS, left_b=1.0), 0)
    with pytest.raises(KinematicsError, match='of left_a$'):
        known.at(100 * MS, 1)


def test_a_clock_that_goes_back_is_believed_when_it_says_so_again():
    known = history((5000, {'a': 1.0}), names='a')
    assert not known.add(joints(100 * MS, a=2.0), 1)
    assert not known.add(joints(110 * MS, a=2.0), 2)
    assert known.at(5000 * MS, 1).positions == [1]
    assert known.add(joints(120 * MS, a=2.0), 3)
    assert known.at(120 * MS, 1).positions == [2]


def test_a_position_that_no_joint_has_is_refused():
    known = JointHistory(['a', 'b'])
    for position in (np.nan, np.inf, 1e30):
        with pytest.raises(KinematicsError, match='b is at '):
            known.add(joints(100 * MS, a=1.0, b=position), 0)
    assert known.missing() == ['a', 'b']


ARM = replace(UR10E, mount=Mount((0.2, 0.6, -0.05), 0.4, 0.15))
AT = [-0.1, 0.05, 0.08]


def arm_message(angles, stamp_ns, **more):
    named = {f'left_{name}': angle for name, angle in zip(UR10E.joints, angles)}
    return joints(stamp_ns, **dict(reversed(named.items())), **more)


def test_the_gripper_is_where_the_mounted_arm_holds_it():
    gripper = GripperHistory(ARM, 'left_', 0.25)
    angles = ARM.joints_at(AT)
    assert gripper.received == -np.inf
    assert gripper.take(arm_message(angles, 98 * MS), 1) and gripper.received == 1
    gripper.take(arm_message(angles, 102 * MS), 2)
    found, received = gripper.at(100 * MS, 0.35)
    np.testing.assert_allclose(found, [*AT, 0.25], atol=1e-6)
    assert found.dtype == np.float32 and received == 1
    assert not gripper.take(joints(100 * MS, gripper_opening=0.7), 3)
    assert gripper.at(101 * MS, 0.35)[0][3] == np.float32(0.7)  # the newest holds
    gripper.take(joints(102 * MS, gripper_opening=0.9), 3)
    assert gripper.at(101 * MS, 0.35)[0][3] == np.float32(0.7)
    assert gripper.at(102 * MS, 0.35)[0][3] == np.float32(0.9)
    with pytest.raises(KinematicsError, match='left_shoulder_pan_joint is 0.098 s older'):
        gripper.at(200 * MS, 0.35)


def test_a_gripper_that_is_told_counts_and_arm_joints_beside_it_do_not():
    gripper = GripperHistory(ARM, 'left_', 0.25)
    for stamp, x in ((100, 0.1), (110, 0.3)):
        told = dict(zip(('gripper_x', 'gripper_y', 'gripper_z', 'gripper_opening'),
                        (x, -0.2, 0.05, 10 * x - 1)))
        assert gripper.take(arm_message([0.0] * 6, stamp * MS, **told), stamp)
    found, received = gripper.at(105 * MS, 0.35)
    np.testing.assert_allclose(found, [0.2, -0.2, 0.05, 1], rtol=1e-6)
    assert received == 100
    unopened = GripperHistory(ARM, '', 0.25)
    unopened.take(joints(100 * MS, gripper_x=0.1, gripper_y=0.2, gripper_z=0.3), 0)
    with pytest.raises(KinematicsError, match='nothing is known of gripper_opening'):
        unopened.at(100 * MS, 0.35)
