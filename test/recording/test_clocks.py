# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Clocks that lie: every picture is kept, in the order in which it was taken, and it is told."""

import re

from made_bags import camera, joints, mark, read, record
import numpy as np
import pytest

PERIOD, LATE = 0.1, 0.02  # s, between pictures, and until they are logged
WALL = 1.7e9  # s
TIMES = np.arange(40) * PERIOD + np.repeat([0, 12], 20)  # two demonstrations, a pause between


def bag(path, stamps, logs, extra=()):
    """Write numbered pictures, and others' messages, in the order of the true times."""
    messages = [(t, camera(stamp, i, log)) for i, (t, stamp, log) in enumerate(
        zip(TIMES, stamps, logs, strict=True))]
    return record(path, [one for _, one in sorted([*messages, *extra], key=lambda one: one[0])])


def numbers(found):
    return [episode.frames[:, 0, 0, 0].tolist() for episode in found]


WHOLE = [[*range(20)], [*range(20, 40)]]
FRAMES = np.arange(40)


@pytest.mark.parametrize('stamps, words', [
    (np.floor(WALL + TIMES), '36 are repeated'), (np.full(40, 36.858272), '39 are repeated'),
    (WALL + np.repeat(TIMES[::2], 2), '20 are repeated'),
    (np.where(FRAMES % 3, WALL + TIMES, 0), '14 are zero'),
    (np.where(FRAMES == 7, 0, TIMES + 50), '1 are zero'), (np.zeros(40), ''),
    ((TIMES + 0.55) % 1, '4 go back')])
def test_pictures_whose_stamps_tell_nothing_go_by_log_time(tmp_path, stamps, words):
    found, told = read(bag(tmp_path / 'bag', stamps, WALL + TIMES + LATE))
    assert numbers(found) == WHOLE
    np.testing.assert_allclose(np.diff(found[0].stamps), PERIOD * 1e9, atol=1000)
    assert words in ''.join(told) and bool(words) == bool(told)
    assert all('topic /camera/image_raw' in text for text in told)


@pytest.mark.parametrize('back', [0.15, 0.35, 1.97, 3.0, 30.0, 3600.0])
@pytest.mark.parametrize('which', ['both', 'stamps', 'logs'])
def test_a_clock_that_is_set_back_shuffles_no_pictures(tmp_path, back, which):
    if which == 'logs' and back < 0.5:
        return  # jitter of the recorder
    shift = np.where(FRAMES < 10, 0, -back)
    found, told = read(bag(
        tmp_path / 'bag', WALL + TIMES + shift * (which != 'logs'),
        WALL + TIMES + shift * (which != 'stamps') + LATE,
        [(t, joints(WALL + t - back * (t > 0.95) * (which == 'both'), gripper_x=t, gripper_y=0,
                    gripper_z=0, gripper_opening=1, log=WALL + t + LATE - back * (
                        t > 0.95) * (which != 'stamps'))) for t in np.arange(-1, 16, 0.04)]))
    if which == 'stamps' and back > 1:  # from before its beginning: it may be another run
        assert sum(numbers(found), []) == [*range(40)] and len(found) in (2, 3)
    else:
        assert numbers(found) == WHOLE
    assert re.search('set back|was set', ''.join(told)) or len(found) == 3
    if which == 'both':
        np.testing.assert_allclose(
            found[0].grippers[1:-1, 0], TIMES[1:19], atol=0.1)


def test_a_clock_that_is_set_when_it_gets_the_time_cuts_nothing(tmp_path):
    stamps = np.where(FRAMES < 6, 20, WALL) + TIMES
    found, told = read(bag(tmp_path / 'bag', stamps, WALL + TIMES + LATE))
    assert numbers(found) == WHOLE and 'was set 1 times' in told[0]


def test_log_times_that_stand_still_leave_the_order_of_writing(tmp_path):
    for number, stamps in enumerate((WALL + TIMES, np.full(40, 7.0), np.zeros(40))):
        found, told = read(bag(tmp_path / str(number), stamps, np.full(40, WALL), [
            (t, joints(WALL + t, log=WALL, gripper_x=t, gripper_y=0, gripper_z=0))
            for t in TIMES + 0.01]))
        assert sum(numbers(found), []) == [*range(40)] and 'stand still' in told[0]
    assert number == 2 and len(read(tmp_path / '0')[0]) == 2


def test_marks_and_states_of_another_clock_are_brought_to_the_cameras(tmp_path):
    stamps = 36.5 + TIMES  # since it was switched on
    extra = [(t, joints(WALL + t, log=WALL + t + 0.001, gripper_x=t, gripper_y=0, gripper_z=0))
             for t in np.arange(-0.5, 15, 0.03)]
    found, told = read(bag(tmp_path / 'bag', stamps, WALL + TIMES + LATE, extra))
    np.testing.assert_allclose(found[0].grippers[:, 0], TIMES[:20], atol=0.05)
    assert 'topic /joint_states: its clock and that of the camera are 16999' in ''.join(told)
    marks = [(t, mark(WALL + t, event, 'success' if event else '', WALL + t + LATE))
             for t, event in ((-0.05, 0), (1.95, 1), (13.95, 0), (16, 1))]
    goal = (-9, camera(WALL - 9, 77, topic='/goal/image', log=WALL - 0.2))
    found, told = read(bag(tmp_path / 'marked', stamps, WALL + TIMES + LATE,
                           [*extra, *marks, goal]))
    assert numbers(found) == WHOLE and [e.outcome for e in found] == ['success'] * 2
    assert found[1].goal_frame[0, 0, 0] == 77


def test_states_whose_stamps_stand_still_go_by_log_time(tmp_path):
    for number, stamp in enumerate((lambda t: np.floor(WALL + t), lambda t: 12.0, lambda t: 0)):
        found, _ = read(bag(tmp_path / str(number), WALL + TIMES, WALL + TIMES + LATE, [
            (t, joints(stamp(t), log=WALL + t + LATE, gripper_x=t, gripper_y=0, gripper_z=0))
            for t in np.arange(-0.5, 15, 0.03)]))
        np.testing.assert_allclose(found[0].grippers[:, 0], TIMES[:20], atol=0.06)


def test_a_rate_goes_by_log_time_where_stamps_repeat(tmp_path):
    from tap_ros.recording.reading import Reading
    for number, stamps in enumerate((np.floor(WALL + TIMES), np.full(40, 5.0), WALL + TIMES)):
        found, _ = read(bag(tmp_path / str(number), stamps, WALL + TIMES + LATE),
                        reading=Reading(rate=5))
        assert [len(episode) for episode in found] == [10, 10]


def test_a_picture_that_is_sent_again_counts_once(tmp_path):
    times = np.repeat(TIMES[::2], 2)
    messages = [camera(WALL + t, int(round(t * 10)) % 256, WALL + t + LATE + 0.02 * (i % 2))
                for i, t in enumerate(times)]
    found, told = read(record(tmp_path / 'bag', messages))
    assert [len(episode) for episode in found] == [10, 10] and not told
