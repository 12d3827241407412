# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Ray, on this machine or on a cluster."""

from collections.abc import Callable
import os
from pathlib import Path
import socket
import sys
from typing import Any, Self

from tap_ros.engines.task import call, Ended, Engine, lost, POLL_S, raising, TRIES, Work
from tap_ros.errors import ConfigError
from tap_ros.text import escaped

_PRESENT = 2  # tasks that a Ray cluster has for each of its cores


class RayWorkers:
    """Ray Core, which runs the task of a worker or machine that died on another one."""

    def __init__(self, engine: Engine, count: int) -> None:
        try:
            import ray
        except ImportError as error:
            raise ConfigError("engine: Ray is not installed; type `pip install '.[ray]'`, or "
                              'choose --engine local') from error
        self._ray, self._engine, self._count = ray, engine, count
        self.running: dict[Any, Work] = {}  # by reference

    def __enter__(self) -> Self:
        ray, engine = self._ray, self._engine
        _check_answers(engine.address)
        options = {'address': engine.address} if engine.address else {
            'address': 'local',  # not one that happens to run here
            'num_cpus': engine.workers or len(os.sched_getaffinity(0)),
            'include_dashboard': False}
        try:
            ray.init(log_to_driver=False, logging_level='ERROR',
                     runtime_env={'env_vars': _environment()}, **options)
        except (OSError, RuntimeError, ValueError) as error:
            raise _no_answer(engine.address, error) from error
        cores = int(ray.cluster_resources().get('CPU', 1))
        self.room = min(engine.workers or _PRESENT * cores, self._count)
        self._call = ray.remote(num_cpus=1, max_retries=TRIES - 1)(call)
        return self

    def __exit__(self, *_: object) -> None:
        for reference in self.running:
            self._ray.cancel(reference, force=True)
        self._ray.shutdown()

    def begin(self, task: Work) -> None:
        self.running[self._call.remote(task.function, task.args)] = task

    def ended(self) -> Ended:
        done, _ = self._ray.wait(list(self.running), timeout=POLL_S)
        for reference in done:
            task = self.running.pop(reference)
            yield task, self._get(reference, task)

    def _get(self, reference: Any, task: Work) -> Callable[[], Any]:
        """Fetch a result now, as there is none once Ray is shut down."""
        errors = self._ray.exceptions
        try:
            value = self._ray.get(reference)
            return lambda: value
        except errors.RayTaskError as error:
            return raising(error.cause)
        except (errors.WorkerCrashedError, errors.NodeDiedError, errors.OutOfMemoryError):
            return raising(lost(task))


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


def _environment() -> dict[str, str]:
    """Return what workers need of this process's environment: where modules are."""
    checkout = str(Path(__file__).resolve().parents[2])
    places = [checkout, *(place for place in sys.path if place)]
    return {'PYTHONPATH': os.pathsep.join(dict.fromkeys(places))}
