# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Laws of running many tasks, on this machine and on a Ray cluster of several nodes."""

import os
from pathlib import Path
import signal
import subprocess
import sys
import time

import pytest
from tap_ros.base.engines import Engine, run_tasks, TRIES, Work
from tap_ros.base.errors import ConfigError, EngineError, RecordingError

ROOT = Path(__file__).parents[2]


def square(number):
    if number < 0:
        raise RecordingError(f'{number} is none')
    return number * number


def die(folder, times):
    """Be killed so many times, then return how often it was tried."""
    tries = len(list(Path(folder).iterdir()))
    Path(folder, str(tries)).touch()
    if tries < times:
        os.kill(os.getpid(), signal.SIGKILL)
    return tries + 1


def write_slowly(path, seconds):
    Path(path).with_suffix(f'.{os.getpid()}').touch()
    time.sleep(seconds)
    Path(path).write_text(Path(path).name)


def check_squares(engine):
    tasks = [Work(str(i), square, (i,)) for i in range(-1, 4)]
    ends = {task.name: get for task, get in run_tasks(tasks, engine)}
    with pytest.raises(RecordingError, match='^-1 is none$'):
        ends.pop('-1')()
    assert {name: get() for name, get in ends.items()} == {'0': 0, '1': 1, '2': 4, '3': 9}


def test_every_task_is_run_once_and_an_error_is_that_of_its_task():
    assert list(run_tasks([], Engine('ray'))) == []
    check_squares(Engine(workers=2))


def test_the_task_of_a_killed_worker_is_run_again_and_given_up_in_the_end(tmp_path):
    folders = [tmp_path / 'once', tmp_path / 'always']
    for folder in folders:
        folder.mkdir()
    tasks = [Work(folder.name, die, (folder, times)) for folder, times in zip(folders, (1, 100))]
    once, always = (get for _, get in run_tasks(tasks, Engine(workers=1)))
    assert once() == 2
    with pytest.raises(EngineError, match=f'always: its worker process was killed {TRIES} times'):
        always()
    assert len(list(folders[1].iterdir())) == TRIES


def test_an_interrupted_run_leaves_no_worker(tmp_path):
    script = ('import signal, sys; sys.path[:0] = sys.argv[2:]\n'
              'from test_engines import write_slowly\n'
              'from tap_ros.base.engines import run_tasks, Work\n'
              'if __name__ == "__main__":\n'
              '    signal.signal(signal.SIGINT, signal.default_int_handler)\n'
              '    list(run_tasks([Work("slow", write_slowly, (sys.argv[1], 300.0))]))')
    (tmp_path / 'script.py').write_text(script)
    path = tmp_path / 'file'
    process = subprocess.Popen(
        [sys.executable, tmp_path / 'script.py', path, ROOT, ROOT / 'test' / 'base'],
        stderr=subprocess.PIPE)
    while not (begun := list(tmp_path.glob('file.*'))) and process.poll() is None:
        time.sleep(0.05)
    process.send_signal(signal.SIGINT)
    assert b'KeyboardInterrupt' in process.communicate(timeout=60)[1]
    assert not Path('/proc', begun[0].suffix[1:]).exists() and not path.exists()


@pytest.mark.minutes
def test_ray_gives_what_the_pool_gives_also_when_a_node_dies(tmp_path, monkeypatch):
    ray = pytest.importorskip('ray')
    from ray.cluster_utils import Cluster
    with pytest.raises(ConfigError, match='does not answer at 127.0.0.1:1'):
        list(run_tasks([Work('a', square, (1,))], Engine('ray', address='127.0.0.1:1')))
    monkeypatch.setenv('PYTHONPATH', os.pathsep.join([str(ROOT), str(ROOT / 'test' / 'base')]))
    cluster = Cluster(initialize_head=True, head_node_args={'num_cpus': 0})
    workers = [cluster.add_node(num_cpus=1) for _ in range(2)]
    cluster.wait_for_nodes()
    engine = Engine('ray', address=cluster.address)
    try:
        check_squares(engine)
        tasks = [Work(str(i), write_slowly, (tmp_path / f'file{i}', 3.0)) for i in range(4)]
        for _, get in run_tasks(tasks, engine):
            get()
            if len(workers) == 2:
                while len(list(tmp_path.glob('*.*'))) < 4:
                    time.sleep(0.02)  # until each node has begun another task
                cluster.remove_node(workers.pop(), allow_graceful=False)
    finally:
        ray.shutdown()
        cluster.shutdown()
    assert len(list(tmp_path.glob('*.*'))) > len(list(tmp_path.glob('file?'))) == 4


@pytest.mark.parametrize('program, chosen, threads', [
    ('/any/bin/predictor_node', None, '1'), ('/any/bin/predictor_node', '3', '3'),
    ('/any/experiments/mine.py', None, 'None'), ('/any/bin/mine', None, 'None')])
def test_each_of_our_programs_has_one_thread_unless_the_user_chose(program, chosen, threads):
    variables = {key: value for key, value in os.environ.items() if key != 'OMP_NUM_THREADS'}
    code = (f'import os, sys; sys.argv = [{program!r}]; import tap_ros; '
            "print(os.environ.get('OMP_NUM_THREADS'))")
    said = subprocess.run(
        [sys.executable, '-c', code], capture_output=True, text=True, cwd=ROOT,
        env=variables | ({'OMP_NUM_THREADS': chosen} if chosen else {}))
    assert said.stdout.strip() == threads, said.stderr


def test_experiments_have_one_thread_from_their_first_import():
    variables = {key: value for key, value in os.environ.items() if key != 'OMP_NUM_THREADS'}
    said = subprocess.run(
        [sys.executable, '-c', ENTERED], capture_output=True, text=True, cwd=ROOT, env=variables)
    assert said.stdout.split() == ['1', 'False'], said.stderr


# What `python -m experiments` imports before its module is run: the package alone.
ENTERED = """
import os, sys
sys.argv, sys.orig_argv = ['-m'], ['python', '-m', 'experiments']
import experiments
print(os.environ.get('OMP_NUM_THREADS'), 'numpy' in sys.modules)
"""
