# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What nodes say of themselves, and why they refuse, in words instead of topics."""

from collections.abc import Callable, Collection, Iterable, Mapping
import re
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from tap_ros.base.text import escaped
from tap_ros.messages import topics

MOST_NODES, MOST_PARTS = 32, 64  # that are remembered
SILENT_S = 3.0  # after which a node that says something every second is busy, or has ended
_WORDS = {
    topics.IMAGE: 'the camera', topics.CAMERA_INFO: "the camera's calibration",
    topics.ROBOT_MASK: 'the robot masks', topics.JOINT_STATES: "the arm's joints",
    topics.OBJECTS: 'objects', topics.GOAL_IMAGE: 'a goal picture',
    topics.GOAL_ROBOT_MASK: "the goal's robot mask", topics.GOAL_OBJECTS: 'goals of the objects'}
_COMMANDS = topics.TWIST, topics.GRIPPER_COMMAND  # that are waited for until somebody acts


def plain(text: str) -> str:
    """Return a text of a node in which no topic or service is named where a word would do."""
    text = re.sub(r'^(?:service )?[\w/]*/\w+(?: refused)?: ', '', text)
    text = re.sub(r'; call \S*select_objects', '; click on them', text)
    return re.sub(r'\bon (/[\w/]*\w(?:, /[\w/]*\w)*)', lambda found: 'from ' + ', '.join(
        map(word, found[1].split(', '))), text)


def renamed(text: str, names: Mapping[str, str]) -> str:
    """Return a text in which objects are called otherwise; names: {there: here}."""
    any_of = '|'.join(map(re.escape, names))
    return re.sub(rf'(?<!\w)(?:{any_of})(?!\w)', lambda found: names[found[0]], text)


def clicks_named(text: str, objects: Iterable[Mapping[str, Any]]) -> str:
    """Return what the tracker says of clicks, each called as its object, and what helps here."""
    text = renamed(text, {
        f'click {tuple(round(float(one[axis]), 1) for axis in "uv")}': one['name']
        for one in objects})
    return text.replace('; click on an object', '; leave it out (✕), or click on an object')


def word(topic: str) -> str:
    """Return what comes on a topic, in words; its name where there are none."""
    called = [one for one in _WORDS if one.is_called(topic)]  # goal/objects is objects of goal/
    return _WORDS[max(called, key=lambda one: len(one.name))] if called else topic


class NodeStates:
    """What nodes say on /diagnostics, one line for each."""

    def __init__(self) -> None:
        self._told: dict[str, tuple[float, dict[str, tuple[bytes, str]]]] = {}

    def take(self, message: DiagnosticArray, now: float) -> None:
        """Remember what nodes say; now: monotonic time."""
        for status in message.status:
            name, _, what = escaped(status.name, 100).partition(': ')
            if name not in self._told and len(self._told) >= MOST_NODES:
                continue
            _, parts = self._told.get(name, (0.0, {}))
            if what in parts or len(parts) < MOST_PARTS:
                parts[what] = status.level, escaped(status.message, 200)
            self._told[name] = now, parts

    def lines(self, now: float, present: Callable[[], Collection[str]],
              clicked: bool) -> list[dict[str, str]]:
        """
        Return a line for each node: its name, its state and that in words.

        :param present: returns the full names of the nodes that are in the ROS graph.
        :param clicked: whether objects come from clicks.
        """
        lines = []
        for name, (came, parts) in sorted(self._told.items()):
            state, text = _describe(parts, clicked)
            if now - came > SILENT_S:
                state, text = ('works', 'busy') if f'/{name}' in present() else (
                    'wrong', 'has ended, or stands still')
            lines.append({'name': name, 'state': state, 'text': text})
        return lines


def _describe(parts: dict[str, tuple[bytes, str]], clicked: bool) -> tuple[str, str]:
    """Return the state of a node, and that in words, by what it said of its parts."""
    for level, text in parts.values():
        if level == DiagnosticStatus.ERROR:
            return 'wrong', plain(text)
    level, text = parts.get('service', (DiagnosticStatus.OK, ''))
    if level != DiagnosticStatus.OK:
        return 'waits', plain(text)
    silent = [what for what, (level, _) in parts.items() if level != DiagnosticStatus.OK
              and not any(one.is_called(what) for one in _COMMANDS)]
    if not silent:
        return 'works', 'works'
    words = [one for one in _WORDS.values() if one in {*map(word, silent)}] or silent
    return 'waits', f'waits for {words[0]}' + (
        ': click on them' if clicked and words[0] == 'objects' else '')
