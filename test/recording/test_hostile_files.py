# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Files of strangers: nothing outside the folder is read, nothing in it is run, nothing is endless.

What is good beside them is imported, and one line tells what was not.
"""

import json
import os
from pathlib import Path
import resource
import shutil
import signal
import sqlite3
import struct
import warnings

import cv2
from made_bags import camera, write_mcap
from mcap.writer import CompressionType
import numpy as np
import pyarrow
from pyarrow import parquet
import pytest
from tap_ros.__main__ import main
from tap_ros.base.errors import ConfigError, RecordingError, StorageError
from tap_ros.recording import mcap_file
from tap_ros.recording.cache import open_recordings
from tap_ros.recording.formats.lerobot_subtasks import Ends, write_subtasks
from tap_ros.recording.formats.tfrecord import _missing
from tap_ros.recording.marks import read_marks
from tap_ros.recording.metadata import FILE_NAME, from_yaml
from tap_ros.recording.trust import Budget, inside
from test_foreign_formats import write_bare_db3
from test_importers import make_frames, masked, record, rlds, write_video
import zstandard

CAMERA = 'observation.images.top'
DEEP = '[' * 100000
PICTURE = np.full((8, 8, 3), 77, np.uint8)
SECRET = cv2.imencode('.png', np.full((8, 8, 3), 200, np.uint8))[1].tobytes()


@pytest.fixture(autouse=True)
def bounded():
    """Let nothing take more than 3 GiB and two minutes."""
    def interrupt(*_):
        raise KeyboardInterrupt
    used = int(Path('/proc/self/statm').read_text().split()[0]) * resource.getpagesize()
    limits, handler = resource.getrlimit(resource.RLIMIT_AS), signal.signal(
        signal.SIGALRM, interrupt)
    resource.setrlimit(resource.RLIMIT_AS, (used + 3 * 2**30, limits[1]))
    signal.alarm(120)
    yield
    signal.alarm(0)
    signal.signal(signal.SIGALRM, handler)
    resource.setrlimit(resource.RLIMIT_AS, limits)


@pytest.fixture
def run(tmp_path, capsys):
    """Return what imports: a function that gives the frames of each episode, and what was said."""
    def run(command, *words):
        out = tmp_path / 'bag'
        with warnings.catch_warnings(record=True) as told:
            warnings.simplefilter('always')
            code = main([command, *map(str, words), '--out', str(out)])
            frames = [episode.frames for episode in open_recordings(out)] if out.exists() else []
        said = ''.join((*capsys.readouterr(), *(str(each.message) for each in told)))
        assert code == (not frames) and 'Traceback' not in said, said
        shutil.rmtree(out, ignore_errors=True)
        return frames, said
    return run


def png(value=77, side=8):
    return cv2.imencode('.png', np.full((side, side, 3), value, np.uint8))[1].tobytes()


def lerobot(folder, cells=None, row=(), rows=(), version='v2.1', **info):
    """Write a set of two episodes of three frames; changes are of the second one."""
    for part in ('data', 'meta'):
        (folder / part).mkdir(parents=True)
    feature = {'dtype': 'video' if 'video_path' in info else 'image', 'shape': [8, 8, 3]}
    (folder / 'meta/info.json').write_text(json.dumps({
        'codebase_version': version, 'fps': 5, 'chunks_size': 1000,
        'data_path': 'data/{episode_index:03d}.parquet', 'features': {CAMERA: feature}} | info))
    good, index = 3 * [{'bytes': png(), 'path': None}], np.arange(3)
    lines = [{'episode_index': e, 'length': 3, 'tasks': ['push']} | dict(row if e else ())
             for e in range(2)]
    (folder / 'meta/episodes.jsonl').write_text('\n'.join(map(json.dumps, lines)))
    for e in range(2):
        parquet.write_table(pyarrow.table({
            'timestamp': index / 5, 'index': index + 3 * e, 'episode_index': 0 * index + e,
            CAMERA: cells if e and cells else good} | dict(rows if e else ())),
            folder / f'data/{e:03d}.parquet')
    return folder


@pytest.fixture
def secret(tmp_path):
    """Put a picture beside the folder that is given."""
    (tmp_path / 'secret.png').write_bytes(SECRET)
    return tmp_path / 'secret.png'


@pytest.mark.parametrize('name', [
    '{secret}', '../secret.png', 'link.png', 'fifo', '/dev/zero', 'data', 'a\0b', 'x' * 5000,
    'loop', 'file://{secret}', '\ud800'])
def test_pictures_are_files_in_the_folder(name, secret, tmp_path, run):
    folder = lerobot(tmp_path / 'set', 3 * [
        {'bytes': None, 'path': name.format(secret=secret).encode('utf-8', 'replace').decode()}])
    os.mkfifo(folder / 'fifo')
    (folder / 'link.png').symlink_to(secret)
    (folder / 'loop').symlink_to('loop')
    frames, said = run('import-lerobot', folder)
    assert len(frames) == 1 and (frames[0] == 77).all() and 'episode 1' in said


@pytest.mark.parametrize('changes', [
    {'data_path': '../{{episode_index:03d}}.parquet'}, {'data_path': '{outside}'},
    {'data_path': 'data/{{episode_index:>3000000000}}.parquet'},
    {'data_path': 'data/{{episode_index.__class__}}.parquet'}, {'data_path': 'fifo'},
    {'data_path': 'data/{{0}}'}, {'data_path': None}, {'fps': 0},
    {'fps': float('nan')}, {'features': []}, {'chunks_size': float('inf')},
    {'features': {CAMERA: {'dtype': 'image', 'info': ['a']}}}, {'codebase_version': [[['v2.']]]},
    {'features': {CAMERA: {'dtype': 'image'}, 'action': [1], 'observation.state': 'x'}}])
def test_a_description_that_asks_for_more_is_refused_in_a_line(changes, tmp_path, run):
    outside = lerobot(tmp_path / 'other') / 'data/000.parquet'
    for number in range(2):
        shutil.copy(outside, tmp_path / f'{number:03d}.parquet')
    told = {key: value.format(outside=outside) if isinstance(value, str) else value
            for key, value in changes.items()}
    folder = lerobot(tmp_path / 'set', **told)
    os.mkfifo(folder / 'fifo')
    assert not run('import-lerobot', folder)[0]


@pytest.mark.parametrize('changes', [
    {'row': {'episode_index': 10**400}}, {'row': {'episode_index': DEEP[:500]}},
    {'row': {'length': -3}}, {'row': {'length': 10**18}}, {'row': {'tap_ros/seed': -1}},
    {'rows': {'timestamp': [0.0, 1e308, 2e308]}}, {'rows': {'timestamp': [0.0, 1e5, 1e6]}},
    {'rows': {'index': ['a', 'b', 'c']}}, {'rows': {CAMERA: [10**10] * 3}},
    {'rows': {CAMERA: [{'bytes': 10**10, 'path': None}] * 3}}])
def test_a_bad_episode_costs_no_good_one(changes, tmp_path, run):
    frames, said = run('import-lerobot', lerobot(tmp_path / 'set', **changes))
    assert len(frames) == 1 and '1' in said and 'warning' not in said.lower().replace(
        'recordingwarning', '')


def test_texts_that_no_message_can_hold_are_mended(tmp_path, run):
    assert len(run('import-lerobot', lerobot(
        tmp_path / 'set', chunks_size=0, row={'tasks': ['\ud800' + 'x' * 2**22]}))[0]) == 2


def test_a_table_that_is_longer_than_its_file_is_not_read_to_its_end(tmp_path, run):
    folder = lerobot(tmp_path / 'set')
    for many, words in ((pyarrow.nulls(2 * 10**7), '001.parquet: cannot be read'),
                        (pyarrow.DictionaryArray.from_arrays(np.zeros(4000, np.int32), [
                            bytes(2**20)]), 'episode 1: none of its pictures')):
        index = np.arange(len(many))
        parquet.write_table(pyarrow.table({
            CAMERA: many, 'index': index, 'episode_index': 0 * index + 1, 'timestamp': index / 5}),
            folder / 'data/001.parquet')
        (folder / 'meta/episodes.jsonl').write_text('\n'.join(json.dumps({
            'episode_index': e, 'length': length}) for e, length in enumerate((3, len(many)))))
        frames, said = run('import-lerobot', folder)
        assert len(frames) == 1 and words in said


@pytest.mark.parametrize('path', ['meta/info.json', 'meta/episodes.jsonl'])
def test_brackets_in_brackets_are_told_in_a_line(path, tmp_path, run):
    folder = lerobot(tmp_path / 'set')
    with open(folder / path, 'r+') as stream:
        text = stream.read()
        stream.seek(0)
        stream.write(DEEP + '\n' + text)
    frames, said = run('import-lerobot', folder)
    assert len(frames) == 2 * ('lines' in path or 'jsonl' in path) and 'brackets' in said


def test_a_snapshot_of_the_hub_is_read_through_its_links(tmp_path, run):
    snapshot = lerobot(tmp_path / 'datasets--a--b/snapshots/0123')
    blobs = tmp_path / 'datasets--a--b/blobs'
    blobs.mkdir()
    for number, file in enumerate(file for file in snapshot.rglob('*') if file.is_file()):
        file.rename(blobs / str(number))
        file.symlink_to(os.path.relpath(blobs / str(number), file.parent))
    assert len(run('import-lerobot', snapshot)[0]) == 2
    link = tmp_path / 'link'  # of the user
    link.symlink_to(snapshot)
    assert len(run('import-lerobot', link)[0]) == 2
    (snapshot / 'out').symlink_to('/etc/passwd')
    with pytest.raises(RecordingError, match='leads out'):
        inside(snapshot, 'out')


def filmed(path):
    write_video(path, np.broadcast_to(PICTURE, (6, 64, 64, 3)[:1] + PICTURE.shape).repeat(
        4, 1).repeat(4, 2), 5)
    return path


M3U8 = '#EXTM3U\n#EXT-X-TARGETDURATION:1\n#EXTINF:1,\n{}\n#EXT-X-ENDLIST\n'


@pytest.mark.parametrize('text', [
    M3U8, 'ffconcat version 1.0\nfile {}\n', '\0\0\0\x10ftypisom\0\0\0\0<MPD profiles="urn:mpeg:'
    'dash:profile:isoff-on-demand:2011"><BaseURL>{}</BaseURL></MPD>'])
def test_a_video_that_names_other_files_is_none(text, tmp_path, run, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / 'in').mkdir()
    filmed(tmp_path / 'in/b.mp4')
    (tmp_path / 'in/a.mp4').write_text(text.format(filmed(tmp_path / 'secret.mp4')))
    for name in ('c.mp4', 'd.mp4'):
        os.mkfifo(tmp_path / 'in' / name)
    (tmp_path / 'in/e.mp4').symlink_to(tmp_path / 'secret.mp4')
    (tmp_path / 'in/cache:f.mp4').write_bytes((tmp_path / 'in/b.mp4').read_bytes())
    frames, said = run('import-video', 'in')
    assert len(frames) == 2 and 'a.mp4' in said and 'e.mp4' in said and 'd.mp4' in said
    folder = lerobot(tmp_path / 'set', video_path='{video_key}{episode_index:03d}.mp4')
    filmed(folder / f'{CAMERA}000.mp4')
    (folder / f'{CAMERA}001.mp4').write_text(text.format(tmp_path / 'secret.mp4'))
    assert len(run('import-lerobot', folder)[0]) == 1
    for pattern in ('cache:a.mp4', 'concat:a.mp4|b.mp4', '../secret.mp4', 'http://[::1]/a.mp4'):
        shutil.rmtree(folder)
        lerobot(folder, video_path=pattern)
        assert not run('import-lerobot', folder)[0]


h5py = pytest.importorskip('h5py')


def hdf5(path, **arrays):
    with h5py.File(path, 'w') as file:
        for name, values in arrays.items():
            file[name] = values
    return path


def spoil_external(file, outside):
    file.create_dataset('top', (2, 8, 8, 3), 'u1', external=[('/etc/passwd', 0, 384)])


def spoil_link(file, outside):
    file['top'] = h5py.ExternalLink(str(outside), 'top')


def spoil_soft(file, outside):
    file['other'], file['top'] = h5py.ExternalLink(str(outside), '/'), h5py.SoftLink('/other/top')


def spoil_virtual(file, outside):
    layout = h5py.VirtualLayout((2, 8, 8, 3), 'u1')
    layout[:] = h5py.VirtualSource(outside, 'top', (2, 8, 8, 3))
    file.create_virtual_dataset('top', layout)


def spoil_size(file, outside):
    file.create_dataset('top', (10**9, 480, 640, 3), 'u1', chunks=(1, 480, 640, 3))[0] = 1


def spoil_bomb(file, outside):
    file.create_dataset('top', (4000, 1000, 1000, 3), 'u1', chunks=(100, 1000, 1000, 3),
                        compression='gzip')[0] = 1


def spoil_unwritten(file, outside):
    file.create_dataset('top', (100, 480, 640, 3), 'u1')


def spoil_filter(file, outside):
    plist = h5py.h5p.create(h5py.h5p.DATASET_CREATE)
    plist.set_chunk((2, 8, 8, 3))
    plist.set_filter(32001, h5py.h5z.FLAG_OPTIONAL, ())
    space = h5py.h5s.create_simple((2, 8, 8, 3))
    h5py.h5d.create(file.id, b'top', h5py.h5t.STD_U8LE, space, plist).write_direct_chunk(
        (0, 0, 0, 0), bytes(384))


def spoil_strings(file, outside):
    kind = h5py.special_dtype(vlen=np.uint8)
    file.create_dataset('top', (10**9,), kind, chunks=(9,))[0] = np.frombuffer(SECRET, np.uint8)


def spoil_numbers(file, outside):
    file['top'] = np.full((2, 8, 8, 3), np.nan)


def spoil_compound(file, outside):
    file['top'] = np.zeros((2, 8, 8, 3), [('a', 'u1'), ('b', 'f4')])
    file.create_dataset('one', (3,), h5py.ref_dtype)
    file['two'] = h5py.Empty('f4')


def spoil_nothing(file, outside):
    file['top'] = np.zeros((0, 8, 8, 3), 'u1')


@pytest.mark.parametrize('spoil', [value for name, value in list(globals().items())
                                   if name.startswith('spoil_')])
def test_an_array_has_its_values_in_its_own_file(spoil, tmp_path, run):
    (tmp_path / 'in').mkdir()
    outside = hdf5(tmp_path / 'secret.h5', top=np.full((2, 8, 8, 3), 200, 'u1'))
    hdf5(tmp_path / 'in/a.h5', top=np.stack(2 * [PICTURE]))
    with h5py.File(tmp_path / 'in/b.h5', 'w') as file:
        spoil(file, str(outside))
    frames, said = run('import-arrays', tmp_path / 'in')
    assert len(frames) == 1 and (frames[0] == 77).all() and 'b.h5' in said


def test_numbers_that_are_damaged_cost_no_picture_and_are_named(tmp_path, run):
    file = hdf5(tmp_path / 'a.h5', **{
        f'data/demo_{k}/{name}': values for k in range(2) for name, values in (
            ('top', np.stack(2 * [PICTURE])), ('good', np.ones((2, 3))))})
    with h5py.File(file, 'a') as opened:
        plist = h5py.h5p.create(h5py.h5p.DATASET_CREATE)
        plist.set_chunk((2, 3))
        plist.set_filter(32001, h5py.h5z.FLAG_OPTIONAL, ())
        h5py.h5d.create(
            opened['data/demo_1'].id, b'bad', h5py.h5t.IEEE_F64LE, h5py.h5s.create_simple((2, 3)),
            plist).write_direct_chunk((0, 0), bytes(48))
    frames, said = run('import-arrays', file)
    assert len(frames) == 2 and 'demo_1/bad of a.h5' in said and 'demo_1/top' not in said


def test_links_that_lead_nowhere_and_in_circles_leave_a_file_usable(tmp_path, run):
    file = hdf5(tmp_path / 'a.h5', **{'data/demo_0/top': np.stack(2 * [PICTURE])})
    with h5py.File(file, 'a') as opened:
        opened['gone'], opened['away'] = h5py.SoftLink('/no'), h5py.ExternalLink('no.h5', '/')
        opened['data/demo_0/up'] = opened['data']
        opened[b'\x80'] = np.zeros(3)
    assert len(run('import-arrays', file)[0]) == 1


def test_arrays_come_in_the_order_of_their_numbers(tmp_path, run):
    files = [hdf5(tmp_path / f'episode_{i}.hdf5', top=np.full((1, 8, 8, 3), i, 'u1'))
             for i in (0, 1, 10, 11, 2)]
    frames, _ = run('import-arrays', *files)
    assert [one[0, 0, 0, 0] for one in frames] == [0, 1, 2, 10, 11]


@pytest.mark.parametrize('name', ['a.zarr', 'a.zarr.zip'])
def test_zarr_is_refused_with_the_way_to_these_sets(name, tmp_path, run):
    if name.endswith('zip'):
        (tmp_path / name).write_bytes(b'PK\3\4')
    else:
        (tmp_path / name).mkdir()
        (tmp_path / name / '.zgroup').write_text('{}')
    frames, said = run('import-arrays', tmp_path / name)
    assert not frames and 'zarr' in said and 'import-lerobot' in said


def test_lengths_of_records_are_not_believed_and_shards_are_counted(tmp_path, run):
    good, folder = record(rlds(make_frames(0))), tmp_path / 'in'
    folder.mkdir()
    for number, length in enumerate((2**63, 2**64 - 1, 2**40)):
        head = struct.pack('<Q', length)
        (folder / f'{number}.tfrecord').write_bytes(good + head + masked(head) + b'x')
    nested = bytes(20)
    for _ in range(500):
        nested = b'\x0b' + nested
    (folder / '3.tfrecord').write_bytes(record({'a': [b'']}) + good)
    length = struct.pack('<Q', len(nested))
    (folder / '4.tfrecord').write_bytes(length + masked(length) + nested + masked(nested) + good)
    (folder / 'b-train.tfrecord-00001-of-00003').write_bytes(good)
    (folder / 'b-train.tfrecord-00002-of-00003').touch()
    os.mkfifo(folder / '5.tfrecord')
    frames, said = run('import-tfrecord', folder)
    assert len(frames) == 6 and '00000-of-00003' in said and '00002-of-00003: it is empty' in said
    for number in range(20):
        (folder / f'c{number}.tfrecord-00000-of-99999').write_bytes(good)
    told = sorted(_missing(folder.iterdir()))
    assert len(told) == 21 and told[1] == (
        'c0.tfrecord-00001-of-99999, c0.tfrecord-00002-of-99999, c0.tfrecord-00003-of-99999 and '
        '99995 more')


def bomb(path, content, count, compression=CompressionType.ZSTD):
    """Write an MCAP file of chunks that unpack to the same content."""
    import lz4.frame
    packed = zstandard.compress(content) if compression == CompressionType.ZSTD else (
        lz4.frame.compress(content))
    name = compression.name.lower().encode()
    chunk = struct.pack('<QQQII', 0, 0, len(content), 0, len(name)) + name + struct.pack(
        '<Q', len(packed)) + packed
    path.write_bytes(mcap_file.MAGIC + count * (struct.pack('<BQ', 6, len(chunk)) + chunk))
    return path


@pytest.mark.parametrize('content', [
    bytes(2**27), b'\x80' + struct.pack('<Q', 2**28 - 9) + bytes(2**28 - 9),
    2**20 * (b'\x80' + bytes(8))])
@pytest.mark.parametrize('compression, count', [
    (CompressionType.ZSTD, 20), (CompressionType.LZ4, 3)])
def test_chunks_that_unpack_to_more_than_a_recording_are_not_unpacked(
        content, compression, count, tmp_path):
    with pytest.raises(RecordingError, match='holds no message'):
        open_recordings(bomb(tmp_path / 'a.mcap', content, count, compression))


def test_a_chunk_of_lz4_that_unpacks_to_more_than_it_claims_is_refused(tmp_path, monkeypatch):
    file = bomb(tmp_path / 'a.mcap', bytes(2**27), 1, CompressionType.LZ4)
    data = file.read_bytes()
    claim = mcap_file.MAGIC + data[8:33] + struct.pack('<Q', 100)
    file.write_bytes(claim + data[len(claim):])
    with pytest.raises(RecordingError, match='more than it claims'):
        open_recordings(file)


def test_black_pictures_are_no_bomb(tmp_path):
    black = np.zeros((480, 640, 3), np.uint8)
    path = write_mcap(tmp_path / 'a.mcap', (camera(t / 10, black) for t in range(1, 40)))
    assert len(open_recordings(path)[0]) == 39 and path.stat().st_size < 10**5
    with pytest.raises(ValueError, match='unpacks to more'):
        Budget(path.stat().st_size).take(2**32)


def test_a_message_that_unpacks_to_more_than_a_picture_is_left_out(tmp_path):
    sent = [(topic, kind, zstandard.compress(data), log) for topic, kind, data, log in map(
        camera, range(1, 5))]
    topic, kind, _, log = sent[2]
    sent[2] = topic, kind, zstandard.compress(bytes(2**30)), log
    with pytest.warns(match='to too much'):
        assert len(open_recordings(write_mcap(tmp_path / 'a.mcap', sent))[0]) == 3


@pytest.mark.parametrize('change', [
    'CREATE VIEW messages AS WITH RECURSIVE n(i) AS (SELECT 1 UNION ALL SELECT i + 1 FROM n) '
    'SELECT i AS id, 1 AS topic_id, i AS timestamp, zeroblob(100) AS data FROM n',
    'CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id, timestamp, '
    'data BLOB GENERATED ALWAYS AS (zeroblob(900000000)))',
    "CREATE TABLE messages AS SELECT 1 id, 1 topic_id, 'x' timestamp, 5 data",
    'CREATE VIEW Messages AS WITH RECURSIVE n(i) AS (SELECT 1 UNION ALL SELECT i + 1 FROM n) '
    'SELECT i AS id, 1 AS topic_id, i AS timestamp, zeroblob(100) AS data FROM n',
    'CREATE TABLE MESSAGES(id INTEGER PRIMARY KEY, topic_id, timestamp, '
    'data BLOB AS (zeroblob(900000000)))'])
def test_a_base_of_views_and_formulas_is_refused(change, tmp_path):
    file = write_bare_db3(tmp_path)
    with sqlite3.connect(file) as base:
        base.execute('DROP TABLE messages')
        base.execute(change)
    with pytest.raises(RecordingError):
        open_recordings(file)


def test_a_base_whose_pages_stand_in_each_other_has_an_end(tmp_path):
    file = write_bare_db3(tmp_path)
    with sqlite3.connect(file) as base:
        root, = base.execute(
            "SELECT rootpage FROM sqlite_master WHERE name = 'messages'").fetchone()
        size, = base.execute('PRAGMA page_size').fetchone()
    data, leaf = bytearray(file.read_bytes()), size // 2
    pages = len(data) // size
    for page in range(pages + 1, pages + 9):  # a tree of nine storeys, all of one leaf
        below = page + 1 if page < pages + 8 else pages + 9
        cells = b''.join(struct.pack('>IB', below, 1) for _ in range(100))
        start = size - len(cells)
        data += (struct.pack('>BHHHBI', 5, 0, 100, start, 0, below) + struct.pack(
            '>100H', *range(start, size, 5))).ljust(start, b'\0') + cells
    row = bytes([7, 1, 5, 0, 1, 1, 14]) + bytes([1, 1]) + b'x'
    data += (struct.pack('>BHHHB', 13, 0, 1, leaf, 0) + struct.pack('>H', leaf)).ljust(
        leaf, b'\0') + row.ljust(leaf, b'\0')
    data[(root - 1) * size:root * size] = data[pages * size:(pages + 1) * size]
    data[28:32] = struct.pack('>I', len(data) // size)
    file.write_bytes(data)
    with pytest.raises(RecordingError, match='interrupted'):
        open_recordings(file)


def test_a_packed_bag_unpacks_to_no_more_than_a_recording(tmp_path):
    with open(tmp_path / 'a.mcap.zst', 'wb') as stream:
        with zstandard.ZstdCompressor().stream_writer(stream) as packed:
            packed.write(mcap_file.MAGIC)
            for _ in range(24):
                packed.write(bytes(2**27))
    with pytest.raises(RecordingError, match='does not unpack.*zstd -d'):
        open_recordings(tmp_path / 'a.mcap.zst')


@pytest.mark.parametrize('text', [
    'a: &a [x]\n' + ''.join(f'b{i}: &{chr(98 + i)} [{", ".join(9 * ["*" + chr(97 + i)])}]\n'
                            for i in range(20)) + 'rosbag2_bagfile_information: '
    '{storage_identifier: *u, relative_file_paths: *u}',
    'a: &a {x: 1}\n' + ''.join(f'b{i}: &{chr(98 + i)} {{<<: [{", ".join(9 * ["*" + chr(97 + i)])}'
                               ']}\n' for i in range(20)),
    'a: ' + '1:' * 10**6 + '1', DEEP, '!!python/object/apply:os.system [exit]'])
def test_metadata_that_are_endless_are_refused(text, tmp_path):
    write_mcap(tmp_path / 'a.mcap', map(camera, (1, 2)))
    (tmp_path / FILE_NAME).write_text(text)
    with pytest.raises(RecordingError, match='not the metadata of a rosbag2 bag'):
        open_recordings(tmp_path)
    assert from_yaml('a: &x {b: 1}\nc: *x') == {'a': {'b': 1}, 'c': {'b': 1}}


@pytest.mark.parametrize('content', [
    DEEP, '{"marks": [{"recording": ' + '[' * 900 + ']' * 900 + ', "episode": 0, "stamps": [1]}]}',
    *(f'{{"marks": [{{"recording": "a.mcap", "episode": 0, "stamps": [{stamp}]}}]}}'
      for stamp in ('1e308', '1' * 400, '[[1]]', 'NaN', '-1e308')),
    '{"marks": [{"recording": "\\u0000", "episode": 0, "stamps": [1]}]}', None])
def test_marks_that_are_none_are_told_in_a_line(content, tmp_path):
    store = open_recordings(write_mcap(tmp_path / 'a.mcap', map(camera, range(1, 6))))
    file = tmp_path / 'a.marks.json'
    os.mkfifo(file) if content is None else file.write_text(content)
    with pytest.raises(ConfigError, match='a.marks.json'):
        read_marks(file, store)


@pytest.mark.parametrize('values', [
    pyarrow.ListArray.from_arrays(pyarrow.array([0, 10**8], pyarrow.int32()),
                                  pyarrow.nulls(10**8, pyarrow.int8())),
    pyarrow.ListArray.from_arrays(pyarrow.array([0, 10**8], pyarrow.int32()),
                                  pyarrow.nulls(10**8)),
    pyarrow.ListArray.from_arrays(pyarrow.array([0, 10**8], pyarrow.int32()),
                                  pyarrow.nulls(10**8, pyarrow.bool_())),
    pyarrow.DictionaryArray.from_arrays(np.zeros(1, np.int32), [bytes(2**20)])])
def test_a_row_of_more_than_numbers_and_names_is_not_unpacked(values, tmp_path, run):
    folder = lerobot(tmp_path / 'set')
    parquet.write_table(pyarrow.table({
        'timestamp': values, 'index': [3], 'episode_index': [1],
        CAMERA: [{'bytes': png(), 'path': None}]}), folder / 'data/001.parquet')
    (folder / 'meta/episodes.jsonl').write_text('\n'.join(json.dumps({
        'episode_index': e, 'length': length}) for e, length in enumerate((3, 1))))
    frames, said = run('import-lerobot', folder)
    assert len(frames) == 1 and 'more than numbers' in said


def labelled(folder, **changes):
    """Write a set that subtasks can be written into, and what they are."""
    lerobot(folder, **changes)
    (folder / 'data').rename(folder / 'chunk')
    (folder / 'data').mkdir()
    (folder / 'chunk').rename(folder / 'data/chunk')
    return folder, ['before', 'after'], {episode: Ends([0.2], 0.4) for episode in range(2)}


@pytest.mark.parametrize('name', [
    'data/chunk/000.parquet', 'data/chunk/001.parquet', 'meta/info.json',
    'meta/subtasks.parquet'])
def test_subtasks_are_written_into_the_set_alone(name, secret, tmp_path):
    folder, *given = labelled(tmp_path / 'set')
    (folder / f'{name}.part').symlink_to(secret)
    before = contents(folder)
    with pytest.raises(StorageError, match=f'{name}.part: is a link'):
        write_subtasks(folder, *given)
    assert secret.read_bytes() == SECRET and contents(folder) == before
    (folder / f'{name}.part').unlink()
    assert write_subtasks(folder, *given) == (6, 0)


@pytest.mark.parametrize('fps, rows, told, said', [
    (0, {}, {}, 'set: is no LeRobot data set: 0.0 frames'), ('nan', {}, {}, 'is no LeRobot'),
    *((5, {}, {'huggingface': text}, '001.parquet: ') for text in (
        '{}', '[]', '{"info": {"features": []}}', 'x', DEEP)),
    (5, {'timestamp': ['a', 'b', 'c']}, {}, '001.parquet: '),
    (5, {'timestamp': 3 * [[]]}, {}, '001.parquet: '), (5, None, {}, '001.parquet: ')])
def test_a_damaged_set_gets_no_subtasks_in_one_line(fps, rows, told, said, tmp_path):
    folder, *given = labelled(tmp_path / 'set', fps=fps, rows=rows or ())
    file = folder / 'data/chunk/001.parquet'
    parquet.write_table(parquet.read_table(file).replace_schema_metadata(told), file)
    if rows is None:
        file.write_bytes(b'PAR1xxxxPAR1')
    before = contents(folder)
    with pytest.raises(RecordingError, match=said) as error:
        write_subtasks(folder, *given)
    assert contents(folder) == before and str(error.value).isprintable()


def contents(folder):
    return {file: file.read_bytes() for file in folder.rglob('*') if file.is_file()}
