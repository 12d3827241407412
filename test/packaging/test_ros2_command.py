# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The lines of docs/ros.md, word for word, with the real ros2 command: apt, or `make ros2`."""

import os
from pathlib import Path
import re
import shutil
import signal
import subprocess
import time

import pytest

ROOT = Path(__file__).parents[2]
LINES = [line.split('   #')[0].strip() for block in re.findall(
    r'^```bash\n(.*?)^```$', (ROOT / 'docs' / 'ros.md').read_text(), re.M | re.S)
    for line in block.splitlines() if line.startswith('ros2 ')]
RUNS = [line for line in LINES if line.startswith('ros2 run ') and 'runs/' not in line]
CALLS = [line for line in LINES if line.startswith(('ros2 service', 'ros2 action'))]

pytestmark = [pytest.mark.slow, pytest.mark.skipif(
    shutil.which('ros2') is None, reason='the ros2 command is not there: make ros2')]


class Started:
    """A process group that runs a line of a page."""

    def __init__(self, line, folder, name, domain):
        self.log = folder / f'{name}.log'
        environment = os.environ | {'ROS_DOMAIN_ID': str(domain), 'ROS_LOG_DIR': str(folder)}
        with open(self.log, 'wb') as output:
            self.process = subprocess.Popen(
                line, shell=True, stdout=output, stderr=subprocess.STDOUT, cwd=folder,
                env=environment, start_new_session=True)

    def wait_for(self, words, timeout_s=90):
        """Wait until it prints something."""
        deadline = time.monotonic() + timeout_s
        while words not in self.log.read_text(errors='replace'):
            assert self.process.poll() is None and time.monotonic() < deadline, (
                self.log.read_text(errors='replace'))
            time.sleep(0.1)

    def end(self):
        """End it as Ctrl+C does; return what it printed."""
        if self.process.poll() is None:
            os.killpg(self.process.pid, signal.SIGINT)
            try:
                self.process.wait(30)
            except subprocess.TimeoutExpired:
                os.killpg(self.process.pid, signal.SIGKILL)
                self.process.wait()
        return self.log.read_text(errors='replace')


@pytest.fixture
def domain():
    """Yield a domain beside that of the tests, where the nodes have their names to themselves."""
    number = (int(os.environ.get('ROS_DOMAIN_ID', 0)) + 50) % 100 + 1
    yield number
    subprocess.run(['ros2', 'daemon', 'stop'], capture_output=True, timeout=60,
                   env=os.environ | {'ROS_DOMAIN_ID': str(number)})


def call(line, folder, domain):
    """Return what a line prints that ends by itself."""
    done = subprocess.run(line, shell=True, capture_output=True, text=True, timeout=180,
                          cwd=folder, env=os.environ | {'ROS_DOMAIN_ID': str(domain)})
    assert done.returncode == 0, done.stdout[-2000:] + done.stderr
    return done.stdout


def test_nodes_run_and_answer_as_the_page_says(tmp_path, domain):
    started = []
    try:
        for number, node in enumerate(('sim_node', 'predictor_node', 'visual_mpc_node',
                                       'recorder_node')):
            line = next(line for line in RUNS if f' {node}' in line)
            started.append(Started(line, tmp_path, f'{number}', domain))
        for one in started:
            one.wait_for('ready')
        deadline = time.monotonic() + 30  # the command's daemon hears of nodes by and by
        while len(call('ros2 node list', tmp_path, domain).split()) < 4:
            assert time.monotonic() < deadline
        others = 'forward|num_samples|select_objects'  # of nodes that do not run here
        for line in (line for line in CALLS if not re.search(others, line)):
            answer = call(line, tmp_path, domain)
            assert any(words in answer for words in (
                'success=True', 'SUCCEEDED', 'Result(result=1,')), f'{line}\n{answer[-2000:]}'
        assert call('ros2 topic echo --once /tf_static', tmp_path, domain)
        assert 'tap_ros predictor_node' in call('ros2 pkg executables tap_ros', tmp_path, domain)
        assert 'num_samples' in call(
            'ros2 interface show tap_msgs/srv/PredictSubgoal', tmp_path, domain)
    finally:
        logs = [one.end() for one in started]
    assert not any('Traceback' in log for log in logs), '\n'.join(logs)
    assert list((tmp_path / 'bags' / 'mine').glob('*.mcap'))


@pytest.mark.parametrize('argument, words', [
    ('params_file:=mine.yaml', 'params_file: mine.yaml is not there'),
    ('rviz:=true', 'rviz2 is not installed')])
def test_a_launch_without_what_it_needs_starts_nothing(argument, words, tmp_path, domain):
    if shutil.which('rviz2') and 'rviz' in argument:
        pytest.skip('rviz2 is installed')
    launch = Started(f'ros2 launch tap_ros nodes.launch.py {argument}', tmp_path, 'launch', domain)
    try:
        assert launch.process.wait(60) == 1
    finally:
        said = launch.end()
    assert words in said and 'process started' not in said, said


@pytest.mark.parametrize('space', ['', '/robot1'])
def test_launch_files_start_what_they_say_in_any_namespace(space, tmp_path, domain):
    launch = Started('ros2 launch tap_ros nodes.launch.py' + (
        f' namespace:={space}' if space else ''), tmp_path, 'launch', domain)
    try:
        deadline, ready = time.monotonic() + 90, 0
        while ready < 3 and time.monotonic() < deadline:
            ready = len(re.findall(r'\]: ready', launch.log.read_text(errors='replace')))
            time.sleep(0.2)
        assert ready == 3, launch.log.read_text(errors='replace')
        for name, value in (('sim_node', False), ('predictor_node', True),
                            ('visual_mpc_node', True)):
            said = call(f'ros2 param get {space}/{name} use_sim_time', tmp_path, domain)
            assert said.strip() == f'Boolean value is: {value}'
        assert 'success=True' in call(
            f'ros2 service call {space}/predict_subgoal tap_msgs/srv/PredictSubgoal', tmp_path,
            domain)
        others = {'/diagnostics', '/parameter_events', '/rosout'}
        topics = set(call('ros2 topic list', tmp_path, domain).split()) - others
        assert all(topic.startswith(f'{space}/') for topic in topics), topics
        said = call(f'ros2 topic info {space}/clock', tmp_path, domain)
        assert int(said.split()[-1]) >= 2, 'planner and predictor hear it'
    finally:
        said = launch.end()
    assert said.count('process has finished cleanly') == 3, said
