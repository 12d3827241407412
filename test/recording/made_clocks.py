# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Recordings made up in memory whose clocks can be spoilt: a camera, joints, commands, marks."""

from copy import deepcopy
import warnings

import numpy as np
from tap_ros.recording.align import assemble
from tap_ros.recording.columns import Columns
from tap_ros.recording.metadata import ArmMount
from tap_ros.recording.reading import Reading

SECOND = 10**9
WALL = 1_700_000_000 * SECOND
TOPICS = {'frame': '/cam', 'mask': '/mask', 'twist': '/cmd', 'joint': '/joint_states',
          'mark': '/episode'}


class Recording:
    """
    N messages in the order in which they were written; times int64, ns.

    :ivar name, log, stamp: (N,).
    :ivar number: (N,) of a picture or of that which a command answers, 0 or 1 of a mark, and where
        joints are, which is the time in s.
    """

    def __init__(self, events):
        """Take [(name, log time in s, stamp in s, number)]; those of a name stay in order."""
        newest = {}
        for i, (name, log, *_) in enumerate(events):
            newest[name] = max(newest.get(name, -1e9) + 1e-5, log)
            events[i] = (name, newest[name], *events[i][2:])
        events.sort(key=lambda event: event[1])
        name, log, stamp, number = zip(*events)
        self.name, self.number = np.array(name), np.array(number, float)
        self.log, self.stamp = (np.round(np.array(times) * SECOND).astype(np.int64)
                                for times in (log, stamp))

    def rows(self, *names):
        return np.flatnonzero(np.isin(self.name, names))

    def spoilt(self, spoil, random):
        """Return a copy that a function of it and of random numbers has changed."""
        copy = deepcopy(self)
        spoil(copy, random)
        masks, frames = copy.rows('mask'), copy.rows('frame')
        copy.stamp[masks] = copy.stamp[frames[copy.number[masks].astype(int)]]
        return copy

    def columns(self, rows=slice(None), source='bag'):
        name, number = self.name[rows], self.number[rows]
        arrays = {}
        for kind in dict.fromkeys(name.tolist()):
            own = np.flatnonzero(name == kind)
            index = number[own] if kind in ('frame', 'mask', 'mark') else 0 * own
            arrays[kind] = np.stack([self.log[rows][own], self.stamp[rows][own], own,
                                     index.astype(np.int64)], 1)
            empty = np.full((len(own), 3), np.nan if kind == 'joint' else 0.0)
            arrays[f'{kind}_values'] = np.column_stack([
                number[own] + 1, empty[:, :{'frame': 0, 'twist': 2, 'joint': 3}.get(kind, 0)]])
        marks = [('push', 3, 'success' if event else '') for event in number[name == 'mark']]
        return Columns(source, image_size=(2, 2), arrays=arrays, marks=marks, topics=TOPICS)

    def read(self, *parts, **reading):
        """Return (numbers of the pictures of each episode, EpisodeTable, warnings)."""
        with warnings.catch_warnings(record=True) as told:
            warnings.simplefilter('always')
            table = assemble(parts or [self.columns()], ArmMount(), Reading(**reading))
        numbers = np.split(table.places['frame'][1], table.starts[1:-1])
        said = [str(one.message) for one in told]
        return [one.tolist() for one in numbers], table, [
            text for text in said if 'no marks tell' not in text]


def record(random, rate=10, demonstrations=2, frames=50, marks=False, joints=True, jitter=0.1,
           latency=(0.003, 0.012), lost=0.02, pause=8.0):
    """
    Return a good Recording: pictures, a command between two of them, joints at 50 Hz.

    :param random: numpy's Generator.
    :param rate: pictures a second.
    :param jitter: of the camera, in periods.
    :param latency: s, until a picture is logged, from and to.
    :param lost: share of the pictures.
    :param pause: s, between demonstrations.
    """
    start = begin = WALL / SECOND
    events, number, log = [], 0, 0.0
    for _ in range(demonstrations):
        for t in begin + np.arange(frames) / rate:
            if t > begin and random.random() < lost:
                continue
            stamp = t + random.uniform(-jitter, jitter) / rate
            log = max(log, stamp + random.uniform(*latency)) + 1e-4  # none overtakes another
            command = max(log, t + 0.5 / rate) + random.uniform(0.001, 0.1 / rate)
            events += [('frame', log, stamp, number), ('mask', log + 0.0004, stamp, number),
                       ('twist', command + 0.0005, command, number)]
            number += 1
        end = begin + frames / rate
        if marks:
            events += [('mark', t + random.uniform(0.001, 0.003), t, event)
                       for event, t in ((0, begin - 0.05), (1, end))]
        begin = end + pause
    if joints:
        events += [('joint', t + random.uniform(0.0005, 0.002), t, t - start)
                   for t in np.arange(start - 0.5, end + 0.5, 0.02)]
    return Recording(events)
