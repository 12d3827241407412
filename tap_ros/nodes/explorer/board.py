# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What browsers are shown: the newest of each kind, and who is to be told of a change."""

from collections.abc import Callable
import threading


class Board:
    """
    Keeps the newest content of each kind; its methods may be called from any thread.

    Nothing is queued: who is slow misses what was replaced meanwhile, and gets the newest.
    """

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._contents: dict[str, tuple[int, str | bytes]] = {}  # kind -> (number, content)
        self._count = 0
        self._watchers: set[Callable[[], object]] = set()

    @property
    def watched(self) -> int:
        """How many are told of changes."""
        return len(self._watchers)

    def put(self, kind: str, content: str | bytes) -> None:
        """Replace the content of a kind; an equal one changes nothing."""
        with self._lock:
            if kind in self._contents and self._contents[kind][1] == content:
                return
            self._count += 1
            self._contents[kind] = self._count, content
            watchers = list(self._watchers)
        for told in watchers:
            told()

    def since(self, number: int) -> tuple[int, dict[str, str | bytes]]:
        """
        Return what has changed.

        :param number: that this method returned before; 0 at first.
        :return: the number to ask with next, and the contents by kind, the oldest change first.
        """
        with self._lock:
            changed = sorted((at, kind, content) for kind, (at, content) in self._contents.items()
                             if at > number)
            return self._count, {kind: content for _, kind, content in changed}

    def watch(self, told: Callable[[], object]) -> None:
        """Call a function, which must not block, after every change."""
        with self._lock:
            self._watchers.add(told)

    def leave(self, told: Callable[[], object]) -> None:
        """Call it no more."""
        with self._lock:
            self._watchers.discard(told)
