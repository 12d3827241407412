# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Faults as a command: rows that are kept, and what damaged files do, with few trials."""

import json
import sys

from experiments.faults import disk, recordings, weights
from experiments.faults.children import Reader, run_limited
from experiments.faults.fault import Fault
from experiments.faults.page import make_page
from experiments.faults.runner import run_faults
import pytest
from tap_ros.errors import ConfigError, TapError

FEW = {  # trials of each fault
    'recording-cuts': 90, 'recording-flips': 60, 'recording-opcodes': 8,
    'recording-missing-chunks': 8, 'recording-pictures': 7, 'recording-metadata': 18,
    'recording-pipes': 2, 'recording-bombs': 1, 'weights-flips': 40, 'weights-nonsense': 53}


def fault(name, run, count=4, **fields):
    return Fault(name, f'{name} happens', 'It matters.', 'It is borne.', count, 0.1, run, **fields)


def tries(job):
    for trial in job.trials():
        job.record(trial != 1, f'no luck with {trial}', figure=trial)


def fails(job):
    job.record(True)
    raise RuntimeError('no\nnodes')


def test_rows_say_what_held_and_why_not(tmp_path):
    faults = {'Some': [fault('a', tries, figure='luck', unit='s'), fault('b', fails)]}
    rows = {row['fault']: row for row in run_faults(faults, tmp_path, progress=False)}
    assert json.loads((tmp_path / 'faults.json').read_text()) == list(rows.values())
    a, b = rows['a'], rows['b']
    assert (a['tried'], a['held'], a['figure'], a['unit']) == (4, 3, 3.0, 's')
    assert a['why_not'] == 'no luck with 1'
    assert a['command'] == 'python -m tap_ros evaluate faults --only a --again'
    assert {'machine', 'date', 'commit', 'seconds'} <= set(a)
    # An error in one fault is a row, too, and the others are tried nevertheless.
    assert (b['tried'], b['held']) == (4, 0)
    assert 'RuntimeError' in b['why_not'] and '\n' not in b['why_not']
    page = (tmp_path / 'faults.md').read_text()
    for words in ('a happens', 'It matters.', 'It is borne.', '**3**', '3.0 s', 'no luck with 1'):
        assert words in page


def test_a_run_goes_on_where_it_was_interrupted(tmp_path):
    tried = []
    faults = {'Some': [fault(name, lambda job: tried.append(job.fault.name) or tries(job))
                       for name in 'abc']}

    def run(**options):
        tried.clear()
        run_faults(faults, tmp_path, progress=False, **options)
        return ''.join(tried)
    assert run(only=['b']) == 'b'
    assert run() == 'ac'
    assert run() == ''
    assert run(only=['c'], again=True) == 'c'
    (tmp_path / 'faults.json').unlink()
    assert run(share=0.5) == 'abc'
    assert [row['tried'] for row in json.loads((tmp_path / 'faults.json').read_text())] == [2] * 3
    assert run(share=0.25) == ''
    assert run() == 'abc'  # more trials than were made


def test_a_fault_that_could_not_be_tried_is_tried_again(tmp_path):
    assert run_faults({'Some': [fault('a', fails)]}, tmp_path, progress=False)[0]['held'] == 0
    assert run_faults({'Some': [fault('a', tries)]}, tmp_path, progress=False)[0]['held'] == 3


def test_what_cannot_be_run_is_named(tmp_path):
    with pytest.raises(ConfigError, match='no fault nothing; valid: a'):
        run_faults({'Some': [fault('a', tries)]}, tmp_path, only=['nothing'])
    with pytest.raises(ConfigError, match='--share is 0'):
        run_faults({}, tmp_path, share=0.0)
    (tmp_path / 'faults.json').write_text('{"a": ')
    with pytest.raises(TapError, match='faults.json'):
        run_faults({'Some': [fault('a', tries)]}, tmp_path)


def test_the_page_needs_only_the_rows(tmp_path):
    faults = {'Some': [fault('a', tries)]}
    run_faults(faults, tmp_path, progress=False)
    rows = {row['fault']: row for row in json.loads((tmp_path / 'faults.json').read_text())}
    assert make_page(rows, faults) == (tmp_path / 'faults.md').read_text()
    assert 'Not measured yet' not in make_page(rows, faults)
    some = {name: row for name, row in rows.items() if name != 'a'}
    assert 'Not measured yet: `a`.' in make_page(some, faults)
    assert '`a`' in make_page(rows, {})  # a row whose fault is gone


@pytest.mark.parametrize('chosen', recordings.FAULTS + weights.FAULTS,
                         ids=lambda chosen: chosen.name)
def test_damaged_files_are_borne(chosen, tmp_path):
    row, = run_faults({'Files': [chosen]}, tmp_path, share=FEW[chosen.name] / chosen.count,
                      progress=False)
    assert row['held'] == row['tried'] > 0, row['why_not']


@pytest.mark.slow
@pytest.mark.parametrize('chosen', disk.FAULTS, ids=lambda chosen: chosen.name)
def test_a_full_disk_is_borne(chosen, tmp_path):
    row, = run_faults({'Disks': [chosen]}, tmp_path, share=1 / chosen.count, progress=False)
    assert row['held'] == row['tried'] > 0, row['why_not']


def test_a_child_that_hangs_or_crashes_is_noticed(tmp_path):
    ended = run_limited([sys.executable, '-c', 'import time; time.sleep(60)'], 0.5)
    assert ended.code is None and ended.seconds < 30
    write = f'open({str(tmp_path / "large")!r}, "wb").write(bytes(9999))'
    assert run_limited([sys.executable, '-c', write], 30, file_bytes=1000).code == 1
    (tmp_path / 'a.mcap').write_bytes(b'no recording')
    with Reader() as reader:
        assert reader.read('recording', tmp_path / 'a.mcap')['expected']
        reader._process.kill()
        assert reader.read('recording', tmp_path / 'a.mcap')['kind'] == 'crash'
        assert reader.read('recording', tmp_path / 'a.mcap')['expected']
