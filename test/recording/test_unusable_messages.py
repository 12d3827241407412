# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Messages that cannot be used cost themselves and are named."""

import re

from made_bags import (
    camera,
    mark,
    objects,
    read,
    record,
    record_files,
    SECOND,
)

BAD = {
    'another size': {'height': 4, 'width': 4, 'step': 12, 'data': bytes(48)},
    'as many bytes': {'height': 3, 'width': 2, 'step': 6},
    'rgb16': {'encoding': 'rgb16', 'step': 18, 'data': bytes(36)},
    'empty': {'height': 0, 'width': 0, 'step': 0, 'data': b''}, 'wrong step': {'step': 8}}


def test_a_bad_picture_costs_itself_alone(tmp_path):
    whole = [mark(1, 0), *map(camera, range(1, 7)), mark(6, 1, 'success'), mark(8, 0), camera(8),
             mark(8, 1, 'failure')]
    for at in (1, 4, 6):
        topic, kind, data, log = camera(at)
        bad = [camera(at, **changes) for changes in BAD.values()] if at == 4 else []
        for number, one in enumerate([*bad, (topic, kind, data[:40], log)]):
            found, (text,) = read(record(tmp_path / str(at) / str(number) / 'bag', [
                one if m == (topic, kind, data, log) else m for m in whole]))
            assert re.search(f'topic /camera/image_raw: 1 message .*log time {at}.000000000', text)
            assert [e.frames[:, 0, 0, 0].tolist() for e in found] == [
                [t for t in range(1, 7) if t != at], [8]]
            assert [e.outcome for e in found] == ['success', 'failure']


def test_goals_that_cannot_be_used_take_back_those_before(tmp_path):
    for name, changes in BAD.items():
        goals = camera(1, 50, topic='/goal/image'), camera(3, 60, topic='/goal/image', **changes)
        (first, second), told = read(record(tmp_path / name, [
            mark(1, 0), goals[0], camera(1), mark(1, 1), mark(3, 0), goals[1], camera(3),
            mark(3, 1)]))
        assert first.goal_frame[0, 0, 0] == 50
        assert second.goal_frame is None
        assert bool(told) == (name != 'empty')  # an empty one says that there is no goal
    topic, kind, data, _ = objects(1, '/goal/objects', a=5)
    (first, second), (text,) = read(record(tmp_path / 'bag', [
        mark(1, 0), (topic, kind, data, SECOND), camera(1), mark(1, 1), mark(3, 0),
        (topic, kind, data[:-9], 3 * SECOND), camera(3), mark(3, 1)]))
    assert 'topic /goal/objects: 1 message cannot be used' in text
    assert first.object_names == ('a',) and first.goal_pixels.tolist() == [[5, 0]]
    assert second.object_names == ()


def test_a_goal_does_not_hold_beyond_a_file_that_is_cut_off(tmp_path):
    late = 2 * SECOND + 1  # the next nanosecond, in the next file
    bag = record_files(
        tmp_path / 'bag', [mark(1, 0), camera(1, 50, topic='/goal/image'), camera(2)],
        [(*camera(3)[:3], late), (*mark(3, 1, 'success')[:3], late)])
    data = (bag / 'bag_0.mcap').read_bytes()
    (bag / 'bag_0.mcap').write_bytes(data[:data.rindex(b'\x0f\4' + bytes(7))])
    (first, second), (text,) = read(bag)
    assert 'cut off' in text and first.goal_frame[0, 0, 0] == 50
    assert second.frames[:, 0, 0, 0].tolist() == [3] and second.goal_frame is None
