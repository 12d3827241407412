# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Where joints were at the moment of a picture, from joint states with times of their own."""

from bisect import bisect_left, bisect_right
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass
import math
import threading
from typing import TYPE_CHECKING

import numpy as np
from tap_ros.errors import KinematicsError
from tap_ros.nodes.observations import PROOF
from tap_ros.nodes.topics import to_nanoseconds

if TYPE_CHECKING:
    from sensor_msgs.msg import JointState

KEPT_NS = 5 * 10**9  # what is older than the newest state by more is forgotten
MOST = 10_000  # states kept of a joint
FARTHEST = 100.0  # rad or m; no joint is there


@dataclass(frozen=True)
class JointsAt:
    """Positions at one moment, and when the oldest state that they come from was received."""

    positions: np.ndarray  # (N,) rad or m, in the order of the names
    received: float  # s, monotonic


class JointHistory:
    """
    Keep what drivers say of some joints; safe to use from several threads.

    Several drivers may each tell of a part of the joints. Times that go back are believed when
    PROOF messages in a row say so: then what was known is forgotten.

    :param names: N names of joints.
    :ivar received: monotonic time at which the joint heard least recently was heard; -inf until
        all were.
    """

    def __init__(self, names: Sequence[str]) -> None:
        self.names = tuple(names)
        self._lock = threading.Lock()
        # Joint -> (stamp in ns, position, received), stamps increasing.
        self._states: dict[str, deque[tuple[int, float, float]]] = {
            name: deque(maxlen=MOST) for name in self.names}
        self._late = dict.fromkeys(self.names, 0)  # stamps in a row that go back
        self.received = -math.inf

    def add(self, message: 'JointState', received: float) -> bool:
        """
        Take a message; tell whether it says something new of a joint.

        :param message: sensor_msgs/JointState; joints that are not asked for are passed over.
        :param received: monotonic time in seconds of its reception.
        :raises KinematicsError: for a position that no joint can have; such a message is not used.
        """
        found = {name: position for name, position in zip(message.name, message.position)
                 if name in self._states}
        for name, position in found.items():
            if not abs(position) <= FARTHEST:
                raise KinematicsError(f'{name} is at {position}; expected rad or m, at most '
                                      f'{FARTHEST:g}')
        stamp, new = to_nanoseconds(message.header.stamp), False
        with self._lock:
            for name, position in found.items():
                new |= self._add(name, (stamp, position, received))
            self.received = min((states[-1][2] if states else -math.inf
                                 for states in self._states.values()), default=received)
        return new

    def at(self, stamp_ns: int, max_gap_s: float) -> JointsAt:
        """
        Return where the joints were, linear between the states before and after.

        :param stamp_ns: of the picture.
        :param max_gap_s: a state farther away in time is not used.
        :raises KinematicsError: when a joint was not told of at that time; it says why.
        """
        with self._lock:
            found = [self._between(name, stamp_ns, max_gap_s) for name in self.names]
        return JointsAt(np.array([position for position, _ in found]),
                        min((received for _, received in found), default=math.inf))

    def missing(self) -> list[str]:
        """Return the joints of which nothing is known."""
        with self._lock:
            return [name for name, states in self._states.items() if not states]

    def _add(self, name: str, state: tuple[int, float, float]) -> bool:
        """Add a state of a joint; tell whether its stamp is a new one."""
        states = self._states[name]
        if states and state[0] == states[-1][0]:
            states[-1] = state
            return False
        if states and state[0] < states[-1][0]:
            at = bisect_left(states, state[0], key=lambda known: known[0])
            if states[at][0] == state[0]:  # sent again
                states[at] = state
                return False
            self._late[name] += 1
            if self._late[name] < PROOF:
                return False
            states.clear()
        self._late[name] = 0
        states.append(state)
        while state[0] - states[0][0] > KEPT_NS:
            states.popleft()
        return True

    def _between(self, name: str, stamp_ns: int, max_gap_s: float) -> tuple[float, float]:
        """Return position and reception of a joint at a time."""
        states = self._states[name]
        if not states:
            raise KinematicsError(f'nothing is known of {name}')
        after = bisect_left(states, stamp_ns, key=lambda known: known[0])
        before = bisect_right(states, stamp_ns, key=lambda known: known[0]) - 1
        if before < 0:
            raise KinematicsError(f'the first state of {name} is {_apart(states[0], stamp_ns)} '
                                  'newer than the picture')
        if after == len(states):
            raise KinematicsError(f'the newest state of {name} is {_apart(states[-1], stamp_ns)} '
                                  'older than the picture; expected one at its time or later')
        for nearest, word in ((states[before], 'older'), (states[after], 'newer')):
            if abs(nearest[0] - stamp_ns) > max_gap_s * 1e9:
                raise KinematicsError(
                    f'the nearest {word} state of {name} is {_apart(nearest, stamp_ns)} from the '
                    f'picture; expected at most {max_gap_s:g} s')
        (t0, x0, r0), (t1, x1, r1) = states[before], states[after]
        share = (stamp_ns - t0) / (t1 - t0) if t1 > t0 else 0.0
        return x0 + share * (x1 - x0), min(r0, r1)


def _apart(state: tuple[int, float, float], stamp_ns: int) -> str:
    """Return how far in time a state is from a stamp."""
    return f'{abs(state[0] - stamp_ns) / 1e9:.3f} s'
