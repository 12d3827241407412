# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Bags that others recorded, with other topics, encodings and habits."""


from made_bags import (
    camera,
    command,
    gripper,
    joints,
    mark,
    objects,
    read,
    record,
    record_files,
    SECOND,
    shown,
)
import numpy as np
import pytest
from tap_ros.base.errors import RecordingError
from tap_ros.recording.cache import open_recordings
from tap_ros.recording.reading import Reading
from tap_ros.recording.topic_choice import Bag


def test_of_a_bag_with_pictures_alone_all_else_is_unknown(tmp_path):
    frames = np.random.default_rng(0).integers(0, 256, (4, 5, 7, 3), np.uint8)
    (episode,), told = read(record(tmp_path / 'bag', [
        camera(t + 7e-9, frame) for t, frame in enumerate(frames)]))
    np.testing.assert_array_equal(episode.frames, frames)
    assert episode.stamps.tolist() == [t * SECOND + 7 for t in range(4)] and not told
    assert not episode.actions.any() and np.isnan(episode.grippers).all()
    assert episode.object_names == () and episode.object_poses.shape == (4, 0, 7)
    assert episode.goal_frame is None and episode.goal_poses.shape == (0, 7)
    assert (episode.task, episode.seed, episode.outcome) == ('', 0, '')


def topics_of(bag, image_topic=''):
    return Bag(sorted(bag.glob('*.mcap'))).choose(image_topic).topics


def test_another_image_topic_is_found_where_it_is_the_only_one_else_named(tmp_path):
    for number, topic in enumerate(('/front/rgb', '/camera/color/image_raw', '/image_raw')):
        bag = record(tmp_path / str(number), [
            camera(1, topic=topic), camera(1, topic='/goal/image'),
            camera(1, topic='/x/subgoal/overlay'), camera(1, topic='/camera/robot_mask')])
        assert 'frame' == topics_of(bag)[topic]
    bag = record(tmp_path / 'bag', [
        camera(t, topic='/front/rgb' if t < 4 else '/side/rgb') for t in range(1, 7)])
    with pytest.raises(RecordingError, match=r'/front/rgb \(3 mes.*/side/rgb.*--image-topic'):
        open_recordings(bag)
    assert shown(read(bag, reading=Reading('/side/rgb'))[0]) == [[4, 5, 6]]
    bag = record(tmp_path / 'none', [camera(1, topic='/goal/image')])
    with pytest.raises(RecordingError, match='no topic ends in /camera/image_raw'):
        open_recordings(bag)


def test_two_robots_are_told_apart_by_the_image_topic(tmp_path):
    bag = record(tmp_path / 'bag', [one for robot in 'ab' for one in (
        camera(1, topic=f'/{robot}/camera/image_raw'), objects(1, f'/{robot}/objects', a=1),
        joints(1, topic=f'/{robot}/joint_states', gripper_x=1))])
    with pytest.raises(RecordingError, match='several topics could be /camera/image_raw: '
                       r'/a/camera/image_raw \(1 messages\), /b/camera/image_raw'):
        open_recordings(bag)
    assert topics_of(bag, '/b/camera/image_raw') == {
        '/b/camera/image_raw': 'frame', '/b/objects': 'object', '/b/joint_states': 'joint'}


ARM = dict.fromkeys(('shoulder_pan_joint', 'shoulder_lift_joint', 'elbow_joint', 'wrist_1_joint',
                     'wrist_2_joint', 'wrist_3_joint'), 0.1)


def test_of_several_joint_states_those_that_tell_of_the_gripper_are_read(tmp_path):
    other = {'/hand/joint_states': {'finger_joint': 0.3}, '/wheels/joint_states': {'left': 1.0}}
    left, right = ({f'{side}_{name}': at for name, at in ARM.items()} for side in ('l', 'r'))
    for number, (told, expected) in enumerate((
            ({'/arm/joint_states': ARM} | other, ['/arm/joint_states']),
            ({'/arm/joint_states': ARM, '/hand/joint_states': {'gripper_opening': 1.0}},
             ['/arm/joint_states', '/hand/joint_states']),
            ({'/joint_states': ARM, '/x/joint_states': ARM}, ['/joint_states']), (other, []),
            ({'/l/joint_states': left, '/r/joint_states': right}, []))):
        bag = record(tmp_path / str(number), [
            camera(t, topic='/cam/rgb') for t in (1, 2)] + [
            joints(t, topic=topic, **names) for topic, names in told.items() for t in (1, 2)])
        found, said = read(bag)
        assert [topic for topic, name in topics_of(bag).items() if name == 'joint'] == expected
        assert len(found[0]) == 2 and bool(said) == ('/l/joint_states' in told)
    assert '/l/joint_states (2 messages), /r/joint_states (2 messages); none is read' in said[0]


def test_actions_belong_to_the_frame_before_them_and_go_by_the_log_without_a_stamp(tmp_path):
    for number, (commands, expected) in enumerate((
            ([command(0.5, 9), command(1, 1), command(1.9, 2), command(3.5, 3), command(5, 8)],
             [2, 0, 3, 0, 0]),  # the last one wins; none: zero
            ([command(0, 1, log=1.5), command(0, 3, log=3.1)], [1, 0, 3, 0, 0]))):
        (episode,), _ = read(record(
            tmp_path / str(number), [*map(camera, range(1, 6)), *commands]))
        assert episode.actions[:, 0].tolist() == expected


