# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The cache holds what the recording holds, whoever builds it and whatever happened to it."""

from collections import Counter
import hashlib
import os
import shutil
import subprocess
import sys

from made_episodes import assert_all_equal, make_episode
import numpy as np
import pytest
from tap_ros.base.errors import RecordingError
from tap_ros.recording import cache as cache_module
from tap_ros.recording import known
from tap_ros.recording.bags import known_bags
from tap_ros.recording.cache import open_recordings
from tap_ros.recording.mcap_file import McapFile
from tap_ros.recording.reading import Reading
from tap_ros.recording.writer import EpisodeWriter


def test_frames_and_masks_are_views_of_memory_maps(bag):
    episode = open_recordings(bag)[3]
    for pictures in (episode.frames, episode.robot_masks):
        while pictures.base is not None and not isinstance(pictures, np.memmap):
            pictures = pictures.base
        assert isinstance(pictures, np.memmap) and not pictures.flags.writeable


def test_the_key_is_the_content_of_the_file(bag, episodes, cache, monkeypatch):
    first = open_recordings(bag)
    before = sorted(os.listdir(cache))
    moved = bag.with_name('moved')
    shutil.move(bag, moved)
    monkeypatch.setattr(cache_module, 'decode_file', None)
    again = open_recordings(moved)
    assert_all_equal(again, episodes)
    assert again.lengths.tolist() == [len(e) for e in episodes] and again.image_size == (8, 12)
    assert again.data_hash == first.data_hash
    assert sorted(os.listdir(cache)) == before


def test_a_file_is_opened_and_hashed_once_and_again_when_it_has_changed(
        bag, episodes, monkeypatch):
    monkeypatch.setattr(known, '_SETTLED_NS', 0)  # files made just now count as old ones
    done = Counter()

    def counted(name, function):
        def call(*args):
            done[name] += 1
            return function(*args)
        return call
    monkeypatch.setattr(McapFile, '__init__', counted('opened', McapFile.__init__))
    monkeypatch.setattr(hashlib, 'file_digest', counted('hashed', hashlib.file_digest))
    for _ in range(2):
        assert_all_equal(open_recordings(bag), episodes)
        assert done == {'opened': 2, 'hashed': 2}
    open_recordings(bag, reading=Reading(crop='centre', size=16), network='the predictor')
    assert done == {'opened': 4, 'hashed': 2}
    path = bag / 'push2_1.mcap'
    before, data = path.stat(), path.read_bytes()
    with EpisodeWriter(path) as writer:
        writer.write(make_episode(seed=99))
    assert open_recordings(bag).num_frames != sum(map(len, episodes))
    assert done == {'opened': 6, 'hashed': 3}
    path.write_bytes(data)
    os.utime(path, ns=(before.st_atime_ns, before.st_mtime_ns))
    assert_all_equal(open_recordings(bag), episodes)
    assert done == {'opened': 6, 'hashed': 4}  # what it holds is known


def test_a_bag_is_known_until_a_file_of_it_changes(bag):
    first, = known_bags(bag)
    assert known_bags([bag]) == [first] and first.opened == first.opened
    with EpisodeWriter(bag / 'push2_1.mcap') as writer:
        writer.write(make_episode(seed=99))
    again, = known_bags(bag)
    assert again is not first


def test_damaged_caches_are_built_again(bag, episodes, cache):
    for name, size in (('frame', None), ('frame', 200), ('mask', None), ('mask', 200),
                       ('columns.safetensors', None), ('columns.safetensors', 0),
                       ('columns.safetensors', 100), ('columns.safetensors', -1)):
        open_recordings(bag)
        for folder in cache.glob('*-*'):
            path = folder / name
            if size is None:
                path.unlink()
            else:
                os.truncate(path, size % path.stat().st_size)
        assert_all_equal(open_recordings(bag), episodes)
    assert len(list(cache.glob('*-*'))) == 2  # a folder a file, nothing broken is left


def test_many_processes_may_build_at_once(bag, cache):
    script = 'import sys; from tap_ros.recording.cache import open_recordings; ' \
        'print(open_recordings(sys.argv[1], progress=False).num_frames)'
    runs = [subprocess.Popen([sys.executable, '-c', script, str(bag)], stdout=subprocess.PIPE,
                             text=True) for _ in range(3)]
    frames = {run.communicate()[0].strip() for run in runs}
    assert frames == {str(open_recordings(bag).num_frames)}
    assert len(list(cache.glob('*-*'))) == 2


def test_large_recordings_are_decoded_in_other_processes(tmp_path, bag, episodes, monkeypatch):
    monkeypatch.setattr(cache_module, '_ALONE_BYTES', 0)
    monkeypatch.setattr(cache_module, 'decode_file', None)  # here, not there
    assert_all_equal(open_recordings(bag), episodes)
    with EpisodeWriter(bag / 'push2_1.mcap') as writer:
        writer.write(make_episode(size=(8, 8)))
        writer.write(make_episode(size=(4, 16)))
    with EpisodeWriter(bag / 'push2_0.mcap') as writer:
        writer.write(make_episode(seed=99))
    with pytest.raises(RecordingError, match='push2_1.mcap: images of different sizes'):
        open_recordings(bag)


def test_a_script_without_a_guard_runs_once(tmp_path, bag, episodes):
    script = tmp_path / 'script.py'
    script.write_text(
        'import sys\nfrom tap_ros.recording import cache\ncache._ALONE_BYTES = 0\n'
        'cache.decode_file = None  # here, not there\n'
        'print("begins", len(cache.open_recordings(sys.argv[1], progress=False)), flush=True)\n')
    run = subprocess.run([sys.executable, script, bag], capture_output=True, text=True,
                         env=os.environ | {'PYTHONPATH': os.getcwd()})
    assert (run.stdout, run.stderr) == (f'begins {len(episodes)}\n', '')


def test_an_unusable_cache_folder_is_named(tmp_path, bag):
    (tmp_path / 'file').write_text('')
    with pytest.raises(RecordingError, match='TAP_ROS_CACHE'):
        open_recordings(bag, tmp_path / 'file' / 'cache')
