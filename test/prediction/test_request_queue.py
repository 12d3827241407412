# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Laws of the queue of requests: each is answered once, whatever happens to the others."""

from concurrent.futures import ThreadPoolExecutor
import threading

import pytest
from tap_ros.nodes.predictor.request_queue import Busy, RequestQueue

TIMEOUT = 20.0


class Rig:
    """A queue whose work waits until it is let go, and what was answered."""

    def __init__(self, work=lambda batch: [-one for one in batch], cost=lambda one: 1, **limits):
        self.batches, self.answers = [], []
        self.begun, self.go = threading.Semaphore(0), threading.Event()
        self._answered = threading.Condition()

        def slow(batch):
            self.batches.append(list(batch))
            self.begun.release()
            assert self.go.wait(TIMEOUT)
            return work(batch)

        self.queue = RequestQueue(
            slow, cost, **{'max_waiting': 100, 'max_together': 8, 'max_cost': 100, **limits})
        self.thread = ThreadPoolExecutor(1)

    def put(self, one):
        self.queue.put(one, lambda found: self._note(one, found))
        self.thread.submit(self.queue.answer_batch)

    def _note(self, one, found):
        with self._answered:
            self.answers.append((one, found))
            self._answered.notify()

    def wait(self, count):
        with self._answered:
            assert self._answered.wait_for(lambda: len(self.answers) >= count, TIMEOUT)
        return dict(self.answers)

    def hold(self):
        """Occupy the thread with a request of its own, so that all others wait."""
        self.put(0)
        assert self.begun.acquire(timeout=TIMEOUT)


@pytest.fixture
def made():
    """Make rigs, and end them with the test."""
    rigs = []

    def make(*args, **limits):
        rigs.append(Rig(*args, **limits))
        return rigs[-1]

    yield make
    for rig in rigs:
        rig.go.set()
        rig.queue.close()
        rig.thread.shutdown()


def test_an_error_reaches_only_who_caused_it(made):
    for bad in ({3}, {1, 5}, {1, 2, 3, 4, 5}):
        def work(batch, bad=bad):
            if bad & set(batch):
                raise MemoryError(f'{bad & set(batch)}')
            return [-one for one in batch]

        rig = made(work)
        rig.hold()
        for one in range(1, 6):
            rig.put(one)
        rig.go.set()
        found = rig.wait(6)
        assert len(rig.answers) == 6
        for one in range(1, 6):
            assert str(found[one]) == (str({one}) if one in bad else str(-one))
            assert isinstance(found[one], MemoryError) == (one in bad)


def test_at_the_end_all_that_wait_are_told_and_the_batch_is_finished(made):
    rig = made()
    rig.hold()
    for one in range(1, 4):
        rig.put(one)
    ending = threading.Thread(target=rig.queue.close)
    ending.start()
    found = rig.wait(3)  # at once, while the batch is in progress
    assert all(isinstance(found[one], Busy) for one in (1, 2, 3)) and 0 not in found
    with pytest.raises(Busy, match='ending'):
        rig.put(4)
    rig.go.set()
    ending.join(TIMEOUT)
    assert not ending.is_alive()
    assert rig.wait(4)[0] == 0 and len(rig.answers) == 4


def test_work_that_answers_too_few_leaves_nobody_without_an_answer(made):
    rig = made(lambda batch: [-one for one in batch][:1])
    rig.hold()
    for one in (1, 2, 3):
        rig.put(one)
    rig.go.set()
    assert rig.wait(4) == {0: 0, 1: -1, 2: -2, 3: -3}  # each alone
    rig = made(lambda batch: [])
    rig.go.set()
    rig.put(1)
    assert '0 answers to 1 requests' in str(rig.wait(1)[1])


def test_what_goes_together_is_answered_at_once_and_then_the_rest():
    found = []
    queue = RequestQueue(lambda batch: batch, lambda one: 1, 100, 8, 100)
    for one in range(9):
        queue.put(one, found.append)
    assert queue.answer_batch() and found == list(range(8))
    assert not queue.answer_batch() and found == list(range(9))
