# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Run many independent tasks on an engine.

A task is a function of a module and its arguments. It must be idempotent: it leaves whole files or
returns a value, and gives the same when it is run again, since the task of a worker that was
killed runs again. Which tasks are done already, and so are left out, their caller says.
"""

from collections import deque
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from typing import Any, get_args, Literal, NoReturn, Protocol, Self

from tap_ros.errors import ConfigError, EngineError

EngineName = Literal['local', 'ray']
ENGINES = get_args(EngineName)
TRIES = 3  # of a task whose worker is killed
POLL_S = 0.5


@dataclass(frozen=True)
class Engine:
    """
    Where tasks run.

    :param name: local: processes of this machine; ray: Ray, which needs `pip install '.[ray]'`.
    :param workers: tasks at a time, a process each; 0: one a core, of the cluster with an address.
    :param address: of a Ray cluster to join, such as 'auto' or '10.0.0.1:6379'; empty: Ray is
        started on this machine. Its machines need this package in the same place, and the folders
        that tasks write to.
    """

    name: EngineName = 'local'
    workers: int = 0
    address: str = ''

    def __post_init__(self) -> None:
        """Raise ConfigError for an unknown engine, or options that do not fit it."""
        if self.name not in ENGINES:
            raise ConfigError(f'engine: expected one of {", ".join(ENGINES)}, got {self.name!r}')
        if self.workers < 0:
            raise ConfigError(f'workers: expected 0 or more, got {self.workers}')
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


Ended = Iterator[tuple[Work, Callable[[], Any]]]  # see run_tasks


class Workers(Protocol):
    """
    What runs the tasks of an engine, for a with-block.

    :ivar room: how many tasks it takes at a time.
    :ivar running: a task for each handle of one that has begun and not ended.
    """

    room: int
    running: dict[Any, Work]

    def __enter__(self) -> Self:
        """Start the workers."""

    def __exit__(self, kind: object, error: object, traceback: object, /) -> None:
        """End them, and the tasks in progress."""

    def begin(self, task: Work) -> None:
        """Begin a task."""

    def ended(self) -> Ended:
        """Wait for POLL_S at most; yield the tasks that have ended, as run_tasks does."""


def call(function: Callable[..., Any], args: tuple[Any, ...]) -> Any:
    return function(*args)


def raising(error: BaseException) -> Callable[[], NoReturn]:
    """Return a function that raises an error."""
    def get() -> NoReturn:
        raise error
    return get


def lost(task: Work) -> EngineError:
    return EngineError(f'{task.name}: its worker process was killed {TRIES} times, perhaps for '
                       'want of memory; start again with fewer workers: what is done is kept')


def run_tasks(
        tasks: Iterable[Work], engine: Engine = LOCAL, stop: Callable[[], bool] = lambda: False,
        tick: Callable[[], object] = lambda: None) -> Ended:
    """
    Run tasks, in their order as far as there are workers.

    :param tasks: iterable of Work.
    :param engine: Engine.
    :param stop: asked before each task; once it says True, no other begins.
    :param tick: called about twice a second meanwhile.
    :return: generator of (Work, get), in the order in which they end: get() returns what the
        task returned, or raises what it raised. Tasks in progress are ended where the generator
        is closed or interrupted.
    :raises ConfigError: where Ray is asked for and not installed, or does not answer.
    :raises EngineError: by get, when workers were killed TRIES times while the task ran.
    """
    waiting = deque(tasks)
    if not waiting:
        return
    with _workers(engine, len(waiting)) as workers:
        while waiting or workers.running:
            while waiting and len(workers.running) < workers.room and not stop():
                workers.begin(waiting.popleft())
            if not workers.running:
                return
            yield from workers.ended()
            tick()


def _workers(engine: Engine, count: int) -> Workers:
    """Return what runs so many tasks; Ray is imported only when it is asked for."""
    if engine.name == 'ray':
        from tap_ros.engines.ray_cluster import RayWorkers
        return RayWorkers(engine, count)
    from tap_ros.engines.local import LocalWorkers
    return LocalWorkers(engine, count)
