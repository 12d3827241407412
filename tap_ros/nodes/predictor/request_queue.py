# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Requests that wait, and the thread that answers what waits together."""

from collections import deque
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
import threading
import traceback
from typing import Generic, TypeVar

from tap_ros.base.errors import TapError

Request = TypeVar('Request')
Answer = TypeVar('Answer')


class Busy(TapError):
    """A request cannot wait: too many do already, or nobody answers any more."""


class RequestQueue(Generic[Request, Answer]):
    """
    Answer requests in batches, in a thread of its own; every request is answered exactly once.

    :param prepare: called first, in the thread, and waited for. It returns the work: a function
        that is called in the same thread with a list of requests that waited, oldest first, and
        returns their answers in the same order. If it fails for a batch, each request is tried
        alone, so that only those get an error that cause it.
    :param cost: called with a request; how much of a batch it takes.
    :param max_waiting: most requests that wait; what comes beyond is refused at once.
    :param max_together: most requests in one batch.
    :param max_cost: most cost in one batch; a request that takes more goes alone.
    :raises Exception: what `prepare` raises.
    """

    def __init__(self, prepare: Callable[[], Callable[[list[Request]], Iterable[Answer]]],
                 cost: Callable[[Request], float], max_waiting: int, max_together: int,
                 max_cost: float) -> None:
        self._cost, self._max_waiting = cost, max_waiting
        self._max_together, self._max_cost = max_together, max_cost
        self._waiting: deque[tuple[Request, Callable[[Answer | Exception], object]]] = deque()
        self._lock = threading.Lock()
        self._closed = ''  # why
        self._thread = ThreadPoolExecutor(1, 'request queue')
        try:
            self._work = self._thread.submit(prepare).result()
        except BaseException:
            # Interrupted: Python would abort if it ended while the thread is in C++.
            self._thread.shutdown()
            raise

    def __len__(self) -> int:
        """Return how many requests wait."""
        return len(self._waiting)

    def put(self, request: Request, answer: Callable[[Answer | Exception], object]) -> None:
        """
        Let a request wait for its answer.

        :param request: what the work takes.
        :param answer: called once, in another thread, with what the work returned for the request,
            or with the exception that it raised. What it raises itself is printed.
        :raises Busy: when it cannot wait; `answer` is not called then.
        """
        with self._lock:
            if self._closed:
                raise Busy(f'busy: {self._closed}')
            if len(self._waiting) >= self._max_waiting:
                raise Busy(f'busy: {len(self._waiting)} requests are waiting, which is the most '
                           'that may; ask again')
            self._waiting.append((request, answer))
            self._thread.submit(self._answer_batch)

    def close(self, reason: str = 'the node is ending; ask again when it is back') -> None:
        """Answer what still waits with Busy, for this reason; return after the running batch."""
        with self._lock:
            self._closed = reason
            left = list(self._waiting)
            self._waiting.clear()
        for _, answer in left:
            answer(Busy(f'busy: {reason}'))
        self._thread.shutdown()

    def _answer_batch(self) -> None:
        """Answer the oldest requests, as many as go together."""
        batch: list[tuple[Request, Callable[[Answer | Exception], object]]] = []
        cost = 0.0
        with self._lock:
            while self._waiting and len(batch) < self._max_together:
                cost += self._cost(self._waiting[0][0])
                if batch and cost > self._max_cost:
                    break
                batch.append(self._waiting.popleft())
        for (_, answer), found in zip(batch, self._answers([one for one, _ in batch])):
            try:
                answer(found)
            except Exception:
                traceback.print_exc()

    def _answers(self, requests: list[Request]) -> Iterable[Answer | Exception]:
        """Yield the answers of a batch, in its order; an exception stands for one that failed."""
        try:
            found = list(self._work(requests)) if requests else []
            if len(found) != len(requests):
                raise RuntimeError(f'{len(found)} answers to {len(requests)} requests')
            return found
        except Exception as error:
            if len(requests) == 1:
                return [error]
            return (answer for one in requests for answer in self._answers([one]))
