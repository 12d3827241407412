# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What happened, for browsers: when, in words, and what was seen then."""

import base64
from collections import deque
from collections.abc import Callable
from dataclasses import asdict, dataclass
import json
import threading
import time
from typing import Any

import cv2
import numpy as np

MOST = 30  # events that are kept
SEEN_S = 0.5  # after an event until what it changed has been seen
WIDTH = 144  # px of its picture


@dataclass
class Event:
    """Something that happened; picture: a JPEG as a data URL, or ''."""

    text: str
    problem: bool
    time: float  # s since 1970
    picture: str = ''


class Events:
    """
    The newest events; from any thread.

    :param picture: returns the newest picture of a kind, uint8 (H, W, 3), None without one.
    :ivar text: them as JSON for the page, as of the last look.
    :ivar count: of all events; problem: the newest that is one, and how many have been.
    """

    def __init__(self, picture: Callable[[str], np.ndarray | None]) -> None:
        self._picture, self._lock = picture, threading.Lock()
        self._events: deque[Event] = deque(maxlen=MOST)
        self._unseen: deque[tuple[Event, str, float]] = deque(maxlen=MOST)
        self._changed = True
        self.text, self.count = '', 0
        self.problem: dict[str, Any] = {'count': 0, 'text': ''}

    def add(self, text: str, kind: str = 'camera', problem: bool = False) -> None:
        """
        Tell what happened.

        :param kind: of the picture that shows it soon after; '': none.
        :param problem: whether it is something that could not be done.
        """
        event = Event(text, problem, time.time())
        with self._lock:
            self._events.append(event)
            self.count += 1
            if problem:
                self.problem = {'count': self.problem['count'] + 1, 'text': text}
            elif kind:
                self._unseen.append((event, kind, time.monotonic()))
            self._changed = True

    def look(self) -> None:
        """Take the pictures of events that have none yet, and write `text`; again and again."""
        while self._unseen and time.monotonic() - self._unseen[0][2] >= SEEN_S:
            event, kind, _ = self._unseen.popleft()
            picture = self._picture(kind)
            if picture is not None:
                event.picture, self._changed = small(picture), True
        if self._changed:
            with self._lock:
                self._changed, events = False, list(map(asdict, self._events))
            self.text = json.dumps({'kind': 'events', 'events': events})


def small(picture: np.ndarray) -> str:
    """Return a picture, uint8 (H, W, 3), as a data URL of a small one."""
    height, width = picture.shape[:2]
    size = WIDTH, max(1, min(round(WIDTH * height / width), 2 * WIDTH))
    shrunk = cv2.resize(picture, size, interpolation=cv2.INTER_AREA)
    jpeg = cv2.imencode('.jpg', np.ascontiguousarray(shrunk[..., ::-1]))[1]
    return f'data:image/jpeg;base64,{base64.b64encode(jpeg.tobytes()).decode()}'
