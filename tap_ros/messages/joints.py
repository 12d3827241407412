# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Joint states, live or recorded, to the gripper's state at the moment of a picture, and back.

Drivers publish at times of their own. What counts for a picture lies between the states before
and after it (`between`); a state that is farther away than a limit says nothing of it.
"""

from bisect import bisect_left, bisect_right
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
import math
import threading
from typing import Any

import numpy as np
from tap_ros.base.contract import GRIPPER_JOINTS
from tap_ros.base.errors import KinematicsError, PlanningError
from tap_ros.base.text import listing
from tap_ros.messages.stamps import header_fields, MAX_GAP, PROOF, Stamp, to_nanoseconds
from tap_ros.robots.arm import Arm, Mount

PLACE, OPENING = GRIPPER_JOINTS[:3], GRIPPER_JOINTS[3]
KEPT_NS = 5 * 10**9  # what is older than the newest state by more is forgotten
MOST = 10_000  # states kept of a joint
FARTHEST = 100.0  # rad or m; no joint is there
_FASTEST, _AT_ZERO = 10.0, 1.0  # rad/s or m/s: there and back; likewise where it is 0 to the bit
_JUMP = 0.05  # rad or m: less is no jump
_BRIEF, _BRIEF_AT_ZERO = 0.3, 1.0  # s; what is elsewhere for longer is there


def decode_positions(message: Any) -> dict[str, float]:
    """Return the positions in a sensor_msgs/JointState by the names of the joints."""
    return dict(zip(message.name, np.asarray(message.position).tolist()))


def joint_fields(gripper: Iterable[float], stamp: Stamp | int, frame_id: str,
                 arm: Mapping[str, float] | None = None) -> dict[str, Any]:
    """
    Return the fields of a sensor_msgs/JointState: GRIPPER_JOINTS, then the arm's.

    :param gripper: (4,) x, y, z in metres and opening from 0 to 1.
    :param stamp: a Stamp or ns.
    :param frame_id: frame of the position.
    :param arm: the arm's joints, rad by name; None: without one.
    """
    names, positions = [*GRIPPER_JOINTS], [*gripper]
    if arm is not None:
        names.extend(arm)
        positions.extend(arm.values())
    return {'header': header_fields(stamp, frame_id), 'name': names,
            'position': [float(position) for position in positions]}


def between(t0: Any, x0: Any, t1: Any, x1: Any, t: Any) -> Any:
    """Return the position at time t, linear between two states; x0 where both are of one time."""
    return np.where(t1 > t0, x0 + (t - t0) / np.maximum(t1 - t0, 1) * (x1 - x0), x0)


def positions_at(times: np.ndarray, values: np.ndarray, at: np.ndarray, hold: int) -> np.ndarray:
    """
    Return where a recorded joint was, by the rule of JointHistory.

    A picture that lacks a near state before or after it, as the last one of a recording may,
    is not served live; here the other one holds for it, since training leaves no frame out.

    :param times: (N,) int64 ns of its states, increasing; of equal ones the last counts.
    :param values: (N,) float64.
    :param at: (F,) int64 ns.
    :param hold: ns that the nearest state holds.
    :return: (F,) float64, NaN where it is unknown.
    """
    last_of_time = np.append(np.diff(times) > 0, np.ones(min(len(times), 1), bool))
    times, values = times[last_of_time], values[last_of_time]
    if not len(times):
        return np.full(len(at), np.nan)
    before = np.searchsorted(times, at, 'right') - 1
    after = np.searchsorted(times, at, 'left')
    lacking = (before < 0), (after == len(times))
    before, after = np.maximum(before, 0), np.minimum(after, len(times) - 1)
    older, newer = np.where(lacking, 2**62, (at - times[before], times[after] - at))
    found = between(times[before], values[before], times[after], values[after], at)
    nearest = np.where(newer < older, values[after], values[before])
    held = np.where(np.minimum(older, newer) <= hold, nearest, np.nan)
    return np.where(np.maximum(older, newer) <= MAX_GAP * 1e9, found, held)


def contradicted(times: np.ndarray, values: np.ndarray) -> np.ndarray:
    """
    Tell which recorded positions of a joint contradict those before and after them.

    Where several nodes publish joint states, or a driver sends zeros until it knows, a joint seems
    to jump and to be back in no time. Zeros are the ones that are wrong; else those that are not
    by far the most.

    :param times: (N,) int64 ns, increasing.
    :param values: (N,) float64, finite.
    :return: (N,) bool.
    """
    wrong = np.zeros(len(values), bool)
    for zeros in (True, False):
        rows = np.flatnonzero(~wrong)
        t, x = times[rows] / 1e9, values[rows]
        steps, pace = np.abs(np.diff(x)), np.diff(t)
        slow = zeros & ((x[1:] == 0) | (x[:-1] == 0))
        edges = np.flatnonzero(steps > _JUMP + np.where(slow, _AT_ZERO, _FASTEST) * pace) + 1
        if not len(edges):
            continue
        begins, ends = np.append(0, edges), np.append(edges, len(x))  # of the parts between jumps
        before, after = np.maximum(begins - 1, 0), np.minimum(ends, len(x) - 1)
        least = np.minimum(np.abs(x[begins] - x[before]), np.abs(x[ends - 1] - x[after]))
        brief = (np.abs(x[after] - x[before]) <= least / 2) & (
            t[after] - t[before] < (_BRIEF_AT_ZERO if zeros else _BRIEF))
        counts = ends - begins
        if zeros:
            # What is before the first jump, or behind the last, is not back: it has to be large.
            brief[[0, -1]] = (steps > _JUMP + _FASTEST * pace)[edges[[0, -1]] - 1]
            brief &= (x[begins] == 0) & (x[ends - 1] == 0)
        else:
            brief[[0, -1]] = False
            brief[1:-1] &= counts[1:-1] <= 4 * np.maximum(counts[:-2], counts[2:])
        wrong[rows[np.repeat(brief, counts)]] = True
    return wrong


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
        self._states: dict[str, list[tuple[int, float, float]]] = {
            name: [] for name in self.names}
        self._late = dict.fromkeys(self.names, 0)  # stamps in a row that go back
        self._others: list[str] = []  # joints that a message told of, and none of these
        self.received = -math.inf

    def add(self, message: Any, received: float, again: bool = False) -> bool:
        """
        Take a message; tell whether it says something new of a joint.

        :param message: sensor_msgs/JointState; joints that are not asked for are passed over.
        :param received: monotonic time in seconds of its reception.
        :param again: whether a state with a stamp that is known counts as received anew.
        :raises KinematicsError: for a position that no joint can have; such a message is not used.
        """
        told = decode_positions(message)
        found = {name: told[name] for name in told if name in self._states}
        self._others = [] if found else [*told]
        for name, position in found.items():
            if not abs(position) <= FARTHEST:
                raise KinematicsError(f'{name} is at {position}; expected rad or m, at most '
                                      f'{FARTHEST:g}')
        stamp, new = to_nanoseconds(message.header.stamp), False
        with self._lock:
            for name, position in found.items():
                new |= self._add(name, (stamp, position, received), again)
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

    def newest(self, name: str, stamp_ns: int) -> float | None:
        """Return the position of a joint that was told last until then, None if none was."""
        with self._lock:
            count = _count_until(self._states[name], stamp_ns)
            return self._states[name][count - 1][1] if count else None

    def missing(self) -> list[str]:
        """Return the joints of which nothing is known."""
        with self._lock:
            return [name for name, states in self._states.items() if not states]

    def _add(self, name: str, state: tuple[int, float, float], again: bool) -> bool:
        """Add a state of a joint; tell whether its stamp is a new one."""
        states = self._states[name]
        if states and state[0] <= states[-1][0]:
            at = bisect_left(states, state[0], key=lambda known: known[0])
            if states[at][0] == state[0]:  # sent again
                states[at] = (*state[:2], state[2] if again else states[at][2])
                return False
            self._late[name] += 1
            if self._late[name] < PROOF:
                return False
            states.clear()
        self._late[name] = 0
        states.append(state)
        old = _count_until(states, state[0] - KEPT_NS - 1)
        del states[:max(old, len(states) - MOST)]
        return True

    def _between(self, name: str, stamp_ns: int, max_gap_s: float) -> tuple[float, float]:
        """Return position and reception of a joint at a time."""
        states = self._states[name]
        if not states:
            raise KinematicsError(f'nothing is known of {name}' + (
                f'; joint states tell of {listing(self._others)}; is the prefix of its joints '
                'right?' if self._others else ''))
        after = bisect_left(states, stamp_ns, key=lambda known: known[0])
        before = _count_until(states, stamp_ns) - 1
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
        return float(between(t0, x0, t1, x1, stamp_ns)), min(r0, r1)


class GripperHistory:
    """
    Find the gripper at the moment of a picture, from joint states with times of their own.

    States may tell its place, as the simulator's do; else it follows from the arm's joints. An
    opening that is not told together with the place is that of the newest states that tell it.

    :param arm: Arm.
    :param prefix: of the names of its joints.
    :param opening: of the gripper where no states of an arm's driver tell it, 0 to 1.
    :param mount: returns the Mount where it stands, or raises KinematicsError; by default that of
        the Arm.
    """

    def __init__(self, arm: Arm, prefix: str, opening: float,
                 mount: Callable[[], Mount] | None = None) -> None:
        self._kind, self._fixed_opening = arm, opening
        self._mount = mount or (lambda: arm.mount)
        self._told, self._beside = JointHistory(PLACE), JointHistory([OPENING])
        self._openings = JointHistory([OPENING])  # of whatever states
        self._arm = JointHistory([prefix + name for name in arm.joints])

    @property
    def received(self) -> float:
        """Monotonic time at which the joint heard least recently was heard; -inf: not all were."""
        return self._source.received

    @property
    def _source(self) -> JointHistory:
        """Return the joints that were heard last; either tells where the gripper is."""
        return max((self._told, self._arm), key=lambda history: history.received)

    def take(self, message: Any, received: float, again: bool = False) -> bool:
        """
        Take joint states.

        :param message: sensor_msgs/JointState.
        :param received: monotonic time in seconds of its reception.
        :param again: as JointHistory.add has it.
        :return: whether they tell something new of where the gripper is.
        :raises TapError: when there is nothing in them, or nothing that can be used.
        """
        known = decode_positions(message)
        source = self._arm if known.keys().isdisjoint(PLACE) else self._told
        if self.received == -math.inf and known.keys().isdisjoint((*source.names, OPENING)):
            raise PlanningError(
                f'has neither {", ".join(PLACE)} nor {", ".join(self._arm.names)}; it has '
                f'{listing(known) or "no joints"}')
        if math.isfinite(known.get(OPENING, 0.0)):
            self._openings.add(message, received, again)
            if source is self._told:
                self._beside.add(message, received, again)
        return source.add(message, received, again)

    def at(self, stamp_ns: int, max_gap_s: float) -> tuple[np.ndarray, float]:
        """
        Return the gripper's state at the time of a picture, and when it was received.

        :return: float32 (4,) x, y, z in m and opening from 0 to 1, and a monotonic time.
        :raises KinematicsError: when the joints are not known for that time, or where it stands.
        """
        source = self._source
        found = source.at(stamp_ns, max_gap_s)
        if source is self._told:
            place, opening = found.positions, self._openings.newest(OPENING, stamp_ns)
            if opening is None or not self._beside.missing():
                opening, = self._beside.at(stamp_ns, max_gap_s).positions
        else:
            place = self._kind.gripper_at(found.positions, self._mount())
            opening = self._openings.newest(OPENING, stamp_ns)
        opening = self._fixed_opening if opening is None else opening
        return np.array([*place, opening], np.float32), found.received


def _count_until(states: Sequence[tuple[int, float, float]], stamp_ns: int) -> int:
    """Return how many states are not after a stamp."""
    return bisect_right(states, stamp_ns, key=lambda known: known[0])


def _apart(state: tuple[int, float, float], stamp_ns: int) -> str:
    """Return how far in time a state is from a stamp."""
    return f'{abs(state[0] - stamp_ns) / 1e9:.3f} s'
