# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Entry points of other packages that cannot be used: one line says whose they are."""

import os
import subprocess
import sys

import pytest
from tap_ros.base.errors import ConfigError
from tap_ros.base.plugins import BUILT_IN, load_plugin, names
from tap_ros.robots.arm import known_arms

CAUSES = {'raises': 'RuntimeError: needs the licence', 'leaves': 'SystemExit: 3',
          'lacks': "AttributeError: module 'broken_lacks' has no attribute 'part'",
          'differs': 'TypeError: is of type int, which is no'}
LONG = 90  # s, that a node may take to end on a busy machine


@pytest.fixture(autouse=True)
def package(tmp_path, monkeypatch):
    """Install a package whose parts of every group are broken in their own ways."""
    about = tmp_path / 'site' / 'broken_parts-1.0.dist-info'
    about.mkdir(parents=True)
    (about / 'METADATA').write_text('Metadata-Version: 2.1\nName: broken-parts\nVersion: 1.0\n')
    (about / 'entry_points.txt').write_text('\n'.join(
        f'[{group}]\n' + '\n'.join(f'{cause} = broken_{cause}:part' for cause in CAUSES)
        for group in BUILT_IN) + '\n[tap_ros.solvers]\nfails = broken_fails:part\n')
    for cause, text in (
            ('raises', 'raise RuntimeError("needs the licence\\nof its maker")'),
            ('leaves', 'import sys\nsys.exit(3)'), ('lacks', ''), ('differs', 'part = 3'),
            ('fails', 'def part(*_, **__):\n    1 / 0')):
        (about.parent / f'broken_{cause}.py').write_text(
            f'open({str(tmp_path / "imported")!r}, "a").close()\n{text}\n')
    monkeypatch.syspath_prepend(about.parent)
    monkeypatch.setenv('PYTHONPATH', f'{about.parent}{os.pathsep}{os.environ["PYTHONPATH"]}'
                       if os.environ.get('PYTHONPATH') else str(about.parent))
    return tmp_path / 'imported'


@pytest.mark.parametrize('group', BUILT_IN)
def test_a_part_that_cannot_be_used_is_named_with_its_package(group, package):
    assert {*CAUSES, *BUILT_IN[group]} <= set(names(group))
    assert not package.exists(), 'to list them nothing is imported'
    for cause, said in CAUSES.items():
        with pytest.raises(ConfigError) as error:
            load_plugin(group, cause)
        text = str(error.value)
        assert f'entry point broken_{cause}:part of the package broken-parts' in text
        assert said in text and '\n' not in text


def test_a_broken_arm_hinders_no_other():
    with pytest.warns(UserWarning, match='arm raises: entry point'):
        assert {arm.name for arm in known_arms()} == set(BUILT_IN['tap_ros.arms'])


@pytest.mark.parametrize('words', [
    ['collect', '--task', 'push2', '--world', 'raises'],
    ['collect', '--task', 'push2', '--arm', 'raises'],
    ['predict', 'start.png', 'goal.png', '--weights', 'raises:x'],
    ['evaluate', 'prediction', '--recordings', 'bags/sample_push2', '--weights', 'leaves:x']])
def test_a_command_ends_with_one_line(words, tmp_path):
    words = [*words, '--out', str(tmp_path / 'out')]
    words[-1] += '.png' if words[0] == 'predict' else ''
    # A process of its own: names are listed once, when a command is imported.
    ended = subprocess.run([sys.executable, '-m', 'tap_ros', *words], stderr=subprocess.PIPE,
                           text=True, timeout=LONG)
    assert ended.returncode == 1
    line = ended.stderr.splitlines()[-1]
    assert line.startswith('error: ') and 'of the package broken-parts cannot be used' in line


@pytest.mark.ros
@pytest.mark.parametrize(('node', 'parameter'), [
    ('visual_mpc_node', 'solver:=leaves'), ('visual_mpc_node', 'solver:=fails'),
    ('visual_mpc_node', 'arm:=raises'),
    ('predictor_node', 'weights:=raises:x'), ('tracker_node', 'tracker:=raises'),
    ('sim_node', 'world:=raises'), ('robot_mask_node', 'urdf:=lacks')])
def test_a_node_ends_with_one_line(node, parameter):
    ended = subprocess.run(
        [sys.executable, '-m', 'tap_ros.nodes', node, '--ros-args', '-p', parameter],
        capture_output=True, text=True, timeout=LONG)
    text = ended.stdout + ended.stderr
    assert ended.returncode == 1 and 'Traceback' not in text
    line, = [line for line in text.splitlines() if 'FATAL' in line]
    assert ('solver fails: cannot plan: ZeroDivisionError' if 'fails' in parameter
            else 'of the package broken-parts cannot be used') in line
