# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What a fault is, and the job of trying it many times."""

from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
import re
import statistics

import numpy as np
from tap_ros.text import escaped
from tqdm import tqdm

SUMMARIES = {'worst': max, 'least': min, 'median': statistics.median, 'mean': statistics.fmean}
MAX_TOLD = 10  # failures shown as they happen
MAX_REASONS = 4


@dataclass(frozen=True)
class Fault:
    """
    One thing that goes wrong, and what then has to hold.

    :param name: of the row, and for --only.
    :param title: what goes wrong, a few words.
    :param meaning: one or two plain sentences on what that means to a user.
    :param promise: what holds in a trial that counts as held.
    :param count: how many trials the whole run makes.
    :param seconds: about how long one trial takes on two cores.
    :param run: called with a Job; makes job.count trials and records each.
    :param figure: what is measured in a trial, for the page; empty if nothing is.
    :param unit: of the figure.
    :param summary: which of the trials' figures is shown, a key of SUMMARIES.
    """

    name: str
    title: str
    meaning: str
    promise: str
    count: int
    seconds: float
    run: Callable
    figure: str = ''
    unit: str = ''
    summary: str = 'worst'


class Job:
    """
    The trials of one fault.

    :param fault: Fault.
    :param share: of the fault's count that is tried.
    :param folder: for whatever the trials write.
    :param rig: what runs the nodes, for faults that need some; else None.
    :param progress: whether to show a bar.
    :param patience: factor of what a promise says in seconds; more than 1 on a machine that does
        something else meanwhile.
    """

    def __init__(self, fault, share, folder, rig=None, progress=True, patience=1.0):
        self.patience = patience
        self.fault, self.share, self.folder, self.rig = fault, share, folder, rig
        self.count = max(1, round(fault.count * share))
        self.random = np.random.default_rng(0)
        self.tried = self.held = 0
        self.note = ''  # for the row, beside the figure
        self.figures = []
        self.reasons, self._examples = Counter(), {}
        self._bar = tqdm(total=self.count, desc=fault.name, unit='', disable=not progress)

    def trials(self):
        """Yield 0, 1, ... for each trial."""
        yield from range(self.count)

    def expect(self, count):
        """Set how many trials there are, where that shows only now."""
        self.count = self._bar.total = count
        self._bar.refresh()

    def record(self, held, why='', figure=None, times=1):
        """
        Take down what came of a trial.

        :param held: whether the promise held.
        :param why: what happened instead, when it did not.
        :param figure: what was measured, or None.
        :param times: of how many equal trials.
        """
        self.tried += times
        self.held += times * bool(held)
        if not held:
            why = escaped(why or 'no reason was given', 200)
            alike = re.sub(r'\d+', '#', why)  # reasons that differ in numbers only count as one
            self._examples.setdefault(alike, why)
            self.reasons[alike] += times
            if sum(self.reasons.values()) <= MAX_TOLD:
                self._bar.write(f'{self.fault.name}, trial {self.tried}: {why}')
        if figure is not None:
            self.figures.append(float(figure))
        self._bar.update(times)
        if self.held < self.tried:
            self._bar.set_postfix_str(f'{self.tried - self.held} did not hold')

    def figure(self):
        """Return what is shown of the trials' figures; None without any."""
        return SUMMARIES[self.fault.summary](self.figures) if self.figures else None

    def close(self):
        """End the progress bar."""
        self._bar.close()

    def why_not(self):
        """Return the most frequent reasons why the promise did not hold, in one line."""
        common = [f'{count} times: {self._examples[why]}' if count > 1 else self._examples[why]
                  for why, count in self.reasons.most_common(MAX_REASONS)]
        left = len(self.reasons) - len(common)
        return '; '.join([*common, *([f'and {left} other reasons'] if left > 0 else [])])
