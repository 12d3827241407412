# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Which scenes are planned in."""

FIRST_SCENE = 1_000_000  # seed, far from those of the training recordings
PAPER_TASKS = ('push2', 'push3')
PLANNING_TASKS = (*PAPER_TASKS, 'order2', 'order3')
