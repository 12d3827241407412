# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Labels of what is not marked yet, found in the background while somebody marks."""

from collections import Counter
from collections.abc import Mapping, Sequence
import threading

import numpy as np
from tap_ros.base.errors import TapError
from tap_ros.recording.cache import EpisodeStore
from tap_ros.training.labels import Film, film_of, label

LEAST = 3  # marked demonstrations: fewer tell nothing of the others
MOST_MARKED = 12  # the newest ones, that others are labelled by: time grows with their square
MOST = 200  # demonstrations that are labelled, spread over the set
Asked = tuple[Mapping[int, Sequence[int]], Sequence[str]]  # frames of marks by episode; names


class BackgroundLabels:
    """
    The labels that the newest marks give, found by a thread of its own.

    :param usable: indices of the episodes that can be marked.
    :ivar found: of episodes that labels were found for, each mark's (frame, confidence), in order.
    :ivar is_busy: whether newer ones are being found.
    """

    def __init__(self, store: EpisodeStore, usable: Sequence[int]) -> None:
        self._store = store
        step = max(1, -(-len(usable) // MOST))
        self._chosen = usable[::step]
        self._films: dict[int, Film | None] = {}
        self._lock = threading.Lock()
        self._asked: Asked | None = None
        self._thread: threading.Thread | None = None
        self.found: Mapping[int, Sequence[tuple[int, float]]] = {}
        self.is_busy = False

    def ask(self, marks: Mapping[int, Sequence[int]], names: Sequence[str]) -> None:
        """
        Find labels by marks, instead of those asked before.

        :param marks: frames by episode, the newest last; those of another number than most have,
            or than there are names, do not count.
        """
        with self._lock:
            self._asked = marks, names
            if not self.is_busy:
                self.is_busy = True
                self._thread = threading.Thread(target=self._work, daemon=True)
                self._thread.start()

    def close(self) -> None:
        """Wait until what is being found is found: a thread in a library cannot be cut off."""
        with self._lock:
            self._asked = None
        if self._thread is not None:
            self._thread.join()

    def _work(self) -> None:
        """Find labels until nothing is asked."""
        try:
            while True:
                with self._lock:
                    asked, self._asked = self._asked, None
                    if asked is None:
                        self.is_busy = False
                        return
                try:
                    self.found = self._find(*asked)
                except TapError:  # of marks that tell nothing
                    self.found = {}
        except BaseException:
            self.is_busy = False
            raise

    def _find(self, marks: Mapping[int, Sequence[int]], names: Sequence[str],
              ) -> dict[int, list[tuple[int, float]]]:
        store, films = self._store, self._films
        count = len(names) or Counter(map(len, marks.values())).most_common(1)[0][0]
        marks = dict([one for one in marks.items() if len(one[1]) == count][-MOST_MARKED:])
        if len(marks) < LEAST:
            return {}
        for i in [*marks, *self._chosen]:
            if i not in films:
                films[i] = film_of(store, i)
        labels = label([films.get(i) for i in range(len(store))],
                       {i: store.seconds(i)[list(frames)] for i, frames in marks.items()},
                       names or [f'mark {k + 1}' for k in range(count)])
        return {i: [(int(np.abs(store.seconds(i) - second).argmin()), float(sure))
                    for second, sure in zip(labels.moments[i], labels.confidence[i])]
                for i, film in films.items() if film is not None and i not in marks}
