# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
What is compared: which pictures are brought about, one after the other, and in which order.

'nothing'; 'direct': the goal picture alone; 'lowest_first': likewise, but what is lowest in the
picture comes first; the name of a predictor ('shipped', 'fix', 'genmin'): its subgoals, then the
goal, with 'recursion<n>' behind a colon for n subgoals in a row. Bounds know more:
'true_subgoals' are frames of the expert, 'oracle_order' knows in which order objects have to be
moved, and 'true_places' also where to, from no picture.
"""

from dataclasses import dataclass
import re

from tap_ros.errors import ConfigError

BOUNDS = ('true_subgoals', 'oracle_order', 'true_places')
BASES = ('nothing', 'direct', 'lowest_first', *BOUNDS)


@dataclass(frozen=True)
class Method:
    """
    A way to act.

    :param base: one of BASES, or the name of a predictor.
    :param recursion: subgoals in a row, of a predictor.
    """

    base: str
    recursion: int = 1

    @property
    def predicted(self):
        """Whether a predictor is needed."""
        return self.base not in BASES

    @property
    def name(self):
        """Return the canonical text, which parse_method reads."""
        return self.base + (f':recursion{self.recursion}' if self.recursion > 1 else '')

    @property
    def file_name(self):
        """Return the name without signs that file systems dislike."""
        return self.name.replace(':', '--')


def parse_method(text):
    """
    Read a method.

    :param text: for example 'direct' or 'shipped:recursion2'.
    :return: Method.
    :raises ConfigError: for an unknown option, or recursion of what predicts nothing.
    """
    found = re.fullmatch(r'([A-Za-z0-9_.+-]+)(?::recursion([1-9]))?', text)
    if not found:
        raise ConfigError(f'method {text!r}: expected a name, and perhaps :recursion<1 to 9>')
    method = Method(found[1], int(found[2] or 1))
    if method.recursion > 1 and not method.predicted:
        raise ConfigError(f'method {text!r}: {method.base} predicts nothing; leave recursion out')
    return method
