# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Requests that wait, and are answered together."""

from collections import deque
from collections.abc import Callable, Iterable
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
    Answer requests in batches; every request is answered exactly once.

    :param work: called with a list of requests that waited, oldest first; returns their answers
        in the same order. If it fails for a batch, each request is tried alone, so that only those
        get an error that cause it.
    :param cost: called with a request; how much of a batch it takes.
    :param max_waiting: most requests that wait; what comes beyond is refused at once.
    :param max_together: most requests in one batch.
    :param max_cost: most cost in one batch; a request that takes more goes alone.
    """

    def __init__(self, work: Callable[[list[Request]], Iterable[Answer]],
                 cost: Callable[[Request], float], max_waiting: int, max_together: int,
                 max_cost: float) -> None:
        self._work, self._cost, self._max_waiting = work, cost, max_waiting
        self._max_together, self._max_cost = max_together, max_cost
        self._waiting: deque[tuple[Request, Callable[[Answer | Exception], object]]] = deque()
        self._lock, self._running = threading.Lock(), threading.Lock()
        self._closed = ''  # why

    def __len__(self) -> int:
        """Return how many requests wait."""
        return len(self._waiting)

    def put(self, request: Request, answer: Callable[[Answer | Exception], object]) -> None:
        """
        Let a request wait for its answer.

        :param request: what the work takes.
        :param answer: called once, by answer_batch or close, with what the work returned for the
            request, or with the exception that it raised. What it raises itself is printed.
        :raises Busy: when it cannot wait; `answer` is not called then.
        """
        with self._lock:
            if self._closed:
                raise Busy(f'busy: {self._closed}')
            if len(self._waiting) >= self._max_waiting:
                raise Busy(f'busy: {len(self._waiting)} requests are waiting, which is the most '
                           'that may; ask again')
            self._waiting.append((request, answer))

    def close(self, reason: str = 'the node is ending; ask again when it is back') -> None:
        """Answer what still waits with Busy, for this reason; return after the running batch."""
        with self._lock:
            self._closed = reason
            left = list(self._waiting)
            self._waiting.clear()
        for _, answer in left:
            answer(Busy(f'busy: {reason}'))
        with self._running:
            pass

    def answer_batch(self) -> bool:
        """Answer the oldest requests, as many as go together; return whether others wait."""
        with self._running:
            self._answer_batch()
        return bool(self._waiting)

    def _answer_batch(self) -> None:
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
