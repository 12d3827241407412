# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Run many independent tasks: in processes of this machine, or on a Ray cluster.

A task is a function of a module and its arguments. It must be idempotent: it leaves whole files or
returns a value, and gives the same when it is run again, since the task of a worker that was
killed runs again. Which tasks are done already, and so are left out, their caller says.
"""

from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass
import multiprocessing
from multiprocessing import connection
import os
from pathlib import Path
import signal
import socket
import sys
import threading
from typing import Any, get_args, Literal, NoReturn, Self

from tap_ros.errors import ConfigError, EngineError
from tap_ros.text import escaped

EngineName = Literal['local', 'ray']
ENGINES = get_args(EngineName)
TRIES = 3  # of a task whose worker is killed
_POLL_S = 0.5
_PRESENT = 2  # tasks that a Ray cluster has for each of its cores


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

    name: EngineName = 'local'
    workers: int = 0
    address: str = ''

    def __post_init__(self) -> None:
        """Refuse an engine that there is not."""
        if self.name not in ENGINES:
            raise ConfigError(f'engine: expected one of {", ".join(ENGINES)}, got {self.name!r}')
        if self.workers < 0:
            raise ConfigError(f'workers: expected 0 or more, got {self.workers}')
        if self.address and self.name != 'ray':
            raise ConfigError(f'address: {self.address!r} is for --engine ray')


LOCAL = Engine()


@dataclass(frozen=True)
class Task:
    """
    One of many tasks.

    :param name: for messages.
    :param function: of a module, called in a worker.
    :param args: its arguments; they and what it returns are pickled.
    """

    name: str
    function: Callable[..., Any]
    args: tuple[Any, ...] = ()


Ended = Iterator[tuple[Task, Callable[[], Any]]]  # see run_tasks


def run_tasks(
        tasks: Iterable[Task], engine: Engine = LOCAL, stop: Callable[[], bool] = lambda: False,
        tick: Callable[[], object] = lambda: None) -> Ended:
    """
    Run tasks, in their order as far as there are workers.

    :param tasks: iterable of Task.
    :param engine: Engine.
    :param stop: asked before each task; once it says True, no other begins.
    :param tick: called about twice a second meanwhile.
    :return: generator of (Task, get), in the order in which they end: get() returns what the
        task returned, or raises what it raised. Tasks in progress are ended where the generator
        is closed or interrupted.
    :raises ConfigError: where Ray is asked for and not installed, or does not answer.
    :raises EngineError: by get, when workers were killed TRIES times while the task ran.
    """
    waiting = deque(tasks)
    if not waiting:
        return
    with _WORKERS[engine.name](engine, len(waiting)) as workers:
        while waiting or workers.running:
            while waiting and len(workers.running) < workers.room and not stop():
                workers.begin(waiting.popleft())
            if not workers.running:
                return
            yield from workers.ended()
            tick()


class _LocalWorkers:
    """A pool of processes; a new one where a worker was killed."""

    def __init__(self, engine: Engine, count: int) -> None:
        self.room = min(engine.workers or len(os.sched_getaffinity(0)), count)
        self.running: dict[Future[Any], Task] = {}
        self._lost: dict[int, int] = {}  # id of a Task to how often it was in a pool that broke

    def __enter__(self) -> Self:
        self._pool = ProcessPoolExecutor(
            self.room, multiprocessing.get_context('spawn'), _start_worker)
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        processes = list((self._pool._processes or {}).values()) if self.running or kind else []
        for process in processes:  # tasks are idempotent: what is in progress may be lost
            process.terminate()
        self._pool.shutdown(cancel_futures=True)

    def begin(self, task: Task) -> None:
        try:
            future = self._pool.submit(_call, task.function, task.args)
        except BrokenProcessPool:
            self._renew()
            future = self._pool.submit(_call, task.function, task.args)
        self.running[future] = task

    def ended(self) -> Ended:
        done, _ = wait(self.running, timeout=_POLL_S, return_when=FIRST_COMPLETED)
        again = []
        for future in done:
            task = self.running.pop(future)
            if not isinstance(future.exception(), BrokenProcessPool):
                yield task, future.result
                continue
            self._lost[id(task)] = self._lost.get(id(task), 0) + 1
            if self._lost[id(task)] < TRIES:
                again.append(task)
            else:
                yield task, _raising(_lost(task))
        for task in again:
            self.begin(task)

    def _renew(self) -> None:
        self._pool.shutdown(cancel_futures=True)
        self.__enter__()


class _RayWorkers:
    """Ray Core, which runs the task of a worker or machine that died on another one."""

    def __init__(self, engine: Engine, count: int) -> None:
        try:
            import ray
        except ImportError as error:
            raise ConfigError('engine: Ray is not installed; type `pip install ray`, or choose '
                              '--engine local') from error
        self._ray, self._engine, self._count = ray, engine, count
        self.running: dict[Any, Task] = {}  # by reference

    def __enter__(self) -> Self:
        ray, engine = self._ray, self._engine
        _check_answers(engine.address)
        options = {'address': engine.address} if engine.address else {
            'num_cpus': engine.workers or len(os.sched_getaffinity(0)),
            'include_dashboard': False}
        try:
            ray.init(log_to_driver=False, logging_level='ERROR',
                     runtime_env={'env_vars': _environment()}, **options)
        except (OSError, RuntimeError, ValueError) as error:
            raise _no_answer(engine.address, error) from error
        cores = int(ray.cluster_resources().get('CPU', 1))
        self.room = min(engine.workers or _PRESENT * cores, self._count)
        self._call = ray.remote(num_cpus=1, max_retries=TRIES - 1)(_call)
        return self

    def __exit__(self, *_: object) -> None:
        for reference in self.running:
            self._ray.cancel(reference, force=True)
        self._ray.shutdown()

    def begin(self, task: Task) -> None:
        self.running[self._call.remote(task.function, task.args)] = task

    def ended(self) -> Ended:
        done, _ = self._ray.wait(list(self.running), timeout=_POLL_S)
        for reference in done:
            task = self.running.pop(reference)
            yield task, self._get(reference, task)

    def _get(self, reference: Any, task: Task) -> Callable[[], Any]:
        """Fetch a result now, as there is none once Ray is shut down."""
        errors = self._ray.exceptions
        try:
            value = self._ray.get(reference)
            return lambda: value
        except errors.RayTaskError as error:
            return _raising(error.cause)
        except (errors.WorkerCrashedError, errors.NodeDiedError, errors.OutOfMemoryError):
            return _raising(_lost(task))


_WORKERS: dict[str, type[_LocalWorkers] | type[_RayWorkers]] = {
    'local': _LocalWorkers, 'ray': _RayWorkers}


def _call(function: Callable[..., Any], args: tuple[Any, ...]) -> Any:
    return function(*args)


def _raising(error: BaseException) -> Callable[[], NoReturn]:
    """Return a function that raises an error."""
    def get() -> NoReturn:
        raise error
    return get


def _lost(task: Task) -> EngineError:
    return EngineError(f'{task.name}: its worker process was killed {TRIES} times, perhaps for '
                       'want of memory; start again with fewer workers: what is done is kept')


def _check_answers(address: str) -> None:
    """Refuse a cluster that is not there at once; Ray itself tries for minutes."""
    host, _, port = address.rpartition(':')
    if host and port.isdigit():
        try:
            socket.create_connection((host, int(port)), timeout=5).close()
        except OSError as error:
            raise _no_answer(address, error) from error


def _no_answer(address: str, error: Exception) -> ConfigError:
    return ConfigError(f'engine: Ray does not answer at {address or "this machine"} '
                       f'({escaped(error)}); start it with `ray start`, or correct --address')


def _start_worker() -> None:
    """
    Let a worker end with its parent alone.

    Who holds the lock of a folder is the only one to write there, so it must not outlive it; what
    a terminal sends to both is the parent's to handle.
    """
    def end() -> None:
        parent = multiprocessing.parent_process()
        assert parent is not None, 'a worker has one'
        connection.wait([parent.sentinel])
        os._exit(1)
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=end, daemon=True).start()


def _environment() -> dict[str, str]:
    """Return what workers need of this process's environment: where modules are."""
    checkout = str(Path(__file__).resolve().parents[1])
    places = [checkout, *(place for place in sys.path if place)]
    return {'PYTHONPATH': os.pathsep.join(dict.fromkeys(places))}
