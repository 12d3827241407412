# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The recordings of the paper's results: what each is collected with, and how many episodes."""

from dataclasses import dataclass, field

from sim_bridge.collect import CollectConfig

HELD_OUT = 120  # episodes of each recording, about
UNSEEN = 900_000  # seed from which scenes are in no recording that anything is trained on


@dataclass(frozen=True)
class Recording:
    """
    One recording.

    :param task: of sim_bridge.tasks.tasks.
    :param episodes: how many.
    :param options: other settings of its collection.
    """

    task: str
    episodes: int
    options: dict = field(default_factory=dict)

    @property
    def collection(self):
        """Return its CollectConfig."""
        return CollectConfig(task=self.task, episodes=self.episodes, **self.options)


# When the first object comes home and the others are untouched, see sim_bridge.tasks.push.
TIMINGS = ('early', 'middle', 'late', 'mixed')
TIMED = tuple(f'push2_{timing}' for timing in TIMINGS)
# Scenes of push2 whose pictures differ from all that is trained on.
SHIFTED = tuple(f'push2_{look}' for look in ('lighter_table', 'other_light', 'other_camera'))

RECORDINGS = {
    'grasp': Recording('grasp', 3000),
    'pick_place': Recording('pick_place', 3000),
    'push2': Recording('push2', 2000),
    'push3': Recording('push3', 1000),
    'stack2': Recording('stack2', 1000),
    'order2': Recording('order2', 700),
    'order3': Recording('order3', 700),
    **{f'{task}_late': Recording(task, 700, {'timing': 'late'}) for task in ('order2', 'order3')},
    **{f'push2_{timing}': Recording('push2', 700, {'timing': timing}) for timing in TIMINGS},
    **{name: Recording('push2', HELD_OUT, {
        'seed': UNSEEN, 'appearance': name.removeprefix('push2_')}) for name in SHIFTED},
}


def held_out_share(name):
    """Return the share of a recording that is held out: HELD_OUT episodes, at most a fifth."""
    return min(HELD_OUT / RECORDINGS[name].episodes, 0.2)
