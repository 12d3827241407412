# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Run many independent tasks on an engine."""

from collections import deque
from collections.abc import Callable, Iterable

from tap_ros.engines.local import LocalWorkers
from tap_ros.engines.ray_cluster import RayWorkers
from tap_ros.engines.task import Ended, Engine, LOCAL, Task, Workers

WORKERS: dict[str, Callable[[Engine, int], Workers]] = {'local': LocalWorkers, 'ray': RayWorkers}


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
    with WORKERS[engine.name](engine, len(waiting)) as workers:
        while waiting or workers.running:
            while waiting and len(workers.running) < workers.room and not stop():
                workers.begin(waiting.popleft())
            if not workers.running:
                return
            yield from workers.ended()
            tick()
