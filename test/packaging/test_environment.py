# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Shells, containers and terminals as people have them: it works, or one line says why not."""

from ctypes.util import find_library
import os
from pathlib import Path
import re
import shlex
import signal
import subprocess
import sys

import pytest

ROOT = Path(__file__).parents[2]
KEPT = {name: value for name, value in os.environ.items() if name != 'MUJOCO_GL'}


def run(code, **changes):
    """Run Python code with other variables, None for none of that name; return what it printed."""
    environment = {k: v for k, v in (KEPT | changes).items() if v is not None}
    return subprocess.run([sys.executable, '-c', code], cwd=ROOT, env=environment, text=True,
                          stdout=subprocess.PIPE, stderr=subprocess.STDOUT, timeout=100)


@pytest.mark.parametrize('options', ['-eu -o pipefail', '+u'])
def test_the_environment_can_be_entered_by_any_shell(options):
    if not (ROOT / '.venv' / 'bin' / 'activate').is_file():
        pytest.skip('installed without make')
    line = f'set {options}; . scripts/environment.bash; python -c "import rclpy"; echo "left $-"'
    done = subprocess.run(['bash', '-c', line], cwd=ROOT, text=True, capture_output=True,
                          env={'PATH': os.environ['PATH']})
    assert done.returncode == 0 and 'left' in done.stdout, done.stderr
    assert ('u' in done.stdout.split('left ')[1]) == ('u' in options and '+' not in options)


@pytest.mark.parametrize('terminal', [False, True])
def test_a_step_of_the_set_up_shows_that_it_goes_on_and_what_it_said_when_it_failed(
        tmp_path, terminal):
    line = (f'. scripts/step.bash; who=set-up log={tmp_path}/log minute=1; '
            'step short true; step long sleep 4; step last bash -c "echo why; exit 3"')
    words = ['bash', '-ec', line]
    if terminal:
        words = ['script', '-qec', shlex.join(words), '/dev/null']
    said = subprocess.run(words, cwd=ROOT, text=True, capture_output=True,
                          stdin=subprocess.DEVNULL).stdout  # a \r is read as \n
    assert re.search(r'short \.\.\. \d+ s\n', said), said
    assert re.search(r'long \.\.\. \d+ s \n' if terminal else r'\n.* long goes on, \d+ s', said)
    assert re.search(r'long .*\.\.\. \d+ s\n', said), said
    assert re.search(r'last \.\.\. (\d+ s )*failed.*\s+why\s*$', said), said


def test_the_ros2_command_says_how_to_get_it_until_it_is_there():
    if (ROOT / 'ros2').exists() or not (ROOT / '.venv' / 'bin' / 'activate').is_file():
        pytest.skip('it is there, or installed without make')
    line = '. scripts/environment.bash; . scripts/environment.bash; ros2 topic list'
    done = subprocess.run(['bash', '-c', line], cwd=ROOT, text=True, capture_output=True,
                          env={'PATH': os.defpath})
    assert done.returncode == 127 and 'make ros2' in done.stderr, done.stderr


@pytest.mark.parametrize('value', ['disabled', pytest.param('osmesa', marks=pytest.mark.skipif(
    find_library('OSMesa') is not None, reason='OSMesa is installed'))])
def test_without_opengl_physics_runs_and_pictures_are_refused_in_one_line(value):
    done = run('import sim_bridge, mujoco\n'
               'mujoco.MjModel.from_xml_string("<mujoco/>")\n'
               'from tap_ros.base.errors import SceneError\n'
               'try: from sim_bridge.simulator import Simulator; Simulator().reset(0)\n'
               'except SceneError as error: print("refused:", error)', MUJOCO_GL=value)
    assert done.returncode == 0 and done.stdout.startswith('refused: '), done.stdout
    assert f'MUJOCO_GL={value}' in done.stdout and 'MUJOCO_GL=egl' in done.stdout
    assert done.stdout.count('\n') == 1


@pytest.mark.ros
@pytest.mark.parametrize('home', [None, '/proc'])
def test_without_a_home_cache_and_logs_find_a_place(tmp_path, home):
    """Whoever has no entry in passwd has no home without HOME, as with docker run --user."""
    code = ('import os, pwd\n'
            'def unknown(uid): raise KeyError\n'
            'pwd.getpwuid = unknown\n'
            'os.access = lambda path, mode, _=os.access: "tmp" in path and _(path, mode)\n'
            'import tap_ros, rclpy\n'
            'from tap_ros.recording.cache import cache_folder\n'
            'rclpy.init()\n'
            'print(cache_folder())')
    done = run(code, HOME=home, TMPDIR=str(tmp_path), TAP_ROS_CACHE=None, ROS_LOG_DIR=None)
    assert done.stdout == f'{tmp_path}/tap_ros-{os.getuid()}/cache\n'
    assert list(tmp_path.glob('tap_ros-*/log/*'))


@pytest.mark.parametrize('module', [
    'tap_ros', pytest.param('tap_ros.nodes', marks=pytest.mark.ros)])
def test_ctrl_c_while_python_imports_is_one_line(module, tmp_path):
    slow = tmp_path / 'numpy.py'  # imported by all, for ever
    slow.write_text('import time\n'
                    'try: print("importing", flush=True); time.sleep(60)\n'
                    'except BaseException as error: raise ImportError from error\n')
    path = os.pathsep.join([str(tmp_path), str(ROOT), os.environ.get('PYTHONPATH', '')])
    words = ['inspect', str(tmp_path)] if module == 'tap_ros' else ['predictor_node']
    process = subprocess.Popen(
        [sys.executable, '-m', module, *words], cwd=ROOT, env=os.environ | {'PYTHONPATH': path},
        text=True, stdout=subprocess.PIPE, stderr=subprocess.STDOUT)
    assert process.stdout.readline() == 'importing\n'
    process.send_signal(signal.SIGINT)
    assert (process.communicate(timeout=20)[0], process.returncode) == ('interrupted\n', 130)
