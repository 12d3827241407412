# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Run many independent tasks, in processes of this machine or on a Ray cluster.

A task is a function of a module and its arguments. It must be idempotent: it leaves whole files or
returns a value, and gives the same when it is run again, since the task of a worker that was
killed runs again. Which tasks are done already, and so are left out, their caller says.
"""

from collections import Counter, deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
import logging
from math import inf
import multiprocessing
from multiprocessing import connection
import os
from pathlib import Path
import signal
import socket
import sys
import threading
from types import ModuleType
from typing import Annotated, Any, Literal, TypeAlias

from tap_ros.base.errors import check_fields, ConfigError, EngineError
from tap_ros.base.options import default_text
from tap_ros.base.text import escaped
from tyro import conf

TRIES = 3  # of a task whose worker is killed


@dataclass(frozen=True)
class Engine:
    """
    Where tasks run.

    :param name: local: processes of this machine; ray: Ray, which needs `pip install ray`.
    :param workers: tasks at a time, a process each; 0: one a core, of the cluster with an address.
    :param address: of a Ray cluster to join, such as 'auto' or '10.0.0.1:6379'; empty: Ray is
        started on this machine. Its machines need this package in the same place, and the folders
        that tasks write to.
    """

    name: Annotated[Literal['local', 'ray'], conf.arg(name='engine')] = 'local'
    workers: Annotated[int, conf.arg(aliases=('--jobs',), metavar='N')] = 0
    address: Annotated[str, conf.arg(metavar='HOST:PORT', help_behavior_hint=default_text)] = ''

    def __post_init__(self) -> None:
        """Raise ConfigError for options that do not fit."""
        check_fields(self, {'workers': (0, inf)})
        if self.address and self.name != 'ray':
            raise ConfigError(f'address: {self.address!r} is for --engine ray')


LOCAL = Engine()


@dataclass(frozen=True)
class Work:
    """
    One of many tasks.

    :param name: for messages.
    :param function: of a module, called in a worker.
    :param args: its arguments; they and what it returns are pickled.
    """

    name: str
    function: Callable[..., Any]
    args: tuple[Any, ...] = ()


# What begins a task, how many it takes at a time, and the errors of one whose worker died.
Workers: TypeAlias = tuple[Callable[[Work], 'Future[Any]'], int, tuple[type[Exception], ...]]


def run_tasks(tasks: Iterable[Work], engine: Engine = LOCAL,
              script: bool = True) -> Iterator[tuple[Work, Callable[[], Any]]]:
    """
    Run tasks, in their order as far as there are workers.

    :param tasks: iterable of Work.
    :param engine: Engine.
    :param script: whether workers of this machine import the script that is run, which runs what
        it does not guard by its __name__; they need it where it defines what tasks are made of.
    :return: generator of (Work, get), in the order in which they end: get() returns what the
        task returned, or raises what it raised. Tasks in progress are ended where the generator
        is closed or interrupted.
    :raises ConfigError: where Ray is asked for and not installed, or does not answer.
    :raises EngineError: by get, when workers were killed TRIES times while the task ran.
    """
    waiting, running = deque(tasks), dict[Future[Any], Work]()
    lost: Counter[int] = Counter()  # by id of a Work
    if not waiting:
        return
    workers = _ray(engine) if engine.name == 'ray' else _pool(engine, script)
    with workers as (begin, room, died):
        while waiting or running:
            while waiting and len(running) < room:
                task = waiting.popleft()
                running[begin(task)] = task
            for future in wait(running, return_when=FIRST_COMPLETED).done:
                task = running.pop(future)
                if isinstance(future.exception(), died):
                    lost[id(task)] += 1
                    if lost[id(task)] < TRIES:
                        waiting.appendleft(task)
                        continue
                    future = Future()
                    future.set_exception(EngineError(
                        f'{task.name}: its worker process was killed {TRIES} times, perhaps for '
                        'want of memory; start again with fewer workers: what is done is kept'))
                yield task, partial(_result, future)


def _result(future: 'Future[Any]') -> Any:
    """Return what a task returned, or raise what it raised; Ray wraps that."""
    if error := future.exception():
        raise getattr(error, 'cause', error)
    return future.result()


@contextmanager
def _pool(engine: Engine, script: bool) -> Iterator[Workers]:
    """Start processes; new ones where a worker was killed."""
    room = engine.workers or len(os.sched_getaffinity(0))
    start = partial(
        ProcessPoolExecutor, room, multiprocessing.get_context('spawn'), _start_worker)
    pool = start()

    def begin(task: Work) -> 'Future[Any]':
        nonlocal pool
        # A terminal sends Ctrl-C to processes that begin here, too: they ignore it.
        alone = threading.current_thread() is threading.main_thread()
        before = signal.signal(signal.SIGINT, signal.SIG_IGN) if alone else None
        main = sys.modules['__main__']
        if not script:
            sys.modules['__main__'] = ModuleType('__main__')  # processes that begin look there
        try:
            return pool.submit(task.function, *task.args)
        except BrokenProcessPool:
            pool.shutdown(cancel_futures=True)
            pool = start()
            return pool.submit(task.function, *task.args)
        finally:
            sys.modules['__main__'] = main
            if alone:
                signal.signal(signal.SIGINT, before)

    try:
        yield begin, room, (BrokenProcessPool,)
    except BaseException:
        for process in list((pool._processes or {}).values()):
            process.terminate()  # tasks are idempotent: what is in progress may be lost
        raise
    finally:
        pool.shutdown(cancel_futures=True)


def _start_worker() -> None:
    """
    Let a worker end with its parent alone.

    Who holds the lock of a folder is the only one to write there, so it must not outlive it.
    """
    def end() -> None:
        parent = multiprocessing.parent_process()
        assert parent is not None, 'a worker has one'
        connection.wait([parent.sentinel])
        os._exit(1)
    threading.Thread(target=end, daemon=True).start()


@contextmanager
def _ray(engine: Engine) -> Iterator[Workers]:
    """Join a Ray cluster, or start one on this machine."""
    try:
        import ray
        from ray import exceptions
    except ImportError as error:
        raise ConfigError('engine: Ray is not installed; type `pip install ray`, or '
                          'choose --engine local') from error
    place = {'address': engine.address} if engine.address else {
        'address': 'local',  # not one that happens to run here
        'num_cpus': engine.workers or len(os.sched_getaffinity(0)), 'include_dashboard': False}
    checkout = str(Path(__file__).resolve().parents[2])
    modules = os.pathsep.join(dict.fromkeys([checkout, *filter(None, sys.path)]))
    host, _, port = engine.address.rpartition(':')
    try:
        if host:  # Ray itself tries for minutes
            socket.create_connection((host, int(port)), timeout=5).close()
        ray.init(log_to_driver=False, logging_level=logging.ERROR,
                 runtime_env={'env_vars': {'PYTHONPATH': modules}}, **place)
    except (OSError, RuntimeError, ValueError) as error:
        raise ConfigError(
            f'engine: Ray does not answer at {engine.address or "this machine"} '
            f'({escaped(error)}); start it with `ray start`, or correct --address') from error
    room = engine.workers or 2 * int(ray.cluster_resources().get('CPU', 1))
    remote: Any = ray.remote(num_cpus=1, max_retries=0)(lambda function, args: function(*args))
    try:
        yield (lambda task: remote.remote(task.function, task.args).future()), room, (
            exceptions.WorkerCrashedError, exceptions.NodeDiedError, exceptions.OutOfMemoryError,
            exceptions.ObjectLostError)
    finally:
        ray.shutdown()  # ends the tasks in progress, too
