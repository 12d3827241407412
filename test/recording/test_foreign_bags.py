# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Bags that others recorded, with other topics, encodings, clocks and habits."""

from made_episodes import assert_all_equal, make_episode
import numpy as np
import pytest
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import get_typestore, Stores
from tap_ros.errors import RecordingError
from tap_ros.messages.topics import resolve
from tap_ros.recording.cache import open_recordings
from tap_ros.recording.messages import encode
from tap_ros.recording.reader import iter_episodes
from tap_ros.recording.reading import Reading
from tap_ros.recording.writer import BagWriter, EpisodeWriter

IMAGE = 'sensor_msgs/msg/Image'
SECOND = 10**9


def header(stamp):
    return {'stamp': {'sec': stamp // SECOND, 'nanosec': stamp % SECOND}, 'frame_id': 'camera'}


def image(stamp, pixels, encoding='rgb8', step=None):
    """Encode pixels (H, W, C) or (H, W) with rows of `step` bytes."""
    rows = pixels.reshape(len(pixels), -1)
    step = step or rows.shape[1]
    padded = np.pad(rows, ((0, 0), (0, step - rows.shape[1])), constant_values=99)
    return encode(IMAGE, {
        'header': header(stamp), 'height': len(pixels), 'width': pixels.shape[1],
        'encoding': encoding, 'step': step, 'data': padded})


def twist(stamp, x):
    return encode('geometry_msgs/msg/TwistStamped', {
        'header': header(stamp), 'twist': {'linear': {'x': x}}})


def joints(stamp, names, positions):
    return encode('sensor_msgs/msg/JointState', {
        'header': header(stamp), 'name': names, 'position': positions})


def mark(stamp, event, outcome='', seed=1):
    return encode('tap_msgs/msg/Episode', {
        'header': header(stamp), 'event': event, 'task': 'push2', 'seed': seed,
        'outcome': outcome})


def record(folder, messages):
    """Write (topic, type, data, log time) messages into a bag."""
    with BagWriter(folder) as writer:
        for topic, kind, data, log in messages:
            writer.write_raw(topic, kind, data, log)
    return folder


def camera(t, log=None, value=None, topic='/camera/image_raw'):
    """Return the message of a small frame whose pixels are its second."""
    value = t if value is None else value
    data = image(t * SECOND, np.full((2, 3, 3), value, np.uint8))
    return topic, IMAGE, data, round((t if log is None else log) * SECOND)


def command(t, x, log=None):
    return ('/arm/delta_twist_cmds', 'geometry_msgs/msg/TwistStamped',
            twist(round(t * SECOND), x), round((t if log is None else log) * SECOND))


def gripper(log, opening):
    return ('/gripper/command', 'std_msgs/msg/Float64',
            encode('std_msgs/msg/Float64', {'data': opening}), round(log * SECOND))


def episode_mark(t, event, outcome='', log=None):
    return ('/episode', 'tap_msgs/msg/Episode', mark(t * SECOND, event, outcome),
            round((t if log is None else log) * SECOND))


def test_a_bag_of_rosbags_with_images_only(tmp_path):
    store = get_typestore(Stores.ROS2_JAZZY)
    kinds = store.types
    frames = np.random.default_rng(0).integers(0, 256, (4, 5, 7, 3), np.uint8)
    with Writer(tmp_path / 'bag', version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        connection = writer.add_connection('/camera/image_raw', IMAGE, typestore=store)
        for t, frame in enumerate(frames):
            message = kinds[IMAGE](
                header=kinds['std_msgs/msg/Header'](
                    stamp=kinds['builtin_interfaces/msg/Time'](sec=t, nanosec=7), frame_id='cam'),
                height=5, width=7, encoding='rgb8', is_bigendian=0, step=21, data=frame.ravel())
            writer.write(connection, t * SECOND, store.serialize_cdr(message, IMAGE))
    for (episode,) in (iter_episodes(tmp_path / 'bag'), open_recordings(tmp_path / 'bag')):
        np.testing.assert_array_equal(episode.frames, frames)
        assert episode.stamps.tolist() == [t * SECOND + 7 for t in range(4)]
        assert not episode.actions.any()
        assert np.isnan(episode.grippers).all()
        assert episode.object_names == () and episode.object_poses.shape == (4, 0, 7)
        assert episode.goal_frame is None and episode.goal_poses.shape == (0, 7)
        assert (episode.task, episode.seed, episode.outcome) == ('', 0, '')


def test_frames_of_changing_headers_stay_in_order(tmp_path):
    frames = np.random.default_rng(1).integers(0, 256, (9, 2, 3, 3), np.uint8)
    messages = []
    for t, frame in enumerate(frames):
        encoding = ('rgb8', 'bgr8')[t % 2]
        pixels = frame if encoding == 'rgb8' else frame[..., ::-1]
        data = encode(IMAGE, {
            'header': {'stamp': {'sec': t}, 'frame_id': 'c' * (t % 3 * 5)}, 'height': 2,
            'width': 3, 'encoding': encoding, 'step': 9, 'data': np.ascontiguousarray(pixels)})
        messages.append(('/camera/image_raw', IMAGE, data, t * SECOND))
    record(tmp_path / 'bag', messages)
    (episode,) = open_recordings(tmp_path / 'bag')
    np.testing.assert_array_equal(episode.frames, frames)


@pytest.mark.parametrize('changes, words', [
    ({'encoding': '32FC1'}, "encoding '32FC1' .*more than 8 bits a channel, as depth cameras"),
    ({'step': 8}, 'step is 8 bytes, but 3 pixels'), ({'data': bytes(17)}, 'data has 17 bytes'),
    ({'width': 2**31}, 'step is 9')])
def test_unusable_images_are_named(tmp_path, changes, words):
    message = {'height': 2, 'width': 3, 'encoding': 'rgb8', 'step': 9, 'data': bytes(18)}
    record(tmp_path / 'bag', [
        ('/camera/image_raw', IMAGE, encode(IMAGE, message | changes), 0)])
    with pytest.raises(RecordingError, match=f'bag_0.mcap: topic /camera/image_raw: .*{words}'):
        open_recordings(tmp_path / 'bag')


@pytest.mark.parametrize('topic', ['/front/rgb', '/camera/color/image_raw', '/image_raw'])
def test_another_image_topic_is_found_where_it_is_the_only_one(tmp_path, topic):
    record(tmp_path / 'bag', [camera(t, topic=topic) for t in range(1, 4)])
    (episode,) = open_recordings(tmp_path / 'bag')
    assert episode.frames[:, 0, 0, 0].tolist() == [1, 2, 3]


def test_of_two_other_image_topics_one_has_to_be_named(tmp_path):
    record(tmp_path / 'bag', [camera(t, topic='/front/rgb') for t in range(1, 4)]
           + [camera(t, topic='/side/rgb') for t in range(4, 7)])
    with pytest.raises(RecordingError, match='--image-topic.*/front/rgb.*/side/rgb'):
        open_recordings(tmp_path / 'bag')
    (episode,) = open_recordings(tmp_path / 'bag', reading=Reading('/side/rgb'))
    assert episode.frames[:, 0, 0, 0].tolist() == [4, 5, 6]


def test_a_goal_is_not_taken_for_the_camera():
    with pytest.raises(RecordingError, match='no topic ends in /camera/image_raw'):
        resolve({'/goal/image': IMAGE, '/camera/robot_mask': IMAGE}, 'bag')


def test_topics_in_a_namespace(tmp_path, episodes):
    with EpisodeWriter(tmp_path / 'a.mcap') as writer:
        for episode in episodes:
            writer.write(episode)
    from mcap.reader import make_reader
    with open(tmp_path / 'a.mcap', 'rb') as stream:
        record(tmp_path / 'bag', [
            ('/robot1' + channel.topic, schema.name, message.data, message.log_time)
            for schema, channel, message in make_reader(stream).iter_messages(
                log_time_order=False)])
    assert_all_equal(iter_episodes(tmp_path / 'bag'), episodes)


def test_two_robots_are_told_apart_by_the_image_topic():
    kinds = {'camera/image_raw': IMAGE, 'joint_states': 'sensor_msgs/msg/JointState',
             'objects': 'tap_msgs/msg/ObjectStates', 'goal/objects': 'tap_msgs/msg/ObjectStates'}
    available = {f'/{robot}/{name}': kind for robot in 'ab' for name, kind in kinds.items()}
    with pytest.raises(RecordingError, match='several topics could be /camera/image_raw'):
        resolve(available, 'bag')
    assert resolve(available, 'bag', '/b/camera/image_raw') == {
        columns: f'/b/{name}' for columns, name in zip(
            ('frame', 'joint', 'object', 'goal_object'), kinds)}


def test_goal_objects_are_not_taken_for_objects():
    available = {'/camera/image_raw': IMAGE, '/goal/objects': 'tap_msgs/msg/ObjectStates'}
    assert 'object' not in resolve(available, 'bag')


def test_a_topic_of_another_type_is_not_ours():
    available = {'/camera/image_raw': IMAGE, '/objects': 'vision_msgs/msg/Detection2DArray'}
    assert resolve(available, 'bag') == {'frame': '/camera/image_raw'}


def test_actions_belong_to_the_frame_before_them(tmp_path):
    record(tmp_path / 'bag', [
        command(0.5, 9), *(camera(t) for t in range(1, 6)), command(1, 1), command(1.9, 2),
        command(3.5, 3), command(5, 8)])
    (episode,) = iter_episodes(tmp_path / 'bag')
    assert episode.actions[:, 0].tolist() == [2, 0, 3, 0, 0]  # the last one wins; none: zero


def test_commands_without_a_stamp_go_by_the_log(tmp_path):
    record(tmp_path / 'bag', [
        camera(1), command(0, 1, log=1.5), camera(2), camera(3), command(0, 3, log=3.1),
        camera(4)])
    (episode,) = iter_episodes(tmp_path / 'bag')
    assert episode.actions[:, 0].tolist() == [1, 0, 3, 0]


def test_the_gripper_keeps_its_opening_within_an_episode(tmp_path):
    record(tmp_path / 'bag', [
        episode_mark(1, 0), camera(1), camera(2), gripper(2.5, 0.5), camera(3), camera(4),
        gripper(4.1, 1), camera(5), episode_mark(5, 1, 'success'),
        episode_mark(6, 0), camera(6), camera(7), gripper(7.2, 0.25), camera(8),
        episode_mark(8, 1)])
    first, second = iter_episodes(tmp_path / 'bag')
    assert first.actions[:, 3].tolist() == [0, 0.5, 0.5, 1, 0]
    assert second.actions[:, 3].tolist() == [0, 0.25, 0]


def test_states_are_interpolated_and_near_ones_hold(tmp_path):
    names = ['other', 'gripper_opening', 'gripper_z', 'gripper_y', 'gripper_x']
    messages = [camera(t) for t in range(1, 5)]
    for t in (0.9, 1.2, 1.6, 3.0, 3.0):
        positions = [7, t + len(messages), 0.3, 0.2, 0.1]
        messages.append(('/joint_states', 'sensor_msgs/msg/JointState',
                         joints(round(t * SECOND), names, positions), round(t * SECOND)))
    record(tmp_path / 'bag', messages)
    (episode,) = iter_episodes(tmp_path / 'bag')
    np.testing.assert_allclose(episode.grippers[:3, :3], [[0.1, 0.2, 0.3]] * 3, rtol=1e-6)
    np.testing.assert_allclose(episode.grippers[:3, 3], [4.9 + 1.3 / 3, 7.6, 11.0], rtol=1e-6)
    assert np.isnan(episode.grippers[3]).all()


@pytest.mark.parametrize('off, known', [(0.5, True), (0.5 + 1e-9, False)])
def test_states_hold_for_half_a_frames_time_and_no_longer(tmp_path, off, known):
    def state(t):
        return ('/joint_states', 'sensor_msgs/msg/JointState',
                joints(round(t * SECOND), ['gripper_x'], [t]), round(t * SECOND))
    record(tmp_path / 'bag', [state(3 - off), *map(camera, (3, 4, 5)), state(5 + off)])
    (episode,) = iter_episodes(tmp_path / 'bag')
    expected = [3 - off, np.nan, 5 + off] if known else [np.nan] * 3
    np.testing.assert_allclose(episode.grippers[:, 0], expected, rtol=1e-6)


def test_of_two_states_equally_near_the_earlier_one_counts(tmp_path):
    def state(t):
        return ('/joint_states', 'sensor_msgs/msg/JointState',
                joints(round(t * SECOND), ['gripper_x'], [t]), round(t * SECOND))
    record(tmp_path / 'bag', [*map(camera, (3, 4, 5)), state(3.5), state(4.5)])
    (episode,) = iter_episodes(tmp_path / 'bag')
    np.testing.assert_allclose(episode.grippers[:, 0], [3.5, 3.5, 4.5])


def test_states_of_other_joints_are_no_gripper_states(tmp_path):
    def state(t, name, log):
        return ('/joint_states', 'sensor_msgs/msg/JointState',
                joints(round(t * SECOND), [name], [0.5]), round(log * SECOND))
    record(tmp_path / 'bag', [
        camera(1), state(1.01, 'gripper_x', 1.01), state(1, 'wheel', 1.02), camera(2)])
    (episode,) = iter_episodes(tmp_path / 'bag')
    assert episode.grippers[0, 0] == 0.5


def test_commands_logged_out_of_order_are_put_in_order(tmp_path):
    record(tmp_path / 'bag', [
        camera(1), camera(2), camera(3), gripper(2.5, 0.5), gripper(1.5, 0.25)])
    (episode,) = iter_episodes(tmp_path / 'bag')
    assert episode.actions[:, 3].tolist() == [0.25, 0.5, 0]


def test_objects_are_matched_by_name(tmp_path):
    def objects(t, **us):
        data = encode('tap_msgs/msg/ObjectStates', {
            'header': header(t * SECOND), 'objects': [{'name': n, 'u': u} for n, u in us.items()]})
        return '/objects', 'tap_msgs/msg/ObjectStates', data, t * SECOND
    record(tmp_path / 'bag', [
        camera(1), objects(1, a=1, b=2), camera(2), objects(2, b=4, a=3), camera(3),
        objects(3, b=6, c=7)])
    (episode,) = iter_episodes(tmp_path / 'bag')
    assert episode.object_names == ('a', 'b')
    np.testing.assert_array_equal(
        episode.object_pixels[..., 0], [[1, 2], [3, 4], [np.nan, 6]])


def test_marks_cut_episodes_and_frames_between_them_are_left_out(tmp_path):
    record(tmp_path / 'bag', [
        camera(1), episode_mark(2, 0), camera(2), camera(3), episode_mark(3, 1, 'failure'),
        camera(4), camera(5), episode_mark(6, 0), camera(6), episode_mark(6, 1, 'success'),
        camera(7)])
    episodes = list(iter_episodes(tmp_path / 'bag'))
    assert [e.frames[:, 0, 0, 0].tolist() for e in episodes] == [[2, 3], [6]]
    assert [e.outcome for e in episodes] == ['failure', 'success']


def test_interrupted_episodes_are_kept(tmp_path):
    record(tmp_path / 'bag', [
        camera(1), camera(2), episode_mark(2, 1, 'failure'),  # its start was not recorded
        episode_mark(3, 0), camera(3), camera(4),  # no end
        episode_mark(5, 0), episode_mark(5, 1),  # no frame
        episode_mark(6, 0), camera(6), camera(7)])
    episodes = list(iter_episodes(tmp_path / 'bag'))
    assert [e.frames[:, 0, 0, 0].tolist() for e in episodes] == [[1, 2], [3, 4], [6, 7]]
    assert [e.outcome for e in episodes] == ['failure', 'interrupted', 'interrupted']


def test_marks_may_overtake_images(tmp_path):
    record(tmp_path / 'bag', [
        camera(1, log=11), episode_mark(1, 0, log=11.1), camera(2, log=12),
        episode_mark(3, 1, 'success', log=12.9), camera(3, log=13),
        camera(4, log=14), episode_mark(4, 0, log=14.2), camera(5, log=15),
        episode_mark(5, 1, 'failure', log=15)])
    episodes = list(iter_episodes(tmp_path / 'bag'))
    assert [e.frames[:, 0, 0, 0].tolist() for e in episodes] == [[1, 2, 3], [4, 5]]


def test_frames_stamped_beyond_the_end_are_left_out_however_early_they_are_logged(tmp_path):
    record(tmp_path / 'bag', [
        episode_mark(1, 0), camera(1), camera(2), camera(3), camera(4, log=3.1), command(4, 9),
        episode_mark(3, 1, 'success', log=3.2), camera(5, log=3.4)])
    (episode,) = iter_episodes(tmp_path / 'bag')
    assert episode.frames[:, 0, 0, 0].tolist() == [1, 2, 3]
    assert not episode.actions.any()


def test_a_clock_that_starts_anew_does_not_mix_episodes(tmp_path):
    messages = []
    for number in range(3):
        log = 100 * number
        messages += [episode_mark(1, 0, log=log + 1)]
        messages += [camera(t, log=log + t, value=10 * number + t) for t in range(1, 4)]
        messages += [command(t, 10 * number + t, log=log + t) for t in range(1, 3)]
        messages += [episode_mark(3, 1, 'success', log=log + 3)]
    record(tmp_path / 'bag', messages)
    for number, episode in enumerate(iter_episodes(tmp_path / 'bag')):
        assert episode.frames[:, 0, 0, 0].tolist() == [10 * number + t for t in range(1, 4)]
        assert episode.actions[:, 0].tolist() == [10 * number + 1, 10 * number + 2, 0]
    assert number == 2


def test_a_goal_holds_until_the_next(tmp_path):
    def goal(t, value):
        data = image(t * SECOND, np.full((2, 3, 3), value, np.uint8))
        return '/goal/image', IMAGE, data, t * SECOND
    messages = [goal(1, 50)]
    for t in (2, 4, 6):
        messages += [episode_mark(t, 0), camera(t), camera(t + 1), episode_mark(t + 1, 1)]
        if t == 4:
            messages.append((*goal(6, 60)[:3], 5 * SECOND))  # of the next, logged early
    record(tmp_path / 'bag', messages)
    assert [e.goal_frame[0, 0, 0] for e in iter_episodes(tmp_path / 'bag')] == [50, 50, 60]


def test_an_episode_may_span_files(tmp_path):
    whole = [
        episode_mark(1, 0), *(m for t in range(1, 20) for m in (camera(t), command(t, t))),
        episode_mark(19, 1, 'success'), episode_mark(20, 0), camera(20), camera(21),
        episode_mark(21, 1, 'failure')]
    for number, part in enumerate((whole[:11], whole[11:24], whole[24:])):
        record(tmp_path / str(number), part)
        (tmp_path / str(number) / f'{number}_0.mcap').rename(tmp_path / f'bag_{number}.mcap')
    for episodes in (list(iter_episodes(tmp_path)), list(open_recordings(tmp_path))):
        assert [e.frames[:, 0, 0, 0].tolist() for e in episodes] == [
            list(range(1, 20)), [20, 21]]
        assert episodes[0].actions[:, 0].tolist() == [*range(1, 19), 0]
        assert [e.outcome for e in episodes] == ['success', 'failure']


def test_frames_logged_out_of_order_are_put_in_order(tmp_path):
    record(tmp_path / 'bag', [camera(t) for t in (3, 1, 5, 2, 4)])
    for (episode,) in (iter_episodes(tmp_path / 'bag'), open_recordings(tmp_path / 'bag')):
        assert episode.frames[:, 0, 0, 0].tolist() == [1, 2, 3, 4, 5]


def test_a_frame_sent_twice_counts_once(tmp_path):
    record(tmp_path / 'bag', [camera(1), camera(2), camera(2, log=3), camera(4)])
    (episode,) = iter_episodes(tmp_path / 'bag')
    assert episode.stamps.tolist() == [SECOND, 2 * SECOND, 4 * SECOND]
    assert episode.frames[:, 0, 0, 0].tolist() == [1, 2, 4]


def test_images_without_stamps_go_by_the_log(tmp_path):
    record(tmp_path / 'bag', [(*camera(0, value=t)[:3], t * SECOND) for t in range(3, 6)])
    (episode,) = iter_episodes(tmp_path / 'bag')
    assert episode.stamps.tolist() == [3 * SECOND, 4 * SECOND, 5 * SECOND]


def test_messages_of_another_version_are_refused(tmp_path):
    from mcap.writer import Writer as McapWriter
    with open(tmp_path / 'a.mcap', 'wb') as stream:
        writer = McapWriter(stream)
        writer.start('ros2')
        for topic, kind, text in (
                ('/camera/image_raw', IMAGE, 'std_msgs/Header header\nuint32 height\n'),):
            schema = writer.register_schema(kind, 'ros2msg', text.encode())
            writer.add_message(writer.register_channel(topic, 'cdr', schema), 0, b'', 0)
        writer.finish()
    with pytest.raises(RecordingError, match='a.mcap: topic /camera/image_raw: .*header, height;'):
        open_recordings(tmp_path)


def test_single_episode_equals_its_file(tmp_path):
    with EpisodeWriter(tmp_path / 'a.mcap') as writer:
        writer.write(make_episode(3))
    assert_all_equal(open_recordings(str(tmp_path / 'a.mcap')), [make_episode(3)])
