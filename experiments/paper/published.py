# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
The paper's own numbers, which ours are shown beside.

The range of the paper's l1 errors is not known, and its world, cameras and training sets are
others than ours: only how its methods stand to each other carries over.
"""

# Of recordings whose bottleneck comes at another time.
TIMED_TITLES = {'push2_early': 'early', 'push2_middle': 'in the middle', 'push2_late': 'late',
                'push2_mixed': 'any of these'}

# Table 2: mean final distance in cm and its standard error, of planning.
TABLE_2 = {
    ('push2', 'direct'): (12.9, 0.6), ('push2', 'fix'): (12.5, 0.5),
    ('push2', 'genmin'): (11.9, 0.6), ('push3', 'direct'): (15.8, 0.6),
    ('push3', 'fix'): (17.6, 0.6), ('push3', 'genmin'): (12.9, 0.7)}
# How much lower genmin's error is than fix's (section 4, Table 1).
GAINS = {'grasp': 0.21, 'pick_place': 0.265, 'push2': 0.532}

# Appendix E: share of predictions within 2 px of a bottleneck, pushing two objects.
BOTTLENECK_2PX = {'genmin': 0.58, 'fix': 0.0}
