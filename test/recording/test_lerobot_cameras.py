# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The cameras of one demonstration belong together: one bag holds them, and reads as one."""

import hashlib
import warnings

from made_episodes import make_episode
from made_lerobot import png, VIDEO, write_set
import numpy as np
import pytest
from tap_ros.__main__ import main
from tap_ros.base.errors import ConfigError
from tap_ros.recording.bags import list_topics
from tap_ros.recording.cache import open_recordings
from tap_ros.recording.formats import lerobot_camera
from tap_ros.recording.formats.other_cameras import view_names
from tap_ros.recording.reading import Reading
from tap_ros.recording.writer import EpisodeWriter

HEAD, WRIST = 'observation.images.head', 'observation.images.wrist'
TOPIC = '/camera/wrist/image_raw'
T = 6


def pictures(seed, size=(48, 64)):
    """Return smooth pictures, each of a brightness of its own."""
    levels = np.random.default_rng(seed).permutation(T) * 35 + 20
    return np.broadcast_to(levels[:, None, None, None], (T, *size, 3)).astype(np.uint8)


@pytest.fixture
def episodes():
    return [{HEAD: pictures(e), WRIST: pictures(e + 10, (32, 40))} for e in range(3)]


@pytest.fixture
def run(tmp_path, capsys):
    """Return what imports some cameras: code, bag, and what was said."""
    def run(folder, *cameras, options=(), name='bag'):
        with warnings.catch_warnings(record=True) as told:
            warnings.simplefilter('always')
            code = main(['import-lerobot', str(folder), '--out', str(tmp_path / name), *options,
                         *(word for one in cameras for word in ('--camera', one))])
        return code, tmp_path / name, ''.join((
            *capsys.readouterr(), *(str(one.message) for one in told)))
    return run


def frames(bag, topic=''):
    with warnings.catch_warnings():
        warnings.simplefilter('error')  # none asks which camera is meant
        return [one.frames for one in open_recordings(bag, reading=Reading(topic))]


def digest(bag):
    return [hashlib.sha256(file.read_bytes()).hexdigest() for file in sorted(bag.iterdir())]


@pytest.mark.parametrize('filmed', [False, True])
def test_a_bag_holds_all_cameras_and_its_picture_is_that_of_the_first(
        filmed, episodes, tmp_path, run):
    folder = write_set(tmp_path / 'set', episodes, filmed=filmed)
    assert run(folder)[0] == 1  # which one?
    code, bag, said = run(folder, HEAD, WRIST)
    assert code == 0 and f'{TOPIC}: {3 * T} pictures of {WRIST}' in said
    assert 'not taken' not in said
    end = '/compressed' * filmed
    assert {topic for topic, _, _ in list_topics(bag)} >= {f'/camera/image_raw{end}',
                                                           f'{TOPIC}{end}'}
    for topic, key in (('', HEAD), (TOPIC, WRIST)):
        for seen, truth in zip(frames(bag, topic), episodes, strict=True):
            assert seen.shape == truth[key].shape
            assert np.abs(seen.astype(int) - truth[key]).max() <= 8 * filmed
    head, wrist = (open_recordings(bag, reading=Reading(topic)) for topic in ('', TOPIC))
    for one, other in zip(head, wrist, strict=True):
        np.testing.assert_array_equal(one.stamps, other.stamps)
    _, other, _ = run(folder, WRIST, HEAD, name='other')
    np.testing.assert_array_equal(frames(other)[0], frames(bag, TOPIC)[0])
    _, alone, _ = run(folder, HEAD, name='alone')
    np.testing.assert_array_equal(frames(alone)[0], frames(bag)[0])


