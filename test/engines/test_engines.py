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
from tap_ros.engines.task import Engine, run_tasks, TRIES, Work
from tap_ros.errors import ConfigError, EngineError, RecordingError

ROOT = Path(__file__).parents[2]


def square(number):
    return number * number


def refuse(number):
    raise RecordingError(f'{number} is none')


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


def numbers(engine, count=5):
    tasks = [Work(str(i), square, (i,)) for i in range(count)]
    return {task.name: get() for task, get in run_tasks(tasks, engine)}


@pytest.mark.parametrize('workers', [1, 2])
def test_every_task_is_run_once(workers):
    assert numbers(Engine(workers=workers)) == {str(i): i * i for i in range(5)}


def test_without_tasks_nothing_is_started():
    assert list(run_tasks([], Engine('ray'))) == []


def test_an_error_is_that_of_its_task_and_the_others_go_on():
    tasks = [Work('bad', refuse, (1,)), Work('good', square, (3,))]
    ends = dict(run_tasks(tasks, Engine(workers=1)))
    assert ends[tasks[1]]() == 9
    with pytest.raises(RecordingError, match='1 is none'):
        ends[tasks[0]]()


def test_the_task_of_a_killed_worker_is_run_again(tmp_path):
    tasks = [Work('dies', die, (tmp_path, 1)), Work('other', square, (3,))]
    ends = {task.name: get() for task, get in run_tasks(tasks, Engine(workers=2))}
    assert ends['dies'] >= 2 and ends['other'] == 9


def test_a_task_that_kills_every_worker_is_given_up(tmp_path):
    (_, get), = run_tasks([Work('dies', die, (tmp_path, 100))], Engine(workers=1))
    with pytest.raises(EngineError, match=f'dies: its worker process was killed {TRIES} times'):
        get()
    assert len(list(tmp_path.iterdir())) == TRIES


def test_after_a_stop_no_task_begins():
    begun = []
    tasks = [Work(str(i), square, (i,)) for i in range(9)]
    for task, _ in run_tasks(tasks, Engine(workers=1), stop=lambda: len(begun) == 2):
        begun.append(task.name)
    assert begun == ['0', '1']


def hear_interrupts():
    signal.signal(signal.SIGINT, signal.SIG_DFL)  # a shell's background jobs ignore them


def test_an_interrupted_run_leaves_no_worker(tmp_path):
    script = ('import sys; sys.path[:0] = [sys.argv[2], sys.argv[2] + "/test/engines"]\n'
              'from test_engines import write_slowly\n'
              'from tap_ros.engines.task import Engine, run_tasks, Work\n'
              'if __name__ == "__main__":\n'
              '    list(run_tasks([Work("slow", write_slowly, (sys.argv[1], 300.0))], Engine()))')
    (tmp_path / 'script.py').write_text(script)
    path = tmp_path / 'file'
    process = subprocess.Popen([sys.executable, tmp_path / 'script.py', path, ROOT],
                               stderr=subprocess.PIPE, preexec_fn=hear_interrupts)
    while not (begun := list(tmp_path.glob('file.*'))) and process.poll() is None:
        time.sleep(0.05)
    process.send_signal(signal.SIGINT)
    assert b'KeyboardInterrupt' in process.communicate(timeout=60)[1]
    worker = Path('/proc', begun[0].suffix[1:])
    patience = time.monotonic() + 20
    while worker.exists() and time.monotonic() < patience:
        time.sleep(0.05)
    assert not worker.exists() and not path.exists()


@pytest.mark.parametrize('engine, named', [
    (('slurm',), 'engine: expected one of local, ray'), (('local', -1), 'workers'),
    (('local', 0, 'auto'), 'is for --engine ray')])
def test_bad_engines_are_refused(engine, named):
    with pytest.raises(ConfigError, match=named):
        Engine(*engine)


@pytest.fixture(scope='module')
def cluster():
    """Start Ray with two nodes beside the head, which runs no task."""
    ray = pytest.importorskip('ray')
    from ray.cluster_utils import Cluster
    before = os.environ.get('PYTHONPATH')
    os.environ['PYTHONPATH'] = os.pathsep.join([str(ROOT), str(ROOT / 'test')])
    cluster = Cluster(initialize_head=True, head_node_args={'num_cpus': 0})
    cluster.workers = [cluster.add_node(num_cpus=1) for _ in range(2)]
    cluster.wait_for_nodes()
    yield cluster
    ray.shutdown()
    cluster.shutdown()
    os.environ.pop('PYTHONPATH')
    if before is not None:
        os.environ['PYTHONPATH'] = before


@pytest.mark.slow
def test_ray_gives_what_the_pool_gives(cluster):
    engine = Engine('ray', address=cluster.address)
    assert numbers(engine) == numbers(Engine())
    (_, get), = run_tasks([Work('bad', refuse, (1,))], engine)
    with pytest.raises(RecordingError, match='1 is none'):
        get()


@pytest.mark.slow
def test_the_tasks_of_a_node_that_dies_run_on_another(cluster, tmp_path):
    engine = Engine('ray', address=cluster.address)
    tasks = [Work(str(i), write_slowly, (tmp_path / f'file{i}', 3.0)) for i in range(4)]
    for _, get in run_tasks(tasks, engine):
        get()
        if len(cluster.workers) == 2:
            patience = time.monotonic() + 60
            while len(list(tmp_path.glob('*.*'))) < 4 and time.monotonic() < patience:
                time.sleep(0.02)  # until each node has begun another task
            cluster.remove_node(cluster.workers.pop(), allow_graceful=False)
    files = {path.name: path.read_text() for path in tmp_path.iterdir() if not path.suffix}
    assert files == {f'file{i}': f'file{i}' for i in range(4)}
    assert len(list(tmp_path.glob('*.*'))) > 4  # one was begun twice


@pytest.mark.slow
def test_a_cluster_that_is_not_there_is_named():
    pytest.importorskip('ray')
    with pytest.raises(ConfigError, match='does not answer at 127.0.0.1:1'):
        list(run_tasks([Work('a', square, (1,))], Engine('ray', address='127.0.0.1:1')))
