# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Weights to and from a Hub; a folder stands for it behind the calls of huggingface_hub."""

from pathlib import Path
import pickle
import shlex
from types import SimpleNamespace

import pytest
from tap_ros.cli import main
from tap_ros.weights import FORWARD_MODEL, PREDICTORS

huggingface_hub = pytest.importorskip('huggingface_hub')
FILE = PREDICTORS['push2']


@pytest.fixture
def repository(tmp_path, monkeypatch):
    """Return the folder that is every repository of the Hub."""
    folder = tmp_path / 'repository'
    folder.mkdir()

    def commit(repo, operations, commit_message):
        for operation in operations:
            Path(folder, operation.path_in_repo).write_bytes(operation.path_or_fileobj)
        return SimpleNamespace(oid='c' * 40)

    def info(repo, revision):
        files = [SimpleNamespace(rfilename=path.name) for path in sorted(folder.iterdir())]
        return SimpleNamespace(sha='c' * 40, siblings=files)

    def download(repo, name, revision, local_dir):
        path = Path(local_dir, name)
        path.write_bytes((folder / name).read_bytes())
        return str(path)

    monkeypatch.setattr(huggingface_hub, 'HfApi', lambda: SimpleNamespace(
        create_repo=lambda *words, **options: None, create_commit=commit, model_info=info,
        hf_hub_download=download))
    monkeypatch.chdir(tmp_path)
    return folder


def test_weights_come_back_by_the_command_that_push_prints(repository, tmp_path, capsys):
    assert main(['hub', 'push', 'push2', 'me/weights']) == 0
    assert {path.name for path in repository.iterdir()} == {
        FILE.name, 'README.md', 'predictor_push2.png'}
    assert (repository / 'README.md').read_bytes() == FILE.with_suffix('.md').read_bytes()
    command = shlex.split(capsys.readouterr().out)
    assert main(command[3:]) == 0
    assert (tmp_path / 'weights' / FILE.name).read_bytes() == FILE.read_bytes()


def test_weights_without_a_card_get_one_that_says_what_the_file_says(repository, tmp_path):
    (tmp_path / 'mine.safetensors').write_bytes(FORWARD_MODEL.read_bytes())
    assert main(['hub', 'push', 'mine.safetensors', 'me/weights']) == 0
    assert '"kind": "forward_model"' in (repository / 'README.md').read_text()


@pytest.mark.parametrize('name, data, named', [
    ('a.safetensors', FILE.read_bytes()[:-9], 'damaged, truncated'),
    ('a.safetensors', pickle.dumps({}), 'damaged, truncated'),
    ('model.bin', pickle.dumps({}), 'expected one of the .safetensors files of me/weights: none'),
    ('a.safetensors', FILE.read_bytes(), 'a.safetensors: is there already with other content')])
def test_what_is_refused_leaves_what_was_there(repository, tmp_path, capsys, name, data, named):
    (repository / name).write_bytes(data)
    (tmp_path / 'a.safetensors').write_bytes(b'mine')
    assert main(['hub', 'pull', 'me/weights', '--out', '.']) == 1
    assert named in capsys.readouterr().err
    assert (tmp_path / 'a.safetensors').read_bytes() == b'mine'


def test_what_the_hub_refuses_is_one_line(monkeypatch, capsys):
    monkeypatch.setenv('HF_HUB_OFFLINE', '1')
    assert main(['hub', 'pull', 'not/a/name', '--out', 'weights']) == 1
    error, = capsys.readouterr().err.splitlines()
    assert error.startswith('error: not/a/name: ')
