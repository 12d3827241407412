# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The recordings of the paper's results: what each is collected with, and how many episodes."""

from dataclasses import dataclass

from sim_bridge.collect import CollectConfig

HELD_OUT = 120  # episodes of each recording, about
UNSEEN = 900_000  # seed from which scenes are in no recording that anything is trained on


@dataclass(frozen=True)
class Recording:
    """
    One recording.

    :param task: of sim_bridge.tasks.tasks.
    :param episodes: scale to how many.
    :param options: other settings of its collection.
    """

    task: str
    episodes: dict
    options: dict

    def collection(self, episodes):
        """Return the CollectConfig for so many episodes."""
        return CollectConfig(task=self.task, episodes=episodes, **self.options)


def _recording(task, small, full, **options):
    return Recording(task, {'small': small, 'full': full}, options)


# When the first object comes home and the others are untouched, see sim_bridge.tasks.push.
TIMINGS = ('early', 'middle', 'late', 'mixed')
TIMED = tuple(f'push2_{timing}' for timing in TIMINGS)
# Scenes of push2 whose pictures differ from all that is trained on.
SHIFTED = tuple(f'push2_{look}' for look in ('lighter_table', 'other_light', 'other_camera'))

RECORDINGS = {
    'grasp': _recording('grasp', 3000, 50000),
    'pick_place': _recording('pick_place', 3000, 75000),
    'push2': _recording('push2', 2000, 55000),
    'push3': _recording('push3', 1000, 55000),
    'stack2': _recording('stack2', 1000, 20000),
    'order2': _recording('order2', 700, 20000),
    'order3': _recording('order3', 700, 20000),
    'order2_late': _recording('order2', 700, 20000, timing='late'),
    **{f'push2_{timing}': _recording('push2', 700, 20000, timing=timing) for timing in TIMINGS},
    **{name: _recording('push2', HELD_OUT, 1000, seed=UNSEEN,
                        appearance=name.removeprefix('push2_')) for name in SHIFTED},
}


def held_out_share(episodes):
    """Return the share of a recording that is held out: HELD_OUT episodes, at most a fifth."""
    return min(HELD_OUT / episodes, 0.2)
