# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The command line: help, errors, and what needs no ROS."""

from functools import partial
from importlib import import_module
from pathlib import Path
import subprocess
import sys
import time

import pytest
import tap_ros
from tap_ros.__main__ import LINE, main
from tap_ros.base import progress
from tap_ros.recording.cache import open_recordings
from tap_ros.training.split import split_episodes
from tap_ros.weights import FORWARD_MODEL, PREDICTORS

ROOT = Path(__file__).parents[2]
SAMPLE = ROOT / 'bags' / 'sample_push2'


@pytest.mark.parametrize('arguments, named', [
    (['inspect', 'nowhere.mcap'], 'nowhere.mcap'),
    (['inspect', 'nowhere.safetensors'], 'nowhere.safetensors'),
    (['train', 'predictor', 'nowhere', '--out', 'somewhere'], 'nowhere'),
])
def test_an_error_names_the_file_and_is_one_line(arguments, named, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert main(arguments) == 1
    error = capsys.readouterr().err.strip()
    assert error.startswith('error: ') and named in error and '\n' not in error


def test_the_version_is_that_of_the_package(capsys):
    assert main(['--version']) == 0
    assert capsys.readouterr().out == f'tap_ros {tap_ros.__version__}\n'
    manifest = (ROOT / 'package.xml').read_text()
    assert f'<version>{tap_ros.__version__}</version>' in manifest


@pytest.mark.parametrize('words, near, others', [
    (['trian', 'x'], 'train', 'import-lerobot'), (['train', 'predicter', 'x'], 'predictor', ''),
    (['evaluate', 'predction'], 'prediction', 'forward'), (['inspct', '--help'], 'inspect', '')])
def test_an_unknown_command_is_answered_with_the_nearest_one(words, near, others, capsys):
    with pytest.raises(SystemExit) as end:
        main(words)
    said = capsys.readouterr().err
    assert end.value.code == 2 and f"did you mean '{near}'" in said and others in said
    assert said.count('\n') == 1


def test_a_command_without_its_second_word_is_told_the_choices(capsys):
    with pytest.raises(SystemExit) as end:
        main(['evaluate'])
    assert end.value.code == 2
    assert capsys.readouterr().err == (
        'error: evaluate needs a second word; valid: prediction, forward\n')


@pytest.mark.parametrize('words', [
    ['tap_ros', '--help'], ['tap_ros', 'train', 'predictor', '--help'],
    ['experiments', 'paper', '--list']])
def test_a_reader_who_has_seen_enough_is_no_error(words):
    with subprocess.Popen([sys.executable, '-m', *words], cwd=ROOT, text=True,
                          stdout=subprocess.PIPE, stderr=subprocess.PIPE) as process:
        process.stdout.close()
        assert process.stderr.read() == ''


@pytest.mark.parametrize('words', [['--version'], ['train', 'predictor', '--help']])
def test_output_that_nothing_has_room_for_is_an_error_in_one_line(words):
    with open('/dev/full', 'w') as full:
        run = subprocess.run([sys.executable, '-m', 'tap_ros', *words], cwd=ROOT, text=True,
                             stdout=full, stderr=subprocess.PIPE)
    assert run.returncode == 1 and run.stderr.startswith('error: No space left')
    assert run.stderr.count('\n') == 1


def test_a_progress_bar_in_a_pipe_is_one_line(tmp_path):
    words = ['collect', '--out', 'bag', '--episodes', '3', '--task', 'grasp',
             '--episodes-per-file', '1']
    run = subprocess.run([sys.executable, '-m', 'tap_ros', *words], cwd=tmp_path, text=True,
                         capture_output=True, check=True)
    line, = run.stderr.splitlines()
    assert '3/3' in line and '\r' not in run.stderr


def test_a_log_says_now_and_then_how_far_a_long_job_is(monkeypatch, capsys):
    monkeypatch.setattr(progress, 'EVERY_S', 0.2)
    for _ in progress.Progress(range(5)):
        time.sleep(0.15)
    assert not list(progress.Progress([]))
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) > 1 and '5/5' in lines[-1] and all('/5' in line for line in lines)


def test_inspect_holds_out_what_a_training_does(capsys):
    for share, said in (('0.05', '19 episodes to learn from, 1 held out'),
                        ('0.25', '15 episodes to learn from, 5 held out')):
        assert main(['inspect', str(SAMPLE), '--test-fraction', share]) == 0
        assert said in capsys.readouterr().out
        training, held_out = split_episodes(open_recordings(SAMPLE), float(share))
        assert said.startswith(f'{len(training)} ') and f' {len(held_out)} held out' in said


def test_collect_then_inspect(tmp_path, capsys):
    folder, picture = tmp_path / 'push', tmp_path / 'strips.png'
    assert main(['collect', '--out', str(folder), '--episodes', '2', '--seed', '3']) == 0
    assert [episode.seed for episode in open_recordings(folder)] == [3, 4]
    assert main(['inspect', str(folder), '--picture', str(picture)]) == 0
    assert '2 episodes' in capsys.readouterr().out
    assert picture.read_bytes().startswith(b'\x89PNG')


@pytest.mark.parametrize('path', [FORWARD_MODEL, *PREDICTORS.values()], ids=lambda path: path.stem)
def test_shipped_weights_say_what_they_are(path, capsys):
    assert main(['inspect', str(path)]) == 0
    assert 'data_hash' in capsys.readouterr().out
    card = path.with_suffix('.md').read_text()
    assert 'python -m tap_ros train' in card or 'python -m experiments paper' in card
    assert 'python -m tap_ros collect' in card and path.name in card


def test_the_sample_recording_is_readable():
    episodes = list(open_recordings(SAMPLE))
    assert len(episodes) == 20
    assert all(episode.task == 'push2' and len(episode.frames) <= 50 for episode in episodes)


def test_names_of_files_do_not_reach_the_terminal_raw(tmp_path, capsys):
    forged = tmp_path / 'a\n\x1b[31mFORGED.mcap'
    forged.write_bytes(b'nothing')
    assert main(['inspect', str(forged)]) == 1
    output = ''.join(capsys.readouterr())
    assert r'a\n\x1b[31mFORGED.mcap' in output and '\x1b' not in output
    assert len(output.splitlines()) == 1


def test_a_missing_package_is_named_and_others_are_not_hidden(
        capsys, monkeypatch):
    monkeypatch.setitem(sys.modules, 'pyarrow', None)
    for name in ('pyarrow', 'nosuch'):
        monkeypatch.setitem(LINE.commands, name, ('', partial(import_module, name)))
    assert main(['pyarrow']) == 1
    assert 'pip install pyarrow' in capsys.readouterr().err
    with pytest.raises(ModuleNotFoundError):
        main(['nosuch'])


ENDED = """
from dataclasses import dataclass
import sys
from tap_ros.apps.cli import Command, CommandLine, main

@dataclass
class Options:
    '''Options.'''

def run(options):
    exec('raise KeyboardInterrupt')

LINE = CommandLine('ended', 'End.', dict.fromkeys(
    ('now', 'then'), ('end', lambda: Command(Options, run))))
sys.exit(main(LINE, ['now']))
"""


def test_an_interrupt_that_leaves_an_exec_ends_a_command_as_any_other(tmp_path):
    (tmp_path / 'ended.py').write_text(ENDED)
    run = subprocess.run([sys.executable, '-m', 'ended'], cwd=tmp_path, capture_output=True)
    assert (run.returncode, run.stderr) == (130, b'interrupted\n')
