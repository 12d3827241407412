# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Weights to and from a Hugging Face Hub, by the commands as processes and huggingface_hub itself.

The Hub is a server of ours (hub_server.py) on this machine.
"""

import hashlib
import multiprocessing
import os
from pathlib import Path
import pickle
import re
import shutil
import signal
import subprocess
import sys

from hub_server import OWNER, READER, running_hub, TOKEN
import pytest
from tap_ros.cli import main
from tap_ros.weights import FORWARD_MODEL, PREDICTORS

ROOT = Path(__file__).parents[2]
FILE, OTHER = PREDICTORS['push2'], PREDICTORS['push3']
NAME, REPO = FILE.name, f'{OWNER}/weights'
needs_hub = pytest.mark.skipif(
    'not __import__("importlib").util.find_spec("huggingface_hub")',
    reason='huggingface_hub is not installed')


@pytest.fixture
def hub(tmp_path):
    with running_hub(tmp_path / 'xet') as hub:
        yield hub


def run_hub(words, folder, environment, printed):
    """Be a process that runs `python -m tap_ros hub` with words."""
    os.chdir(folder)
    os.environ.clear()
    os.environ.update(environment)
    for stream, path in enumerate(printed, 1):
        os.dup2(os.open(path, os.O_WRONLY | os.O_CREAT | os.O_TRUNC), stream)
    sys.exit(main(['hub', *words]))


class Shell:
    """A shell in a folder of its own, which knows a Hub and a token and no other settings."""

    # From one process that has imported torch: forty times that would take minutes.
    processes = multiprocessing.get_context('forkserver')
    processes.set_forkserver_preload(['tap_ros.cli', 'tap_ros.hub.checked'])

    def __init__(self, hub, folder):
        self.folder, self.scratch = folder / 'work', folder / 'scratch'
        self.folder.mkdir()
        self.scratch.mkdir()
        self.printed = folder / 'output', folder / 'error'
        kept = {name: value for name, value in os.environ.items()
                if not name.upper().startswith(('HF_', 'HUGGING')) and 'proxy' not in name.lower()}
        path = os.pathsep.join([str(ROOT), kept.get('PYTHONPATH', '')])
        self.environment = kept | {
            'HF_ENDPOINT': hub.url, 'HF_HOME': str(folder / 'home'), 'HF_TOKEN': TOKEN,
            'HF_HUB_DISABLE_XET': '1', 'PYTHONPATH': path, 'TMPDIR': str(self.scratch)}

    def start(self, *words, **environment):
        """Start a command."""
        process = self.processes.Process(target=run_hub, args=(
            [str(word) for word in words], self.folder, self.environment | environment,
            self.printed))
        process.start()
        return process

    def end(self, process):
        """Wait for a command; return its exit code and what it printed."""
        process.join()
        return process.exitcode, *(path.read_text() for path in self.printed)

    def run(self, *words, **environment):
        """Run a command; return what it printed as {name: value}."""
        code, output, error = self.end(self.start(*words, **environment))
        assert (code, error) == (0, '')
        return dict(line.split(maxsplit=1) for line in output.splitlines())

    def refused(self, *words, **environment):
        """Run a command; return the one line that says why not."""
        code, output, error = self.end(self.start(*words, **environment))
        assert (code, output) == (1, '')
        line, = error.splitlines()
        assert line.startswith('error: ') and '\x1b' not in line
        return line


@pytest.fixture
def shell(hub, tmp_path):
    return Shell(hub, tmp_path)


def sha256(data):
    return hashlib.sha256(data).hexdigest()


def files(folder):
    """Return {path: content} of all files below a folder."""
    return {str(path.relative_to(folder)): path.read_bytes()
            for path in sorted(folder.rglob('*')) if path.is_file()}


@needs_hub
@pytest.mark.parametrize('way', ['git-lfs', 'Xet'])
def test_shipped_weights_come_back_bit_for_bit_by_the_command_that_push_prints(
        way, hub, shell, tmp_path):
    card, picture = FILE.with_suffix('.md'), FILE.with_suffix('.png')
    if way == 'Xet':
        del shell.environment['HF_HUB_DISABLE_XET']
        hub.expect_by_xet(FILE, picture)
    told = shell.run('push', 'push2', REPO)
    repository = hub.repositories[REPO]
    assert list(repository.commits)[1:] == [told['commit']] and not repository.private
    assert repository.commits[told['commit']] == {
        '.gitattributes': repository.commits[told['commit']]['.gitattributes'],
        NAME: FILE.read_bytes(), 'README.md': card.read_bytes(),
        picture.name: picture.read_bytes()}
    assert told['sha256'] == sha256(FILE.read_bytes())
    hub.add(REPO, {NAME: OTHER.read_bytes()})  # what comes later is not what was named

    pull = told['pull'].replace(' python ', f' {sys.executable} ')
    run = subprocess.run(pull, shell=True, cwd=shell.folder, env=shell.environment, text=True,
                         capture_output=True)
    assert (run.returncode, run.stderr) == (0, '')
    assert run.stdout.split() == ['file', f'weights/{NAME}', 'commit', told['commit'], 'sha256',
                                  told['sha256']]
    assert files(shell.folder) == {f'weights/{NAME}': FILE.read_bytes()}
    assert not any(shell.scratch.iterdir())
    at_store = [token for _, path, token in hub.requests if path.startswith('/store')]
    assert at_store == ([] if way == 'Xet' else [None] * 3)  # no token for another host
    assert any((tmp_path / 'xet').rglob('*')) == (way == 'Xet')


@needs_hub
def test_a_commit_names_the_older_file_after_a_second_push(shell):
    weights = shell.folder / 'mine.safetensors'
    commits = []
    for source in (FILE, OTHER):
        shutil.copy(source, weights)
        commits.append(shell.run('push', weights, REPO, '--message', 'mine')['commit'])
    assert shell.run('push', weights, REPO)['commit'] == commits[1]  # nothing new, no commit
    for commit, source in zip(commits, (FILE, OTHER)):
        told = shell.run('pull', REPO, '--revision', commit, '--out', commit)
        assert (told['commit'], told['sha256']) == (commit, sha256(source.read_bytes()))
        assert Path(shell.folder, told['file']).read_bytes() == source.read_bytes()
    assert shell.run('pull', REPO, '--out', 'newest')['commit'] == commits[1]


@needs_hub
def test_a_branch_is_made_and_leaves_main_as_it_was(hub, shell):
    told = shell.run('push', 'push2', REPO, '--revision', 'trial', '--private')
    assert hub.repositories[REPO].private
    assert shell.refused('pull', REPO, '--out', 'a').endswith(
        'holds no .safetensors file, only .gitattributes; correct REPO_ID or --revision')
    assert 'hf auth login' in shell.refused('pull', REPO, '--out', 'a', HF_TOKEN='')
    for revision in ('trial', told['commit']):
        got = shell.run('pull', REPO, '--revision', revision, '--out', 'a', HF_TOKEN=READER)
        assert got['commit'] == told['commit']


@needs_hub
def test_weights_without_a_card_get_one_that_says_what_the_file_says(hub, shell):
    import yaml
    weights = shell.folder / 'forward.safetensors'
    shutil.copy(FORWARD_MODEL, weights)
    told = shell.run('push', weights, REPO)
    card = hub.repositories[REPO].commits[told['commit']]['README.md'].decode()
    _, front, text = card.split('---\n', 2)
    assert yaml.safe_load(front)['library_name'] == 'tap_ros' and 'license' not in front
    assert text.startswith('# forward.safetensors\n') and '"kind": "forward_model"' in text
    assert shell.run('pull', REPO, '--out', 'a')['sha256'] == sha256(FORWARD_MODEL.read_bytes())


@needs_hub
def test_a_file_with_other_content_is_replaced_only_when_told(hub, shell):
    hub.add(REPO, {f'best/{NAME}': FILE.read_bytes()})
    target = shell.folder / NAME
    target.write_bytes(b'mine')
    line = shell.refused('pull', REPO, '--out', '.')
    assert f'{NAME}: is there already' in line and '--force' in line
    assert files(shell.folder) == {NAME: b'mine'}
    shell.run('pull', REPO, '--out', '.', '--force')
    assert files(shell.folder) == {NAME: FILE.read_bytes()}
    before = target.stat()
    shell.run('pull', REPO, '--out', '.')
    assert target.stat().st_mtime_ns == before.st_mtime_ns


class Opened:
    """What a pickle would do."""

    def __init__(self, path):
        self.path = path

    def __reduce__(self):
        return Path.touch, (self.path,)


@needs_hub
@pytest.mark.parametrize('case, words, named', [
    ('good', ['--sha256', 64 * '0'], f'--sha256 says {64 * "0"}; nothing was written'),
    ('good', ['--sha256', '123'], '--sha256 123: expected 64 hexadecimal digits'),
    ('good', ['--revision', 'nix'], 'correct the name or --revision nix'),
    ('good', ['--file', 'model.pt'], 'pickles, are never loaded'),
    ('good', ['--file', 'a.safetensors'], f'--file a.safetensors: is not in {REPO}'),
    ('damaged', [], 'damaged: its content has another SHA-256'),
    ('cut', [], 'damaged, truncated, or no safetensors file'),
    ('pickle', [], 'damaged, truncated, or no safetensors file'),
    ('bin', [], 'holds no .safetensors file, only model.bin; correct'),
    ('several', [], f'several weights files; name one by --file: a.safetensors, {NAME}'),
    ('outside', ['--force'], '../../evil.safetensors'),
])
def test_what_is_refused_leaves_what_was_there(case, words, named, hub, shell):
    good = FILE.read_bytes()
    opened = shell.folder.parent / 'opened'
    hub.add(REPO, {
        'good': {NAME: good}, 'damaged': {NAME: good[:-9] + bytes([good[-9] ^ 1]) + good[-8:]},
        'cut': {NAME: good[:-9]}, 'pickle': {NAME: pickle.dumps(Opened(opened)) + bytes(5000)},
        'bin': {'model.bin': pickle.dumps(Opened(opened))},
        'several': {NAME: good, 'a.safetensors': good},
        'outside': {'../../evil.safetensors': good}}[case])
    Path(shell.folder, NAME).write_bytes(b'mine')
    assert named in shell.refused('pull', REPO, '--out', '.', *words)
    assert files(shell.folder) == {NAME: b'mine'} and not opened.exists()
    assert not any(shell.scratch.iterdir()) and not any(
        path.name == 'evil.safetensors' for path in shell.folder.parents[1].rglob('*'))


@needs_hub
def test_weights_of_another_program_are_refused(hub, shell):
    from safetensors.torch import save
    import torch
    hub.add(REPO, {'model.safetensors': save({'a': torch.ones(3000)})})
    line = shell.refused('pull', REPO, '--out', 'a')
    assert f'{REPO}/model.safetensors at ' in line and 'Nothing was written' in line
    assert str(shell.scratch) not in line and not files(shell.folder)


@needs_hub
def test_a_download_that_breaks_off_goes_on(hub, shell):
    hub.add(REPO, {NAME: FILE.read_bytes()})
    hub.cuts = 2
    shell.run('pull', REPO, '--out', 'a', '--sha256', sha256(FILE.read_bytes()).upper())
    assert files(shell.folder) == {f'a/{NAME}': FILE.read_bytes()} and hub.cuts == 0


@needs_hub
def test_a_server_that_dies_half_way_leaves_nothing(hub, shell):
    hub.add(REPO, {NAME: FILE.read_bytes()})
    hub.cuts, hub.dies = 1, True
    line = shell.refused('pull', REPO, '--out', 'a')
    assert hub.cuts == 0 and 'see whether the network is there' in line
    assert not any(shell.folder.iterdir()) and not any(shell.scratch.iterdir())


@needs_hub
@pytest.mark.parametrize('sent', [signal.SIGINT, signal.SIGKILL])
def test_a_pull_that_is_aborted_leaves_what_was_there(sent, hub, shell):
    hub.add(REPO, {NAME: FILE.read_bytes()})
    hub.stalls = True
    Path(shell.folder, NAME).write_bytes(b'mine')
    process = shell.start('pull', REPO, '--out', '.', '--force')
    assert hub.stalled.wait(100)
    while process.is_alive():  # once in some hundred runs the first interrupt had no effect
        os.kill(process.pid, sent)
        process.join(10)
    code, output, error = shell.end(process)
    assert not output and files(shell.folder) == {NAME: b'mine'}
    if sent == signal.SIGINT:
        assert (code, error) == (130, 'interrupted\n')
        assert not any(shell.scratch.iterdir())


@needs_hub
@pytest.mark.parametrize('words, environment, named', [
    (['push2', REPO], {'HF_TOKEN': 'wrong'}, '401 '),
    (['push2', REPO], {'HF_TOKEN': READER}, 'log in (`hf auth login`'),
    (['push2', 'other/weights'], {}, '403 '),
    (['push2', 'weights'], {}, 'REPO_ID weights: expected OWNER/NAME'),
    (['push2', 'a/b/c'], {}, 'REPO_ID a/b/c: expected OWNER/NAME'),
    (['push2', REPO, '--private'], {}, f'{REPO}: is there already, and public'),
    (['push2', REPO, '--revision', 40 * 'a'], {}, 'is a commit; name a branch'),
    (['push2', REPO], {'HF_HUB_OFFLINE': '1'}, 'HF_HUB_OFFLINE is set; unset it'),
    (['push2', REPO], {'HF_ENDPOINT': 'http://127.0.0.1:9'}, 'Connection refused'),
    (['nothing', REPO], {}, 'nothing: expected a .safetensors file, or shipped weights: grasp'),
    (['nothing.safetensors', REPO], {}, 'no such weights file'),
    (['bad.safetensors', REPO], {}, 'damaged, truncated'),
    (['carded.safetensors', REPO], {}, '"license" must be a known one'),
])
def test_what_cannot_be_pushed_changes_nothing(words, environment, named, hub, shell):
    before = hub.add(REPO, {'a': b'b'})
    Path(shell.folder, 'bad.safetensors').write_bytes(b'bad')
    shutil.copy(FILE, shell.folder / 'carded.safetensors')
    Path(shell.folder, 'carded.md').write_text('---\nlicense: nonsense\n---\n')
    assert named in shell.refused('push', *words, **environment)
    assert list(hub.repositories) == [REPO]
    assert hub.repositories[REPO].branches == {'main': before}


@needs_hub
def test_what_a_server_says_is_one_line(hub, shell):
    hub.status = 418
    line = shell.refused('pull', REPO, '--out', 'a')
    assert '418 ' in line and re.search(r'something \\x1b\[31mFORGED', line)


def test_where_the_library_is_missing_the_command_that_installs_it_is_named(monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, 'huggingface_hub', None)
    for words in (['push', 'push2', REPO], ['pull', REPO, '--out', 'a']):
        assert main(['hub', *words]) == 1
        assert "pip install '.[hub]'" in capsys.readouterr().err
