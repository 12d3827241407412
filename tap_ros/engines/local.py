# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""A pool of processes on this machine."""

from concurrent.futures import FIRST_COMPLETED, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
import multiprocessing
from multiprocessing import connection
import os
import signal
import threading
from typing import Any, Self

from tap_ros.engines.task import call, Ended, Engine, lost, POLL_S, raising, TRIES, Work


class LocalWorkers:
    """A pool of processes; a new one where a worker was killed."""

    def __init__(self, engine: Engine, count: int) -> None:
        self.room = min(engine.workers or len(os.sched_getaffinity(0)), count)
        self.running: dict[Any, Work] = {}  # by Future
        self._lost: dict[int, int] = {}  # id of a Work to how often it was in a pool that broke

    def __enter__(self) -> Self:
        self._pool = ProcessPoolExecutor(
            self.room, multiprocessing.get_context('spawn'), _start_worker)
        return self

    def __exit__(self, kind: object, *_: object) -> None:
        processes = list((self._pool._processes or {}).values()) if self.running or kind else []
        for process in processes:  # tasks are idempotent: what is in progress may be lost
            process.terminate()
        self._pool.shutdown(cancel_futures=True)

    def begin(self, task: Work) -> None:
        try:
            future = self._pool.submit(call, task.function, task.args)
        except BrokenProcessPool:
            self._renew()
            future = self._pool.submit(call, task.function, task.args)
        self.running[future] = task

    def ended(self) -> Ended:
        done, _ = wait(self.running, timeout=POLL_S, return_when=FIRST_COMPLETED)
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
                yield task, raising(lost(task))
        for task in again:
            self.begin(task)

    def _renew(self) -> None:
        self._pool.shutdown(cancel_futures=True)
        self.__enter__()


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
