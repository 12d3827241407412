# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What of a file could not be used: counted, placed in the log, and put in words."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
import re

import numpy as np
from tap_ros.base.text import escaped

FAR = 2**62  # ns; log times are held within +-FAR
EXAMPLES = 3  # places named of one cause
CAUSES = 8  # causes named of one file


@dataclass(frozen=True)
class Defect:
    """
    A part of a file that could not be used.

    cuts: whether an episode ends there, as messages of any topic may be missing; else what is
        missing is unknown in the episode too (a picture fewer, NaN, no goal).
    """

    why: str
    what: str = ''  # 'chunk', 'record' or 'topic NAME'; '': why says it all
    byte: int | None = None
    start: int | None = None  # log times of what is missing (ns), from one end to the other
    end: int | None = None
    cuts: bool = True
    where: str = ''  # another word for the place

    def place(self) -> str:
        """Return where it is, in words."""
        words = [self.where] if self.where else []
        words += [] if self.byte is None else [f'at byte {self.byte}']
        if self.start is not None and self.start > -FAR:
            end = '' if self.end is None or self.end == self.start else f' to {seconds(self.end)}'
            words.append(f'log time {seconds(self.start)}{end} s')
        return ', '.join(words)


def seconds(time: int) -> str:
    """Return a time in nanoseconds as seconds, all digits."""
    sign, time = ('-', -time) if time < 0 else ('', time)
    return f'{sign}{time // 10**9}.{time % 10**9:09d}'


def describe(defects: Iterable[Defect]) -> list[str]:
    """
    Put defects in words.

    :param defects: list of Defect.
    :return: list of lines, one a kind of cause, the most frequent first, with the number of its
        defects and the first places; of whys that differ in numbers or details the first stands
        for all.
    """
    groups: dict[tuple[str, str], list[Defect]] = {}
    for defect in defects:
        kind = re.sub(r'\d+', '', defect.why.partition(': ')[0]) if defect.what else defect.why
        groups.setdefault((defect.what, kind), []).append(defect)
    found = sorted(groups.values(), key=len, reverse=True)
    lines = [_line(group[0].what, group[0].why, group) for group in found[:CAUSES]]
    if len(groups) > CAUSES:
        rest = sum(len(group) for group in found[CAUSES:])
        lines.append(f'{rest} more defects, of {len(groups) - CAUSES} other causes')
    return lines


def gaps(defects: Iterable[Defect]) -> np.ndarray:
    """
    Return where episodes are cut.

    :return: (G, 2) int64: first and last log time (ns), -FAR where nothing of the file could be
        read.
    """
    return np.array([[-FAR if time is None else time for time in (defect.start, defect.end)]
                     for defect in defects if defect.cuts], np.int64).reshape(-1, 2)


def _line(what: str, why: str, group: Sequence[Defect]) -> str:
    places = [place for defect in group if (place := defect.place())]
    more = f' and {len(places) - EXAMPLES} more' if len(places) > EXAMPLES else ''
    where = '; '.join(places[:EXAMPLES]) + more
    if not what:
        return why
    if what.startswith('topic '):
        count = f'{len(group)} message{"s" * (len(group) > 1)} cannot be used'
        return f'{escaped(what)}: {count}: {why}' + (f' ({where})' if where else '')
    if len(group) == 1:
        return f'{what} {where}: {why}'
    return f'{len(group)} {what}s: {why} ({where})'
