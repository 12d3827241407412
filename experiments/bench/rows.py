# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What a benchmark measured, as a row of docs/speed.md."""

from dataclasses import dataclass


@dataclass(frozen=True)
class Row:
    """One speed, and the ratio to something that was measured in the same run."""

    what: str  # was measured
    here: str  # the number with its unit
    ratio: float  # of it to `to`
    to: str  # what else was measured
    aim: str = ''  # in words; '': none was set
    reached: bool = True  # whether it is
    limit: str = ''  # what takes the time

    @property
    def cells(self):
        """Return its cells in a table: what, here, ratio, aim, limit."""
        aim = f'{"reached" if self.reached else "**missed**"}: {self.aim}' if self.aim else ''
        return self.what, self.here, f'{self.ratio:.2f} x {self.to}', aim, self.limit


def show(row):
    """Print a row; one that misses its aim has to say what limits it."""
    if not (row.reached or row.limit):
        raise ValueError(f'{row.what}: misses {row.aim}, and nothing says why')
    print('; '.join(filter(None, row.cells)).replace('*', ''), flush=True)
