# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""A robot mask belongs to the picture of its stamp; what is wrong with one costs masks alone."""

import dataclasses
import re
import warnings

from made_episodes import assert_all_equal, cover, make_episode, write_bag
import numpy as np
import pytest
from tap_ros.contract import ROBOT_MASK_ARM
from tap_ros.errors import ConfigError, RecordingError
from tap_ros.evaluation import inspect_files
from tap_ros.messages import topics
from tap_ros.recording import cache as cache_module
from tap_ros.recording.cache import open_recordings
from tap_ros.recording.file_writer import FileWriter
from tap_ros.recording.messages import encode
from tap_ros.recording.reader import iter_episodes
from tap_ros.recording.writer import EpisodeWriter, write_metadata

PERIOD = 250_000_000  # ns


@pytest.fixture
def covered(episodes):
    return [cover(episode) for episode in episodes]


def read(path):
    """Read a recording without the cache and with it, which gives the same; return warnings."""
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter('always')
        found = list(iter_episodes(path))
    with warnings.catch_warnings():
        warnings.simplefilter('ignore')
        for _ in range(2):  # the second time from the cache
            assert_all_equal(open_recordings(path), found)
    return found, [str(one.message) for one in told]


def record(path, pictures, masks, goals=()):
    """Write a bag without marks: lists of (log time, stamp, array), in the order of their log."""
    path.mkdir()
    messages = [(log, topic, stamp, values) for topic, group in (
        (topics.IMAGE, pictures), (topics.ROBOT_MASK, masks), *goals)
        for log, stamp, values in group]
    writer = FileWriter(path / f'{path.name}_0.mcap')
    for log, topic, stamp, values in sorted(messages, key=lambda one: one[0]):
        height, width, *channels = values.shape
        writer.write_raw(topic.recorded, topic.type, encode(topic.type, {
            'header': {'stamp': {'sec': stamp // 10**9, 'nanosec': stamp % 10**9}},
            'height': height, 'width': width, 'step': values[0].size if height else 0,
            'encoding': 'rgb8' if channels else 'mono8', 'data': values}), log)
    writer.close()
    write_metadata(path)
    return path


def stream(values, late=0, start=10**9):
    """Give arrays the stamps of an episode, and log times so many nanoseconds later."""
    stamps = [start + t * PERIOD for t in range(len(values))]
    return [(stamp + late, stamp, value) for stamp, value in zip(stamps, values, strict=True)]


@pytest.mark.parametrize('compression', ['zstd', 'none'])
def test_masks_come_back_as_they_were_written(tmp_path, covered, compression):
    with EpisodeWriter(tmp_path / 'a.mcap', compression) as writer:
        for episode in covered:
            writer.write(episode)
    found, told = read(tmp_path / 'a.mcap')
    assert_all_equal(found, covered)
    assert not told


def test_masks_of_some_episodes_are_those_of_no_other(tmp_path, episodes, covered):
    mixed = [episodes[0], covered[1], episodes[2], covered[3],
             dataclasses.replace(covered[4], goal_mask=None), covered[5],
             dataclasses.replace(covered[6], robot_masks=None)]
    mixed = [dataclasses.replace(e, stamps=e.stamps - e.stamps[0]) for e in mixed]  # all from 0
    found, told = read(write_bag(tmp_path / 'bag', mixed[:3], mixed[3:]))
    assert_all_equal(found, mixed)
    assert len(told) == 2 and all('the masks of these episodes are not used' in t for t in told)


def test_masks_are_views_of_memory_maps(tmp_path, covered):
    masks = open_recordings(write_bag(tmp_path / 'bag', covered))[3].robot_masks
    while masks.base is not None and not isinstance(masks, np.memmap):
        masks = masks.base
    assert isinstance(masks, np.memmap) and not masks.flags.writeable


@pytest.mark.parametrize('damage', ['remove', 'cut'])
def test_caches_that_lost_their_masks_are_built_again(tmp_path, covered, cache, damage):
    bag = write_bag(tmp_path / 'bag', covered)
    open_recordings(bag)
    for folder in cache.iterdir():
        path = folder / 'masks'
        if damage == 'remove':
            path.unlink()
        else:
            path.write_bytes(path.read_bytes()[:200])
    assert_all_equal(open_recordings(bag), covered)


def test_the_second_opening_decodes_nothing(tmp_path, covered, monkeypatch):
    bag = write_bag(tmp_path / 'bag', covered)
    open_recordings(bag)
    monkeypatch.setattr(cache_module, 'decode_file', None)
    assert_all_equal(open_recordings(bag), covered)


@pytest.mark.parametrize('late', [-5_000_000, 1_000_000, 3 * PERIOD])
def test_masks_belong_to_the_picture_of_their_stamp_whenever_they_came(tmp_path, late):
    episode = cover(make_episode())
    found, told = read(record(
        tmp_path / 'bag', stream(episode.frames), stream(episode.robot_masks, late)))
    np.testing.assert_array_equal(found[0].robot_masks, episode.robot_masks)
    assert not told


def test_the_mask_of_another_stamp_is_not_used(tmp_path):
    episode = cover(make_episode())
    masks = stream(episode.robot_masks)
    log, stamp, values = masks[2]
    masks[2] = log, stamp + 1_000_000, values
    found, told = read(record(tmp_path / 'bag', stream(episode.frames), masks))
    assert found[0].robot_masks is None and len(found[0]) == 5
    words, = told
    assert '1 of 1 episodes' in words and '1 frames, the first at 1.500000000 s' in words


def test_masks_without_stamps_are_not_used(tmp_path):
    episode = cover(make_episode())
    masks = [(log, 0, values) for log, _, values in stream(episode.robot_masks)]
    found, told = read(record(tmp_path / 'bag', stream(episode.frames), masks))
    assert found[0].robot_masks is None and len(told) == 1


def test_repeated_masks_and_pictures_count_once(tmp_path):
    episode = cover(make_episode())
    again = [stream(values) + stream(values, 1000)
             for values in (episode.frames, episode.robot_masks)]
    found, told = read(record(tmp_path / 'bag', *again))
    np.testing.assert_array_equal(found[0].robot_masks, episode.robot_masks)
    assert not told


@pytest.mark.parametrize('wrong, words', [
    (np.full((8, 12), 1, np.uint8), 'value 1; expected 0 .free., 128 .hand. or 255 .arm.'),
    (np.zeros((4, 6), np.uint8), '6x4 pixels among pictures of 12x8'),
    (np.zeros((8, 12, 3), np.uint8), "encoding 'rgb8' cannot be used; valid encodings: mono8"),
    (np.zeros((0, 0), np.uint8), 'is empty')],
    ids=['value', 'size', 'encoding', 'empty'])
@pytest.mark.parametrize('at', [0, 3])
def test_a_bad_mask_is_named_and_costs_the_masks_of_its_episode(tmp_path, wrong, words, at):
    episode = cover(make_episode())
    masks = stream(episode.robot_masks, -1000)  # before its picture, which tells the size
    masks[at] = *masks[at][:2], wrong
    found, told = read(record(tmp_path / 'bag', stream(episode.frames), masks))
    np.testing.assert_array_equal(found[0].frames, episode.frames)
    assert found[0].robot_masks is None
    bad, lacking = told
    assert '/camera/robot_mask: 1 message cannot be used' in bad
    assert re.search(words, bad) and '1 of 1 episodes' in lacking


def test_masks_without_a_picture_in_their_file_harm_nothing(tmp_path):
    episode = cover(make_episode())
    bag = record(tmp_path / 'bag', stream(episode.frames), stream(episode.robot_masks))
    path = bag / 'bag_1.mcap'
    record(tmp_path / 'more', [], stream(episode.robot_masks, start=10**10))
    (tmp_path / 'more' / 'more_0.mcap').rename(path)
    write_metadata(bag)
    found, _ = read(bag)
    np.testing.assert_array_equal(found[0].robot_masks, episode.robot_masks)


def test_the_mask_of_a_goal_has_the_stamp_of_its_picture(tmp_path):
    episode = cover(make_episode())
    for number, stamp in enumerate((5 * 10**8, 5 * 10**8 + 1)):
        found, _ = read(record(
            tmp_path / f'bag{number}', stream(episode.frames), stream(episode.robot_masks), (
                (topics.GOAL_IMAGE, [(5 * 10**8, 5 * 10**8, episode.goal_frame)]),
                (topics.GOAL_ROBOT_MASK, [(6 * 10**8, stamp, episode.goal_mask)]))))
        np.testing.assert_array_equal(found[0].goal_frame, episode.goal_frame)
        if number:
            assert found[0].goal_mask is None
        else:
            np.testing.assert_array_equal(found[0].goal_mask, episode.goal_mask)


@pytest.mark.parametrize('changes, words', [
    ({'robot_masks': np.zeros((4, 8, 12), np.uint8)}, 'robot_masks: expected shape'),
    ({'robot_masks': np.ones((5, 8, 12), np.uint8)}, 'robot_masks: .* value 1'),
    ({'goal_mask': np.zeros((8, 8), np.uint8)}, 'goal_mask: expected shape'),
    ({'goal_frame': None}, 'goal_mask: expected None')],
    ids=lambda changes: ','.join(changes) if isinstance(changes, dict) else '')
def test_episodes_with_other_masks_are_not_written(tmp_path, changes, words):
    episode = cover(make_episode(), **changes)
    with pytest.raises(RecordingError, match=words), EpisodeWriter(tmp_path / 'a.mcap') as writer:
        writer.write(episode)


def test_inspect_tints_what_masks_mark(episodes, tmp_path, capsys):
    covered = cover(episodes[0])
    path = tmp_path / 'bag'
    with EpisodeWriter(path) as writer:
        writer.write(covered)
    with pytest.raises(ConfigError, match='12x8 pixels'):  # too small to train on
        inspect_files.run(inspect_files.Options(
            str(path), str(tmp_path / 'strips.png'), robot_mask=True))
    tinted = inspect_files._tinted(covered)
    marked = covered.robot_masks > 0
    assert marked.any() and np.array_equal(tinted[~marked], covered.frames[~marked])
    assert (tinted[covered.robot_masks == ROBOT_MASK_ARM, 0] >= 127).all()
    plain = tmp_path / 'plain.png'
    with pytest.raises(ConfigError, match='12x8 pixels'):
        inspect_files.run(inspect_files.Options(str(path), str(plain)))
    assert plain.read_bytes() != (tmp_path / 'strips.png').read_bytes()