def test_the_gripper_keeps_its_opening_within_an_episode(tmp_path):
    (first, second), _ = read(record(tmp_path / 'bag', [
        mark(1, 0), camera(1), camera(2), gripper(4.1, 1), camera(3), camera(4),
        gripper(2.5, 0.5), camera(5), mark(5, 1, 'success'),  # logged out of order
        mark(6, 0), camera(6), camera(7), gripper(7.2, 0.25), camera(8),
        mark(8, 1)]))
    assert first.actions[:, 3].tolist() == [0, 0.5, 0.5, 1, 0]
    assert second.actions[:, 3].tolist() == [0, 0.25, 0]


def test_states_are_interpolated_and_near_ones_hold(tmp_path):
    states = [joints(t, other=7, gripper_opening=x, gripper_z=0.3, gripper_y=0.2, gripper_x=0.1)
              for t, x in ((0.9, 4.9), (1.2, 6.2), (1.6, 7.6), (3, 10), (3, 11))]
    (episode,), _ = read(record(tmp_path / 'bag', [*map(camera, range(1, 5)), *states]))
    np.testing.assert_allclose(episode.grippers[:3, :3], [[0.1, 0.2, 0.3]] * 3, rtol=1e-6)
    np.testing.assert_allclose(episode.grippers[:3, 3], [4.9 + 1.3 / 3, 7.6, 11.0], rtol=1e-6)
    assert np.isnan(episode.grippers[3]).all()


def test_objects_are_matched_by_name(tmp_path):
    (episode,), _ = read(record(tmp_path / 'bag', [
        camera(1), objects(1, a=1, b=2), camera(2), objects(2, b=4, a=3), camera(3),
        objects(3, b=6, c=7)]))
    assert episode.object_names == ('a', 'b')
    np.testing.assert_array_equal(
        episode.object_pixels[..., 0], [[1, 2], [3, 4], [np.nan, 6]])


def test_marks_cut_episodes_and_frames_between_them_are_left_out(tmp_path):
    for number, (messages, expected, outcomes) in enumerate((
            ([camera(1), mark(2, 0), camera(2), camera(3), mark(3, 1, 'failure'),
              camera(4), camera(5), mark(6, 0), camera(6), mark(6, 1, 'success'),
              camera(7)], [[2, 3], [6]], ['failure', 'success']),
            ([camera(1), camera(2), mark(2, 1, 'failure'),  # its start was not recorded
              mark(3, 0), camera(3), camera(4),  # no end
              mark(5, 0), mark(5, 1),  # no frame
              mark(6, 0), camera(6), camera(7)],
             [[1, 2], [3, 4], [6, 7]], ['failure', 'interrupted', 'interrupted']),
            ([camera(1, log=11), mark(1, 0, log=11.1), camera(2, log=12),  # overtaken
              mark(3, 1, 'success', log=12.9), camera(3, log=13), camera(4, log=14),
              mark(4, 0, log=14.2), camera(5, log=15), mark(5, 1, 'failure', log=15)],
             [[1, 2, 3], [4, 5]], ['success', 'failure']),
            ([mark(1, 0), *(camera(1 + n / 10, n + 1) for n in range(4)), command(1.3, 9),
              mark(1.2, 1, 'success', log=1.31), camera(1.4, 5)],  # stamped beyond the end
             [[1, 2, 3]], ['success']))):
        found, _ = read(record(tmp_path / str(number), messages))
        assert shown(found) == expected and [e.outcome for e in found] == outcomes
        assert not any(episode.actions.any() for episode in found)


def test_a_clock_that_starts_anew_does_not_mix_episodes(tmp_path):
    messages = []
    for number in range(3):
        log = 100 * number
        messages += [mark(1, 0, log=log + 1)]
        messages += [camera(t, log=log + t, value=10 * number + t) for t in range(1, 4)]
        messages += [command(t, 10 * number + t, log=log + t) for t in range(1, 3)]
        messages += [mark(3, 1, 'success', log=log + 3)]
    found, told = read(record(tmp_path / 'bag', messages))
    assert shown(found) == [[1, 2, 3], [11, 12, 13], [21, 22, 23]] and not told
    assert [e.actions[:, 0].tolist() for e in found] == [[1, 2, 0], [11, 12, 0], [21, 22, 0]]


def test_a_goal_holds_until_the_next(tmp_path):
    messages = [camera(1, 50, topic='/goal/image')]
    for t in (2, 4, 6):
        messages += [mark(t, 0), camera(t), camera(t + 1), mark(t + 1, 1)]
        if t == 4:  # of the next, logged early
            messages.append(camera(6, 60, log=5, topic='/goal/image'))
    found, _ = read(record(tmp_path / 'bag', messages))
    assert [e.goal_frame[0, 0, 0] for e in found] == [50, 50, 60]


def test_an_episode_may_span_files(tmp_path):
    whole = [mark(1, 0), *(m for t in range(1, 20) for m in (camera(t), command(t, t))),
             mark(19, 1, 'success'), mark(20, 0), camera(20), camera(21), mark(21, 1, 'failure')]
    found, _ = read(record_files(tmp_path, whole[:11], whole[11:24], whole[24:]))
    assert shown(found) == [[*range(1, 20)], [20, 21]]
    assert found[0].actions[:, 0].tolist() == [*range(1, 19), 0]
    assert [e.outcome for e in found] == ['success', 'failure']