def test_cut_and_rate_are_those_of_all_cameras(episodes, tmp_path, run):
    folder = write_set(tmp_path / 'set', episodes)
    _, bag, _ = run(folder, HEAD, WRIST, options=('--crop', 'centre', '--size', '16',
                                                  '--rate', '5'))
    for topic in ('', TOPIC):
        assert [one.shape for one in frames(bag, topic)] == 3 * [(T // 2, 16, 16, 3)]


def test_what_another_camera_lacks_costs_nothing_else(episodes, tmp_path, run):
    good = frames(run(write_set(tmp_path / 'set', episodes), HEAD, WRIST)[1])
    files = [png(one) for one in episodes[1][WRIST]]
    spoiled = [episodes[0], {HEAD: episodes[1][HEAD], WRIST: [
        *files[:2], b'no picture', *files[3:]]}, episodes[2]]
    code, bag, said = run(write_set(tmp_path / 'other', spoiled), HEAD, WRIST, name='spoiled')
    assert code == 0 and f'picture 2 of episode 1 of {WRIST}: no picture, or a damaged one' in said
    assert f'{3 * T - 1} pictures of {WRIST}' in said
    np.testing.assert_array_equal(frames(bag), good)
    assert list(map(len, frames(bag, TOPIC))) == [T, T - 1, T]
    np.testing.assert_array_equal(frames(bag, TOPIC)[1], np.delete(episodes[1][WRIST], 2, 0))
    filmed = write_set(tmp_path / 'filmed', episodes, filmed=True)
    (filmed / VIDEO.format(WRIST, 1)).unlink()
    (filmed / VIDEO.format(WRIST, 2)).write_bytes(b'no video')
    code, bag, said = run(filmed, HEAD, WRIST, name='lacking')
    assert code == 0 and f'view episode 1 of {WRIST}: ' in said and 'is not there' in said
    assert f'view episode 2 of {WRIST}: ' in said and 'is no video' in said
    assert list(map(len, frames(bag))) == 3 * [T] and len(frames(bag, TOPIC)) == 1


def test_the_pictures_of_another_camera_have_an_end(episodes, tmp_path, run, monkeypatch):
    monkeypatch.setattr(lerobot_camera, 'MOST_BYTES', 3 * 32 * 40 * 3)
    code, bag, said = run(write_set(tmp_path / 'set', episodes), HEAD, WRIST)
    assert code == 0 and f'{TOPIC}: 9 pictures' in said
    assert '3 views: it has more than 0 GiB; keep less of each picture' in said
    assert list(map(len, frames(bag))) == 3 * [T]
    assert list(map(len, frames(bag, TOPIC))) == 3 * [3]


def test_a_picture_that_the_first_camera_lacks_is_left_out_of_all(episodes, tmp_path, run):
    files = [png(one) for one in episodes[0][HEAD]]
    episodes[0][HEAD] = [*files[:2], b'no picture', *files[3:]]
    _, bag, _ = run(write_set(tmp_path / 'set', episodes), HEAD, WRIST)
    np.testing.assert_array_equal(frames(bag, TOPIC)[0], np.delete(episodes[0][WRIST], 2, 0))


def test_a_camera_that_is_not_there_or_named_twice(episodes, tmp_path, run):
    folder = write_set(tmp_path / 'set', episodes)
    code, bag, said = run(folder, HEAD, 'observation.images.foot')
    assert code == 1 and f'expected one of {HEAD}, {WRIST}' in said and not bag.exists()
    code, bag, said = run(folder, HEAD, WRIST, HEAD)
    assert code == 1 and f'--camera: {HEAD} is given twice' in said and not bag.exists()


def test_pictures_of_16_bits_are_depth_and_nobody_asks_for_them(tmp_path, run):
    deep = np.full((T, 8, 8), 700, np.uint16)
    folder = write_set(tmp_path / 'set', [{HEAD: pictures(0), 'observation.images.depth': [
        png(one) for one in deep]}])
    code, bag, said = run(folder)
    assert code == 0 and f'of {HEAD}\n' in said


def test_names_of_topics_are_safe_and_none_is_that_of_the_first(tmp_path):
    assert view_names([
        'observation.images.wrist', 'wrist', 'a.wrist_2', 'wrist', 'observation.images.camera',
        'x.0', 'x.', '手', 'x./../é b\n', 'x.' + 'y' * 5000, 'camera']) == [
            'wrist', 'wrist_2', 'wrist_2_2', 'wrist_3', 'camera_2', 'view_0', 'view', 'view_2',
            'b', 40 * 'y', 'camera_3']
    with EpisodeWriter(tmp_path / 'a.mcap') as writer:
        for name in ('camera', 'a/b', '', '0', 'é', 'a\n'):
            with pytest.raises(ConfigError, match='is no name of another camera'):
                writer.write(make_episode(), {name: []})
        writer.write(make_episode(goal_frame=None), {
            'side': [None, np.zeros((4, 4, 3), np.uint8)]})
    assert [len(one) for one in frames(tmp_path / 'a.mcap')] == [5]
    assert [len(one) for one in frames(tmp_path / 'a.mcap', '/camera/side/image_raw')] == [1]
