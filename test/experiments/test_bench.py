# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The benchmarks measure what they say."""

from dataclasses import dataclass
import mmap
import os
from pathlib import Path
from types import SimpleNamespace

from experiments import tables
from experiments.bench import everything, growth, recording
from experiments.bench.mppi import mppi
from experiments.bench.rows import Row, show
import numpy as np
import pytest
from tap_ros.planning.protocols import Problem, SearchConfig


def test_all_frames_are_opened_beside_another_job(monkeypatch):
    monkeypatch.setattr(recording, 'JPEG_FRAMES', 20)
    args = recording.Options(episodes=2, files=1, repeats=1)
    *ours, pictures = recording.run(args)
    assert [row.ratio > 0 for row in ours] == [True, True]
    assert '20 JPEG frames' in pictures.what and pictures.reached
    monkeypatch.setattr(recording, 'build_cache', lambda paths, scratch: 1)
    with pytest.raises(RuntimeError, match='saw 1 of'):
        list(recording.run(args))


def test_memory_is_what_is_held_beside_mapped_files(tmp_path):
    size, file = 50 * 10**6, tmp_path / 'file'
    file.write_bytes(bytes(size))
    before = growth.held(os.getpid())
    mapped = np.memmap(file, np.uint8, 'r')
    assert mapped.sum() == 0 and growth.held(os.getpid()) - before < size / 2
    # Not of malloc, which may give again what was freed before.
    with mmap.mmap(-1, size, mmap.MAP_PRIVATE | mmap.MAP_ANONYMOUS) as ours:
        ours[:] = bytes([1]) * size
        assert growth.held(os.getpid()) - before > 0.9 * size


@pytest.mark.slow
def test_a_recording_larger_than_the_memory_is_inspected(tmp_path):
    limit = 130 * 10**6
    assert growth.write(tmp_path / 'bag', 54, 256, 12) > limit
    seconds, memory = growth.measure(['inspect', str(tmp_path / 'bag')], tmp_path / 'cache', limit)
    assert seconds > 0 and 0 < memory < limit
    with pytest.raises(RuntimeError, match='inspect'):  # the limit holds
        growth.measure(['inspect', str(tmp_path / 'bag')], tmp_path / 'new', limit // 4)


@pytest.mark.ros
def test_work_is_done_in_turns_alone_and_beside_others():
    from experiments.bench.nodes import busy
    found = []

    def children():
        return sum(len(one.read_text().split()) for one in Path('/proc/self/task').glob(
            '*/children'))

    def seconds():
        found.append(children() - before)
        return 1 + found[-1]

    before = children()
    row = busy.compare(busy.Work('nothing', 1, seconds), 2, 3)
    assert found == [0, 3, 0, 3] and children() == before
    assert row.ratio == 4 and row.reached == (busy.CORES == 1)
    assert row.what == 'nothing beside 3 busy processes' and row.to == 'alone (4.00 to 4.00)'


def test_a_row_that_misses_its_aim_says_why():
    with pytest.raises(ValueError, match='a plan: misses at most 1 s'):
        show(Row('a plan', '2 s', 2.0, 'its predictions', 'at most 1 s', False))
    show(row := Row('a plan', '2 s', 2.0, 'its predictions', 'at most 1 s', False, 'all of it'))
    assert row.cells[-2:] == ('**missed**: at most 1 s', 'all of it')


def test_rows_are_kept_as_they_are_measured_and_what_was_interrupted_goes_on(
        tmp_path, monkeypatch):
    @dataclass(frozen=True)
    class Options:
        end: str = 'c'

    def run(options):
        for what in 'abc':
            if what == fails:
                raise KeyboardInterrupt
            yield Row(what, '1 s', 1.0, 'itself', 'at most 2 s')

    def kept(machine='one'):
        assert tables.filled('speed') == page.read_text()
        return {row['what']: row['commit'] for row in tables.measured_speed()['rows']
                if row['machine'] == machine}

    page = tmp_path / 'speed.md'
    page.write_text('<!-- table -->\n<!-- end -->\n')
    (tmp_path / 'speed.json').write_text('{"rows": [], "unfinished": []}')
    monkeypatch.setattr(tables, 'SPEED', tmp_path / 'speed.json')
    monkeypatch.setattr(tables, 'page_path', lambda name: page)
    part = SimpleNamespace(Options=Options, run=run)
    monkeypatch.setattr(everything, 'module', lambda name: part)
    made = {'machine': 'one', 'date': 'today', 'commit': '1', 'torch': '2'}
    monkeypatch.setattr(everything, 'made_by', lambda: made)
    fails = ''
    everything.measure('start', Options())
    everything.measure('busy', Options(end='d'))  # not the default: printed alone
    assert kept() == {'a': '1', 'b': '1', 'c': '1'} and '| one (1 of today) |' in page.read_text()
    assert everything.is_measured('start') and not everything.is_measured('busy')
    made, fails = made | {'commit': '2'}, 'b'
    assert not everything.is_measured('start')
    with pytest.raises(KeyboardInterrupt):
        everything.measure('start', Options())
    assert kept() == {'a': '2', 'b': '1', 'c': '1'} and not everything.is_measured('start')
    assert '(2 of today, 1 of today)' in page.read_text()
    fails = ''
    everything.run(everything.Options())
    assert kept() == {'a': '2', 'b': '2', 'c': '2'}
    assert [row['part'] for row in tables.measured_speed()['rows']] == [
        name for name in everything.PARTS for _ in 'abc']
    made, fails = made | {'machine': 'two', 'commit': '3'}, 'b'
    with pytest.raises(KeyboardInterrupt):
        everything.measure('start', Options())
    assert kept('two') == {'a': '3'} and kept() == {'a': '2', 'b': '2', 'c': '2'}
    assert '| a | 1 s; 1.00 x itself | 1 s; 1.00 x itself | at most 2 s |' in page.read_text()
    assert '| b | 1 s; 1.00 x itself |  | at most 2 s |' in page.read_text()
    assert not everything.is_measured('start')
    made = made | {'machine': 'one', 'commit': '2'}
    assert everything.is_measured('start')


def test_mppi_goes_to_the_least_cost():
    target = np.array([0.3, -0.7, 0.2])

    def search(cost=lambda samples: ((samples - target) ** 2).sum(1), **changes):
        problem = Problem(cost, np.zeros(3), np.full(3, 0.3), **changes)
        return mppi(problem, SearchConfig(num_iterations=12), np.random.default_rng(0))

    assert np.abs(search().best - target).max() < 0.05
    assert (search(proposals=target[None]).best == target).all()
    right = search(cost=lambda samples: np.where(samples[:, 0] > 0, np.nan, -samples[:, 0]))
    assert right.best[0] <= 0 and np.isfinite(right.cost)
    assert len(search(cost=lambda samples: np.full(len(samples), np.nan)).best) == 3
