# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Recordings of any camera: compressed, large, fast, unmarked."""

from dataclasses import replace
import io
import re

import cv2
from made_bags import camera, IMAGE, message, read, record, SECOND, shown, write_mcap
from made_episodes import make_episode
import numpy as np
from PIL import Image as Picture
import pytest
from tap_ros.base.errors import RecordingError
from tap_ros.images.crop import Crop, TrainedCrop
from tap_ros.recording.bags import list_topics, reading_like
from tap_ros.recording.cache import open_recordings
from tap_ros.recording.messages import encode
from tap_ros.recording.reading import Reading
from tap_ros.recording.writer import EpisodeWriter
from tap_ros.training.split import split_episodes

COMPRESSED = 'sensor_msgs/msg/CompressedImage'
TOPIC = '/camera/color/image_raw/compressed'


def scene(t, size=(48, 64)):
    """Return a smooth picture with a dot that moves; none of the next 99 is the same."""
    y, x = np.mgrid[:size[0], :size[1]]
    picture = np.stack([x * 255 // size[1], y * 255 // size[0], np.full_like(x, 90 + t % 99)], -1)
    return cv2.circle(picture.astype(np.uint8), (20 + t % 20, 24), 4, (250, 40, 20), -1)


def packed(picture, form='JPEG'):
    buffer = io.BytesIO()
    Picture.fromarray(picture).save(buffer, form, **({'quality': 90} if form == 'JPEG' else {}))
    return buffer.getvalue()


def compressed(t, picture, log=None, form='JPEG'):
    """Return the message of a compressed picture, an array or bytes as they are."""
    data = picture if isinstance(picture, bytes) else packed(picture, form)
    return message(TOPIC, COMPRESSED, t, log, format='rgb8; jpeg compressed bgr8',
                   data=np.frombuffer(data, np.uint8))


def record_scenes(folder, times, *size):
    """Write compressed pictures of so many seconds into a bag without marks."""
    return record(folder, [compressed(t, scene(i, *size)) for i, t in enumerate(times)])


def test_compressed_pictures_are_read_and_a_bad_one_costs_itself(tmp_path):
    pictures = [scene(t) for t in range(3)]
    for form in ('JPEG', 'PNG', 'WEBP'):
        (episode,), _ = read(record(tmp_path / form, [
            compressed(t + 1, picture, form=form) for t, picture in enumerate(pictures)]))
        error = np.abs(episode.frames.astype(int) - np.stack(pictures))
        assert error.max() == 0 if form == 'PNG' else error.mean() < 4
        assert episode.stamps.tolist() == [SECOND, 2 * SECOND, 3 * SECOND]
    bad = (packed(scene(0))[:400], b'no picture', b'')
    messages = [compressed(t, bad[t // 5] if t % 5 == 3 else scene(t)) for t in range(1, 16)]
    (episode,), (text, *more) = read(record(tmp_path / 'bad', messages))
    assert len(episode) == 12 and f'{TOPIC}: 1 message cannot be used: damaged' in text
    assert "no picture, or a damaged one: 'rgb8; jpeg compressed bgr8'" in more[0]
    (episode,), _ = read(tmp_path / 'bad', reading=Reading(rate=0.5))
    assert (episode.stamps // SECOND).tolist() == [1, 4, 5, 7, 9, 11, 14, 15]  # the next good one


def test_pictures_are_cut_and_scaled_while_they_are_decoded(tmp_path):
    pictures = [scene(t, (480, 640)) for t in range(4)]
    bag = record(tmp_path / 'bag', [
        compressed(t + 1, picture, form='PNG') for t, picture in enumerate(pictures)])
    store = open_recordings(bag, tmp_path / 'cache', reading=Reading(crop='centre', size=64))
    assert (store.image_size, store.camera_size) == ((64, 64), (480, 640))
    expected = np.stack([Crop('centre', 64).image(picture) for picture in pictures])
    np.testing.assert_array_equal(store[0].frames, expected)
    (episode,) = open_recordings(bag, reading=Reading(crop='centre', size=64))
    np.testing.assert_array_equal(episode.frames, expected)
    # What is kept is as large as what is used.
    assert sum(f.stat().st_size for f in (tmp_path / 'cache').rglob('frame')) < 5 * 64 * 64 * 3
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


def test_the_rate_thins_out_what_comes_faster(tmp_path):
    rng = np.random.default_rng(0)
    for number, (hertz, rate, least, most) in enumerate((
            (30, 4, 3.6, 4.1), (30, 10, 9.5, 10.1), (4, 4, 4, 4.1), (4, 10, 4, 4.1))):
        stamps = (np.arange(1, 10 * hertz + 1) / hertz * SECOND).astype(int)
        stamps += rng.integers(-SECOND // 200, SECOND // 200, len(stamps))  # jitter
        bag = record(tmp_path / str(number), [camera(t, 0) for t in stamps / SECOND])
        (episode,) = open_recordings(bag, reading=Reading(rate=rate))
        assert least <= len(episode.frames) / 10 <= most
        assert np.isin(episode.stamps, stamps).all()


def deep(t, topic, form='16UC1'):
    return camera(t, np.zeros((48, 64), np.uint8), topic=topic, encoding=form, step=128,
                  data=bytes(48 * 128))


def test_of_several_topics_of_pictures_the_colour_camera_is_taken(tmp_path):
    colour = [compressed(t, scene(t)) for t in range(1, 41)]
    grey = [camera(t, scene(t)[..., 0], topic='/infra/image_rect', encoding='mono8')
            for t in range(1, 41)]
    depth = bytes(12) + packed(np.full((48, 64), 700, np.uint16), 'PNG')
    for number, others in enumerate((
            [deep(t, '/depth/image_rect') for t in range(1, 41)], [deep(1, '/a', '32FC1')], grey,
            [camera(5, scene(5), topic='/debug/overlay')],
            [message('/depth/compressedDepth', COMPRESSED, t, data=np.frombuffer(depth, np.uint8),
                     format='16UC1; compressedDepth png') for t in range(1, 41)])):
        found, told = read(record(tmp_path / str(number), [*colour, *others]))
        assert sum(map(len, found)) == 40 and not told
    bag = record(tmp_path / 'bag', [*colour, *(
        camera(t, scene(t), topic='/side/image_rect') for t in range(1, 31))])
    with pytest.raises(RecordingError, match=r'several .*image_raw/compressed \(40 messages\), '
                       r'/side/image_rect \(30 messages\); name the camera .*--image-topic'):
        open_recordings(bag)


def test_of_raw_and_compressed_pictures_those_with_clearly_more_are_read(tmp_path):
    name = '/camera/image_raw'
    for number, (raw, packed_too, taken) in enumerate((
            (1, 30, True), (5, 30, True), (15, 30, True), (20, 30, False), (30, 30, False))):
        messages = [camera(t, scene(t), topic=name) for t in range(1, raw + 1)] + [
            (f'{name}/compressed', *compressed(t, scene(t))[1:])
            for t in range(1, packed_too + 1)]
        messages += [deep(t, '/depth') for t in range(1, 31)]
        found, told = read(record(tmp_path / str(number), messages))
        assert sum(map(len, found)) == (packed_too if taken else raw) and not told
    found, _ = read(tmp_path / '0', reading=Reading(name))  # who names it gets it
    assert sum(map(len, found)) == 1
    bag = record(tmp_path / 'video', [camera(t, scene(t), topic=name) for t in (1, 2, 3)] + [
        (f'{name}/compressed', *compressed(t, b'no picture')[1:]) for t in range(1, 31)])
    assert sum(map(len, read(bag)[0])) == 3


def test_a_topic_of_several_types_is_read_by_the_type_of_each_message(tmp_path):
    name, string = '/camera/image_raw', 'std_msgs/msg/String'
    raw = [camera(t, scene(t), topic=name) for t in range(1, 16)]
    small = [(name, *compressed(t + 0.5, scene(t))[1:]) for t in range(1, 16)]
    mixed = [one for pair in zip(raw, small) for one in pair]
    words = [(name, string, encode(string, {'data': 'x'}), t * SECOND) for t in range(1, 16)]
    for number, (messages, expected) in enumerate((
            (mixed, 30), (small[:1] + mixed[2:], 29), (words + raw, 15), (raw + words, 15))):
        write_mcap(tmp_path / f'{number}.mcap', messages)
        found, told = read(tmp_path / f'{number}.mcap')
        assert sum(map(len, found)) == expected and not told
    assert list_topics(tmp_path / '3.mcap') == [(name, IMAGE, 15), (name, string, 15)]


def test_other_recordings_are_read_as_those_of_the_training(tmp_path):
    training = {'settings': {'image_topic': '/wrist', 'crop': 'centre', 'size': 32, 'rate': 2.0,
                             'gap': 3, 'episode_seconds': 0.0}}
    record(tmp_path / 'a', [camera(1)])
    record(tmp_path / 'b', [message(topic, IMAGE, 1) for topic in ('/wrist', '/front')])
    expected = Reading('', 'centre', 32, 2.0, 3, 0.0)
    assert reading_like(training, [tmp_path / 'a']) == expected  # it has no such topic
    assert reading_like(training, [tmp_path / 'b']) == replace(expected, image_topic='/wrist')
    assert reading_like(training, [tmp_path / 'b'], '/front') == replace(
        expected, image_topic='/front')
    assert reading_like({}, [tmp_path / 'b']) == Reading()
    # As nodes do: pictures that are cut already stay, larger ones of the same camera are scaled.
    for side, crop, cut in ((16, Crop('8,0,96', 16), Crop()), (64, Crop(), Crop(size=16))):
        bag = record(tmp_path / str(side), [camera(1, np.zeros((side, side, 3), np.uint8))])
        found = reading_like({}, [bag], trained=TrainedCrop(crop, (96, 128), (16, 16)))
        assert found.cut == cut


def test_unmarked_recordings_are_cut_by_pauses_or_by_length(tmp_path):
    for number, (pieces, reading, lengths) in enumerate((
            (((1, 9), (70, 75)), Reading(), [9, 6]),  # a pause of a minute
            (((1, 9), (70, 75)), Reading(gap=0), [9, 6]),  # in quarters, two of them empty
            (((1, 9), (70, 75)), Reading(gap=0, episode_seconds=0), [15]),
            (((1, 9), (13, 15)), Reading(), [12]), (((1, 9), (13, 15)), Reading(gap=2), [9, 3]),
            (((1, 60),), Reading(), [20, 20, 20]),
            (((1, 60),), Reading(episode_seconds=0), [60]), (((1, 20),), Reading(), [20]),
            (((1, 40), (60, 64)), Reading(), [40, 5]))):  # where pauses tell, length does not
        times = [t for first, last in pieces for t in range(first, last + 1)]
        found, _ = read(record(tmp_path / str(number), map(camera, times)), reading=reading)
        assert [len(e) for e in found] == lengths
        assert np.concatenate([e.stamps for e in found]).tolist() == [t * SECOND for t in times]


def test_a_gap_is_proposed_where_other_pauses_are_between_demonstrations(tmp_path):
    def times(pause, count=4, period=0.1):
        return [start + t * period for start in np.arange(count) * (20 * period + pause)
                for t in range(20)]
    for number, (stamps, words) in enumerate((
            (times(3), '3 pauses of 3.1 to 3.1 s: --gap 0.56'), (times(9), ''), (times(0), ''),
            (times(1.5), '3 pauses of 1.6 to 1.6 s: --gap 0.4'), (times(2, 4, 1), ''),
            ([*times(3), *(t + 99 for t in times(3))], 'cut at 1 pauses .* 7 pauses of 3.1 to'))):
        found, told = read(record(tmp_path / str(number), [
            camera(1 + t, i) for i, t in enumerate(stamps)]))
        assert len(told) == bool(words) and re.search(words, ''.join(told))
        if 'gap 0' in words:
            gap = float(told[0].split('--gap ')[1].split()[0])
            assert [len(e) for e in read(
                tmp_path / str(number), reading=Reading(gap=gap))[0]] == [20] * 4


def test_several_cameras_of_a_demonstration_are_on_one_side_of_the_split(tmp_path):
    bag = record(tmp_path / 'bag', [  # the clock of b counts since its start
        camera(t + d * 30 + (10_000 if side == 'a' else 0), d, 10_000 + t + d * 30, f'/{side}/rgb')
        for d in range(1, 9) for t in range(4) for side in 'ab'])
    store = open_recordings(bag, reading=Reading(('/a/rgb', '/b/rgb')))
    assert len(store) == 16
    for fraction in (0.1, 0.3, 0.6):
        parts = split_episodes(store, fraction)
        numbers = [{int(store[i].frames[0, 0, 0, 0]) for i in part} for part in parts]
        assert not numbers[0] & numbers[1] and all(len(part) % 2 == 0 for part in parts)
        assert sum(map(len, numbers)) == 8


def test_sizes_that_come_out_alike_after_the_cut_may_change(tmp_path):
    sizes = [(48, 64)] * 3 + [(96, 128)] * 2 + [(60, 60)]
    bag = record(tmp_path / 'bag', [
        compressed(t + 1, scene(t, size)) for t, size in enumerate(sizes)])
    (episode,), told = read(bag, reading=Reading(crop='centre', size=16))
    assert episode.frames.shape == (6, 16, 16, 3) and not told
    with pytest.raises(RecordingError, match='3 of 64x48, 2 of 128x96, 1 of 60x60.*--crop'):
        open_recordings(bag)


def test_of_several_bags_each_is_an_episode(tmp_path):
    for name in 'ab':
        record(tmp_path / 'bags' / name, map(camera, range(1, 51)))
    assert [len(e) for e in read(tmp_path / 'bags')[0]] == [50, 50]
    assert len(open_recordings(tmp_path / 'bags' / 'a')) == 3


@pytest.mark.parametrize('restamped', [False, True])
def test_each_round_of_a_recorded_loop_is_an_episode(tmp_path, restamped):
    messages = [camera(logged if restamped else 1 + i / 10, value=5 * i, log=logged)
                for n in range(3) for i in range(20) if (n, i) not in ((1, 0), (1, 7), (2, 12))
                for logged in [9 + 2.5 * n + i / 10]]
    found, told = read(record(tmp_path / 'bag', messages))
    assert [one[0] for one in shown(found)] == [0, 5, 0] and sum(map(len, found)) == 57
    assert all(sorted(one) == one for one in shown(found))
    assert any('its pictures begin anew, 2 times' in text for text in told)
    # A scene that looks now and then as before, to the bit, is none.
    values = [*range(30), *range(30, 10, -1), 3, 3, *range(50, 70), 3, 0]
    found, told = read(record(tmp_path / 'other', [
        camera(1 + i / 10, value=value) for i, value in enumerate(values)]))
    assert shown(found) == [values] and not told


def views(n, cameras, every=1):
    """Return (seconds, number of the camera, picture) of cameras that look at one scene."""
    rng = np.random.default_rng(3)
    walls = [rng.integers(60, 200, (6, 8, 3), np.uint8).repeat(8, 0).repeat(8, 1)
             for _ in range(cameras)]
    return [(1 + t / 10 + 0.007 * k, k, cv2.circle(
        walls[k].copy(), (5 + t, 24), 4, (250, 40, 20), -1)) for t in range(n)
        for k in range(cameras) if not k or (t > 5 and t % every == 0)]


@pytest.mark.parametrize(('cameras', 'every', 'form'), [
    (2, 1, ''), (3, 1, ''), (2, 3, ''), (2, 1, 'JPEG')])
def test_several_cameras_on_one_topic_are_told_of(tmp_path, cameras, every, form):
    shot = views(40, cameras, every)
    for named in (True, False):
        stamp = [{'header': {'stamp': {'sec': int(t), 'nanosec': round(t % 1 * SECOND)},
                             'frame_id': f'eye_{k}' if named else 'eye'}} for t, k, _ in shot]
        bag = record(tmp_path / str(named), [
            camera(t, picture, **header) if not form else (TOPIC, COMPRESSED, encode(
                COMPRESSED, {**header, 'format': 'jpeg', 'data': packed(picture)}), round(
                    t * SECOND)) for (t, _, picture), header in zip(shot, stamp)])
        if named:
            with pytest.raises(RecordingError, match='frame_id eye_0 .64x48., frame_id eye_1'):
                read(bag)
        else:
            assert any('two views alternate, as where several' in text for text in read(bag)[1])


@pytest.mark.parametrize('spoil', [
    lambda i, picture: picture, lambda i, picture: (picture * (0.4 + 0.6 * (i % 2))),
    lambda i, picture: picture * np.linspace(1, 0.2 + 0.8 * (i % 2), 64)[:, None],
    lambda i, picture: picture * (i % 4 > 0), lambda i, picture: np.roll(picture, 5 * i, 1),
    lambda i, picture: picture + np.random.default_rng(i).normal(0, 20, picture.shape)])
def test_light_that_flickers_noise_and_black_pictures_are_no_second_camera(tmp_path, spoil):
    _, told = read(record(tmp_path / 'bag', [
        camera(t, np.clip(spoil(i, picture), 0, 255).astype(np.uint8))
        for i, (t, _, picture) in enumerate(views(60, 1))]))
    assert not told
