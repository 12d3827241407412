# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The recordings of the paper's results: what each is collected with."""

from sim_bridge.collect import CollectConfig

HELD_OUT = 120  # episodes of each recording, about
UNSEEN = 900_000  # seed from which scenes are in no recording that anything is trained on


# When the first object comes home and the others are untouched, see sim_bridge.tasks.push.
TIMINGS = ('early', 'middle', 'late', 'mixed')
TIMED = tuple(f'push2_{timing}' for timing in TIMINGS)
# Scenes of push2 whose pictures differ from all that is trained on.
SHIFTED = tuple(f'push2_{look}' for look in ('lighter_table', 'other_light', 'other_camera'))

RECORDINGS = {name: CollectConfig(task=name, episodes=episodes) for name, episodes in {
    'grasp': 3000, 'pick_place': 3000, 'push2': 2000, 'push3': 1000, 'stack2': 1000,
    'order2': 700, 'order3': 700}.items()}
for task, timings in {'order2': ('late',), 'order3': ('late',), 'push2': TIMINGS}.items():
    RECORDINGS |= {f'{task}_{timing}': CollectConfig(task=task, episodes=700, timing=timing)
                   for timing in timings}
RECORDINGS |= {name: CollectConfig(
    task='push2', episodes=HELD_OUT, seed=UNSEEN, appearance=name.removeprefix('push2_'))
    for name in SHIFTED}


def held_out_share(name):
    """Return the share of a recording that is held out: HELD_OUT episodes, at most a fifth."""
    return min(HELD_OUT / RECORDINGS[name].episodes, 0.2)
