# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Which scenes are planned in."""

FIRST_SCENE = 1_000_000  # seed, far from those of the training recordings
PLANNING_TASKS = ('push2', 'push3', 'order2', 'order3')
