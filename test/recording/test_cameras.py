# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Recordings of any camera: compressed, large, fast, unmarked."""

from dataclasses import replace
import io

import cv2
from made_episodes import make_episode
import numpy as np
from PIL import Image as Picture
import pytest
from tap_ros.cli import main
from tap_ros.errors import ConfigError, RecordingError
from tap_ros.images.crop import Crop
from tap_ros.recording.bags import check_first_picture, reading_like
from tap_ros.recording.cache import open_recordings
from tap_ros.recording.messages import encode
from tap_ros.recording.reader import iter_episodes
from tap_ros.recording.reading import Reading
from tap_ros.recording.writer import BagWriter, EpisodeWriter

COMPRESSED = 'sensor_msgs/msg/CompressedImage'
IMAGE = 'sensor_msgs/msg/Image'
TOPIC = '/camera/color/image_raw/compressed'
SECOND = 10**9


def scene(t, size=(48, 64)):
    """Return a smooth picture with a dot that moves."""
    y, x = np.mgrid[:size[0], :size[1]]
    picture = np.stack([x * 255 // size[1], y * 255 // size[0], np.full_like(x, 90)], -1)
    return cv2.circle(picture.astype(np.uint8), (20 + t % 20, 24), 4, (250, 40, 20), -1)


def packed(picture, form='JPEG'):
    buffer = io.BytesIO()
    Picture.fromarray(picture).save(buffer, form, **({'quality': 90} if form == 'JPEG' else {}))
    return buffer.getvalue()


def header(stamp):
    return {'stamp': {'sec': stamp // SECOND, 'nanosec': stamp % SECOND}, 'frame_id': 'camera'}


def record(folder, pictures, stamps, form='JPEG', text='rgb8; jpeg compressed bgr8'):
    """Write compressed pictures, some of them raw bytes, into a bag without marks."""
    with BagWriter(folder) as writer:
        for picture, stamp in zip(pictures, stamps):
            data = picture if isinstance(picture, bytes) else packed(picture, form)
            writer.write_raw(TOPIC, COMPRESSED, encode(COMPRESSED, {
                'header': header(stamp), 'format': text, 'data': np.frombuffer(data, np.uint8)}),
                stamp)
    return folder


@pytest.mark.parametrize('form', ['JPEG', 'PNG', 'WEBP'])
def test_compressed_pictures_are_read(tmp_path, form):
    pictures = [scene(t) for t in range(3)]
    bag = record(tmp_path / 'bag', pictures, [SECOND * (t + 1) for t in range(3)], form)
    for (episode,) in (open_recordings(bag), iter_episodes(bag)):
        error = np.abs(episode.frames.astype(int) - np.stack(pictures))
        assert error.max() == 0 if form == 'PNG' else error.mean() < 4
        assert episode.stamps.tolist() == [SECOND, 2 * SECOND, 3 * SECOND]


@pytest.mark.parametrize('bad, words', [
    (packed(scene(0))[:400], 'damaged compressed picture'),
    (b'no picture', "format 'rgb8; jpeg compressed bgr8' cannot be used; valid are JPEG, PNG"),
    (b'', 'is empty')])
def test_a_compressed_picture_that_cannot_be_read_is_named_and_left_out(tmp_path, bad, words):
    bag = record(tmp_path / 'bag', [scene(0), bad, scene(2)], [SECOND, 2 * SECOND, 3 * SECOND])
    with pytest.warns(match=f'{TOPIC}: 1 message cannot be used: {words}'):
        episodes = list(iter_episodes(bag))
    assert [len(episode.frames) for episode in episodes] == [1, 1]  # cut where one is missing


def test_pictures_are_cut_and_scaled_while_they_are_decoded(tmp_path):
    pictures = [scene(t, (480, 640)) for t in range(4)]
    stamps = [SECOND * (t + 1) for t in range(4)]
    bag = record(tmp_path / 'bag', pictures, stamps, 'PNG')
    store = open_recordings(bag, tmp_path / 'cache', reading=Reading(crop='centre', size=64))
    assert (store.image_size, store.camera_size) == ((64, 64), (480, 640))
    expected = np.stack([Crop('centre', 64).image(picture) for picture in pictures])
    np.testing.assert_array_equal(store[0].frames, expected)
    (episode,) = iter_episodes(bag, Reading(crop='centre', size=64))
    np.testing.assert_array_equal(episode.frames, expected)
    # What is kept is as large as what is used.
    assert sum(f.stat().st_size for f in (tmp_path / 'cache').rglob('frames')) < 5 * 64 * 64 * 3
    whole = open_recordings(bag, tmp_path / 'cache')
    np.testing.assert_array_equal(whole[0].frames, pictures)
    assert whole.data_hash != store.data_hash


def test_objects_goals_and_masks_are_cut_with_the_picture(tmp_path):
    episode = make_episode()
    masks = np.zeros(episode.frames.shape[:3], np.uint8)
    masks[:, 2:4, 5:7] = 255
    goal_mask = masks[0]
    with EpisodeWriter(tmp_path / 'a.mcap') as writer:
        writer.write(type(episode)(**vars(episode) | {
            'robot_masks': masks, 'goal_mask': goal_mask}))
    (cut,) = open_recordings(tmp_path, reading=Reading(crop='3,1,6'))
    np.testing.assert_array_equal(cut.frames, episode.frames[:, 1:7, 3:9])
    np.testing.assert_array_equal(cut.goal_frame, episode.goal_frame[1:7, 3:9])
    np.testing.assert_array_equal(cut.robot_masks, masks[:, 1:7, 3:9])
    np.testing.assert_array_equal(cut.goal_mask, goal_mask[1:7, 3:9])
    np.testing.assert_allclose(cut.object_pixels, episode.object_pixels - [3, 1], atol=1e-4)
    np.testing.assert_allclose(cut.goal_pixels, episode.goal_pixels - [3, 1], atol=1e-4)


@pytest.mark.parametrize('reading, words', [
    (Reading(size=32), 'pictures of 64x48 pixels .* are not square; .*--crop centre'),
    (Reading(crop='40,0,48'), 'crop 40,0,48 reaches beyond a picture of 64x48 pixels')])
def test_a_cut_that_cannot_be_made_is_refused_with_the_reason(tmp_path, reading, words):
    bag = record(tmp_path / 'bag', [scene(0)], [SECOND])
    with pytest.raises(RecordingError, match=words):
        open_recordings(bag, reading=reading)


@pytest.mark.parametrize('changes, words', [
    ({'crop': 'middle'}, 'crop: expected centre, or LEFT,TOP,SIDE'),
    ({'crop': '1,2,0'}, 'crop: expected'), ({'size': -1}, 'size: expected 0 to 4096'),
    ({'rate': -1.0}, 'rate: expected 0 to')])
def test_readings_that_make_no_sense_are_refused(changes, words):
    with pytest.raises(ConfigError, match=words):
        Reading(**changes)


@pytest.mark.parametrize('hertz, rate, least, most', [
    (30, 4, 3.6, 4.1), (30, 10, 9.5, 10.1), (4, 4, 4, 4.1), (4, 10, 4, 4.1)])
def test_the_rate_thins_out_what_comes_faster(tmp_path, hertz, rate, least, most):
    rng = np.random.default_rng(0)
    stamps = (np.arange(1, 10 * hertz + 1) / hertz * SECOND).astype(int)
    stamps += rng.integers(-SECOND // 200, SECOND // 200, len(stamps))  # jitter
    bag = record(tmp_path / 'bag', [scene(0)] * len(stamps), stamps.tolist())
    (episode,) = open_recordings(bag, reading=Reading(rate=rate))
    assert least <= len(episode.frames) / 10 <= most
    assert np.isin(episode.stamps, stamps).all()


def test_a_clock_that_is_set_back_does_not_stop_the_rate(tmp_path):
    stamps = [SECOND * (t + 100) for t in range(4)] + [SECOND * (t + 1) for t in range(4)]
    with BagWriter(tmp_path / 'bag') as writer:
        for log, stamp in enumerate(stamps):
            writer.write_raw(TOPIC, COMPRESSED, encode(COMPRESSED, {
                'header': header(stamp), 'format': 'jpeg',
                'data': np.frombuffer(packed(scene(0)), np.uint8)}), log * SECOND)
    episodes = list(open_recordings(tmp_path / 'bag', reading=Reading(rate=1)))
    assert [len(e.frames) for e in episodes] == [4, 4]  # two, as the clock jumped


def test_a_clock_that_is_set_back_a_little_begins_an_episode(tmp_path):
    stamps = [SECOND * (t + 10) for t in range(6)] + [SECOND * (t + 13) for t in range(6)]
    with BagWriter(tmp_path / 'bag') as writer:
        for log, stamp in enumerate(stamps):
            writer.write_raw(TOPIC, COMPRESSED, encode(COMPRESSED, {
                'header': header(stamp), 'format': 'jpeg',
                'data': np.frombuffer(packed(scene(log), 'PNG'), np.uint8)}), log * SECOND)
    first, second = open_recordings(tmp_path / 'bag')
    np.testing.assert_array_equal(first.frames, [scene(t) for t in range(6)])
    np.testing.assert_array_equal(second.frames, [scene(t) for t in range(6, 12)])


def test_depth_beside_compressed_colour_makes_the_topic_be_named(tmp_path):
    with BagWriter(tmp_path / 'bag') as writer:
        writer.write_raw('/depth/image_rect', IMAGE, encode(IMAGE, {'header': header(1)}), 1)
        writer.write_raw('/color/image_raw/compressed', COMPRESSED, encode(
            COMPRESSED, {'header': header(2)}), 2)
    with pytest.raises(RecordingError, match='--image-topic.*/color/image_raw/compressed'):
        open_recordings(tmp_path / 'bag')


def test_one_part_of_two_cameras_is_refused_before_training(tmp_path):
    for name, size in (('a', (96, 128)), ('b', (120, 160))):
        record(tmp_path / name, [scene(t, size) for t in range(4)], at((1, 4)))
    with pytest.raises(ConfigError, match='different sizes, 128x96, 160x120; --crop 0,0,96 is'):
        check_first_picture([tmp_path], Reading(crop='0,0,96', size=64), 'x')
    check_first_picture([tmp_path], Reading(crop='centre', size=64), 'x')


def test_other_recordings_are_read_as_those_of_the_training(tmp_path):
    training = {'settings': {'image_topic': '/wrist', 'crop': 'centre', 'size': 32, 'rate': 2.0,
                             'gap': 3, 'episode_seconds': 0.0}}
    record(tmp_path / 'a', [scene(0)], [SECOND])
    with BagWriter(tmp_path / 'b') as writer:
        for topic in ('/wrist', '/front'):
            writer.write_raw(topic, IMAGE, encode(IMAGE, {'header': header(1)}), 1)
    expected = Reading('', 'centre', 32, 2.0, 3, 0.0)
    assert reading_like(training, [tmp_path / 'a']) == expected  # it has no such topic
    assert reading_like(training, [tmp_path / 'b']) == replace(expected, image_topic='/wrist')
    assert reading_like(training, [tmp_path / 'b'], '/front') == replace(
        expected, image_topic='/front')
    assert reading_like({}, [tmp_path / 'b']) == Reading()


def at(*pieces):
    """Return stamps, a second apart, of pieces (first, last)."""
    return [SECOND * t for first, last in pieces for t in range(first, last + 1)]


@pytest.mark.parametrize('stamps, reading, lengths', [
    (at((1, 9), (70, 75)), Reading(), [9, 6]),  # a pause of a minute
    (at((1, 9), (70, 75)), Reading(gap=0), [9, 6]),  # by length: quarters, two of them empty
    (at((1, 9), (70, 75)), Reading(gap=0, episode_seconds=0), [15]),
    (at((1, 9), (13, 15)), Reading(), [12]), (at((1, 9), (13, 15)), Reading(gap=2), [9, 3]),
    (at((1, 60)), Reading(), [20, 20, 20]), (at((1, 60)), Reading(episode_seconds=0), [60]),
    (at((1, 20)), Reading(), [20]),
    (at((1, 40), (60, 64)), Reading(), [40, 5])])  # where pauses tell, length does not
def test_unmarked_recordings_are_cut_by_pauses_or_by_length(tmp_path, stamps, reading, lengths):
    bag = record(tmp_path / 'bag', [scene(t) for t in range(len(stamps))], stamps)
    for opened in (open_recordings(bag, reading=reading), iter_episodes(bag, reading)):
        episodes = list(opened)
        assert [len(e.frames) for e in episodes] == lengths
        assert np.concatenate([e.stamps for e in episodes]).tolist() == stamps


def test_of_several_bags_each_is_an_episode(tmp_path):
    for name in 'ab':
        record(tmp_path / name, [scene(t) for t in range(50)], at((1, 50)))
    for episodes in (list(open_recordings(tmp_path)), list(iter_episodes(tmp_path))):
        assert [len(e.frames) for e in episodes] == [50, 50]
    assert len(open_recordings(tmp_path / 'a')) == 3


def test_marked_recordings_are_not_cut(tmp_path):
    episode = make_episode()
    stamps = (np.arange(len(episode.stamps)) * 60 + 1) * SECOND
    with EpisodeWriter(tmp_path / 'a.mcap') as writer:
        writer.write(type(episode)(**vars(episode) | {'stamps': stamps}))
    (found,) = open_recordings(tmp_path)
    assert found.stamps.tolist() == stamps.tolist()


def test_inspect_lists_topics_and_says_what_train_makes_of_them(tmp_path, capsys):
    bag = record(tmp_path / 'bag', [scene(t) for t in range(45)], at((1, 45)))
    assert main(['inspect', str(bag)]) == 1
    said = capsys.readouterr()
    assert f'topics      {TOPIC}  {COMPRESSED}  45 messages' in said.out
    assert 'pictures are 64x48 pixels; the predictor needs square ones' in said.err
    assert '--crop centre --size 64' in said.err
    assert main(['inspect', str(bag), '--crop', 'centre', '--size', '32']) == 0
    out = capsys.readouterr().out
    assert 'bag: 3 episodes, 45 frames of 32x32 pixels' in out.replace(str(tmp_path) + '/', '')
    assert 'cut         from pictures of 64x48 pixels' in out
    assert 'train       2 episodes to learn from, 1 held out' in out


def test_a_recording_without_pictures_still_lists_its_topics(tmp_path, capsys):
    with BagWriter(tmp_path / 'bag') as writer:
        writer.write_raw('/speed', 'std_msgs/msg/Float64',
                         encode('std_msgs/msg/Float64', {'data': 1.0}), 1)
    assert main(['inspect', str(tmp_path / 'bag')]) == 1
    said = capsys.readouterr()
    assert '/speed  std_msgs/msg/Float64  1 messages' in said.out
    assert 'no topic ends in /camera/image_raw' in said.err
