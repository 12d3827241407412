# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Full disks, kills, and two processes at once: the old file or the new one, nothing between."""

import os
import resource
import subprocess
import sys
from threading import Thread

import pytest
from tap_ros.__main__ import main
from tap_ros.base.errors import StorageError
from tap_ros.base.files import only_keeper, only_writer, write_atomically

HOLD = ('import sys; from tap_ros.base.files import only_writer\n'
        'with only_writer(sys.argv[1]): print(1, flush=True); sys.stdin.read()')


@pytest.fixture
def small_files():
    """Let no file grow beyond 20 000 bytes: what a full disk looks like."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (20_000, before[1]))
    yield
    resource.setrlimit(resource.RLIMIT_FSIZE, before)


def test_a_full_disk_leaves_the_old_file_and_nothing_else(tmp_path, small_files):
    path = tmp_path / 'settings.json'
    write_atomically(path, 'old')
    with pytest.raises(StorageError) as error:
        write_atomically(path, bytes(30_000))
    assert str(error.value).startswith(f'{path}: cannot be written: ')
    assert str(error.value).isprintable()
    assert path.read_text() == 'old' and os.listdir(tmp_path) == ['settings.json']
    write_atomically(path, 'new')
    assert path.read_text() == 'new'


def test_what_a_killed_writer_left_is_used_again(tmp_path):
    (tmp_path / 'a.part').write_bytes(bytes(100))
    write_atomically(tmp_path / 'a', 'whole')
    assert (tmp_path / 'a').read_text() == 'whole' and os.listdir(tmp_path) == ['a']


@pytest.mark.parametrize('put', [
    os.symlink, os.link, lambda _, part: os.mkfifo(part), lambda _, part: os.symlink('no', part)])
def test_what_a_stranger_put_where_a_file_is_written_first_is_not_followed(put, tmp_path):
    outside, folder = tmp_path / 'outside', tmp_path / 'in'
    outside.write_text('precious')
    folder.mkdir()
    (folder / 'a').write_text('old')
    for name, write in (('a.part', lambda: write_atomically(folder / 'a', 'new')),
                        ('.a.lock', only_keeper(folder / 'a').__enter__)):
        put(outside, folder / name)
        if (folder / name).is_symlink() or name == 'a.part':
            with pytest.raises(StorageError, match=f'{name}: is a link.*|a: cannot be written'):
                write()
    assert outside.read_text() == 'precious' and (folder / 'a').read_text() == 'old'
    assert not (folder / 'no').exists() and not (folder / 'a').is_symlink()


def test_writers_at_once_never_mix(tmp_path):
    path, texts = tmp_path / 'a', [str(i) * 50_000 for i in range(8)]
    write_atomically(path, texts[0])

    def write(text):
        for _ in range(10):
            write_atomically(path, text)
    threads = [Thread(target=write, args=(text,)) for text in texts]
    for thread in threads:
        thread.start()
    while any(thread.is_alive() for thread in threads):
        assert path.read_text() in texts
    assert os.listdir(tmp_path) == ['a']


def test_a_folder_has_one_writer_until_that_one_is_dead(tmp_path):
    holder = subprocess.Popen([sys.executable, '-c', HOLD, str(tmp_path)],
                              stdin=subprocess.PIPE, stdout=subprocess.PIPE)
    assert holder.stdout.readline() == b'1\n'
    with pytest.raises(StorageError, match='another process is writing there'), \
            only_writer(tmp_path):
        pass
    holder.kill()
    holder.wait()
    with only_writer(tmp_path):
        assert os.listdir(tmp_path) == []


@pytest.mark.parametrize('arguments', [
    ['collect', '--episodes', '1', '--out'], ['inspect', 'bags/sample_push2', '--picture'],
    ['train', 'predictor', 'bags/sample_push2', '--out']], ids=lambda words: words[0])
def test_a_place_that_cannot_be_written_is_one_line(arguments, tmp_path, capsys):
    (tmp_path / 'file').write_text('')
    assert main([*arguments, str(tmp_path / 'file' / 'below')]) == 1
    last = capsys.readouterr().err.splitlines()[-1]
    assert last.startswith('error: ') and str(tmp_path / 'file') in last


def test_an_error_of_the_system_is_one_line(capsys, monkeypatch):
    def run(_):
        raise OSError(28, 'No space left on device', '/disk/a\n\x1b[2Jb')
    monkeypatch.setattr('tap_ros.apps.inspect_files.run', run)
    assert main(['inspect', 'x']) == 1
    line, = capsys.readouterr().err.splitlines()
    assert 'No space left on device' in line and '/disk/a\\n\\x1b' in line
