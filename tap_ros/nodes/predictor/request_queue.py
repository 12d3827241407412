# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Requests that wait, and the thread that answers what waits together."""

from collections import deque
from collections.abc import Callable, Iterable
from concurrent.futures import Future
import threading
import traceback
from typing import Generic, TypeVar

from tap_ros.errors import TapError

Request = TypeVar('Request')
Answer = TypeVar('Answer')

THREAD_NAME = 'request queue'
PREPARE_TIMEOUT = 8.0  # s that an interrupted start waits for what it was preparing


class Busy(TapError):
    """A request cannot wait: too many do already, or nobody answers any more."""


class RequestQueue(Generic[Request, Answer]):
    """
    Answer requests in batches, in a thread of its own; every request is answered exactly once.

    :param prepare: called first, in the thread, and waited for. It returns the work: a function
        that is called in the same thread with a list of requests that waited, oldest first, and
        returns their answers in the same order. Where it fails for several, each is tried alone,
        so that an error reaches nobody but who caused it.
    :param cost: called with a request; how much of a batch it takes.
    :param max_waiting: most requests that wait; what comes beyond is refused at once.
    :param max_together: most requests in one batch.
    :param max_cost: most cost in one batch; a request that takes more goes alone.
    :raises Exception: what `prepare` raises.
    """

    def __init__(self, prepare: Callable[[], Callable[[list[Request]], Iterable[Answer]]],
                 cost: Callable[[Request], float], max_waiting: int, max_together: int,
                 max_cost: float) -> None:
        self._cost = cost
        self._max_waiting = max_waiting
        self._max_together, self._max_cost = max_together, max_cost
        self._waiting: deque[tuple[Request, Callable[[Answer | Exception], object]]] = deque()
        self._changed = threading.Condition()
        self._ending = False
        self._reason = ''  # why
        prepared: Future[None] = Future()
        self._thread = threading.Thread(
            target=self._run, args=(prepare, prepared), name=THREAD_NAME, daemon=True)
        try:
            self._thread.start()
            prepared.result()
        except BaseException:
            # Interrupted: Python would abort if it ended while this thread is in C++.
            with self._changed:
                self._ending = True
            if self._thread.is_alive():
                self._thread.join(PREPARE_TIMEOUT)
            raise

    def __len__(self) -> int:
        """Return how many requests wait."""
        return len(self._waiting)

    def put(self, request: Request, answer: Callable[[Answer | Exception], object]) -> None:
        """
        Let a request wait for its answer.

        :param request: what `work` takes.
        :param answer: called once, in another thread, with what `work` returned for the request,
            or with the exception that it raised. What it raises itself is printed.
        :raises Busy: when it cannot wait; `answer` is not called then.
        """
        with self._changed:
            if self._ending:
                raise Busy(f'busy: {self._reason}')
            if len(self._waiting) >= self._max_waiting:
                raise Busy(f'busy: {len(self._waiting)} requests are waiting, which is the most '
                           'that may; ask again')
            self._waiting.append((request, answer))
            self._changed.notify()

    def close(self, timeout_s: float,
              reason: str = 'the node is ending; ask again when it is back') -> None:
        """
        Answer what still waits with Busy, and end the thread after its batch.

        :param timeout_s: most seconds to wait for that batch.
        :param reason: what those are told who wait or come later.
        """
        with self._changed:
            self._ending, self._reason = True, reason
            left = list(self._waiting)
            self._waiting.clear()
            self._changed.notify()
        for _, answer in left:
            answer(Busy(f'busy: {reason}'))
        self._thread.join(timeout_s)

    def _run(self, prepare: Callable[[], Callable[[list[Request]], Iterable[Answer]]],
             prepared: Future[None]) -> None:
        try:
            self._work = prepare()
        except BaseException as error:
            prepared.set_exception(error)
            return
        prepared.set_result(None)
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._waiting or self._ending)
                if self._ending:
                    return
                batch = self._take()
            for (_, answer), found in zip(batch, self._answers([one for one, _ in batch])):
                try:
                    answer(found)
                except Exception:  # else all that wait would wait for ever
                    traceback.print_exc()

    def _take(self) -> list[tuple[Request, Callable[[Answer | Exception], object]]]:
        """Take the oldest requests, as many as go together."""
        batch: list[tuple[Request, Callable[[Answer | Exception], object]]] = []
        cost = 0.0
        while self._waiting and len(batch) < self._max_together:
            cost += self._cost(self._waiting[0][0])
            if batch and cost > self._max_cost:
                break
            batch.append(self._waiting.popleft())
        return batch

    def _answers(self, requests: list[Request]) -> Iterable[Answer | Exception]:
        """Yield the answers of a batch, in its order; an exception stands for one that failed."""
        try:
            found = self._work(requests)
        except Exception as error:
            if len(requests) == 1:
                return [error]
            return (answer for one in requests for answer in self._answers([one]))
        return found
