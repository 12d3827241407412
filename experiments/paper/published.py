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

# Table 1: task -> method -> (min l1, match-step, its standard deviation over episodes).
TABLE_1 = {
    'grasp': {
        'fix': (0.0153, 7.61, 2.52), 'min': (0.0104, 7.31, 2.68), 'genmin': (0.0121, 6.77, 2.44),
        'genmin-wo-gan': (0.0117, 6.74, 2.41), 'genmin-vae-gan': (0.0156, 7.07, 2.75),
        'genmin-vae-best-of-100': (0.0121, None, None)},
    'pick_place': {
        'fix': (0.0366, 10.58, 4.82), 'min': (0.0256, 8.23, 6.07),
        'genmin': (0.0269, 8.49, 4.51), 'genmin-wo-gan': (0.0235, 9.21, 4.90),
        'genmin-vae-gan': (0.0432, 6.12, 4.81), 'genmin-vae-best-of-100': (0.0196, None, None)},
    'push2': {
        'fix': (0.0722, 10.76, 5.82), 'min': (0.0365, 10.59, 6.61),
        'genmin': (0.0338, 10.82, 5.79), 'genmin-wo-gan': (0.0411, 11.07, 5.80),
        'genmin-vae-gan': (0.0447, 10.99, 6.15), 'genmin-vae-best-of-100': (0.0236, None, None)},
}

# Table 2: mean final distance in cm and its standard error, of planning.
TABLE_2 = {
    ('push2', 'direct'): (12.9, 0.6), ('push2', 'fix'): (12.5, 0.5),
    ('push2', 'genmin'): (11.9, 0.6), ('push3', 'direct'): (15.8, 0.6),
    ('push3', 'fix'): (17.6, 0.6), ('push3', 'genmin'): (12.9, 0.7)}
# How much lower genmin's error is than fix's (section 4).
GAINS = {'grasp': 0.21, 'pick_place': 0.265, 'push2': 0.532}

# Appendix E: share of predictions within 2 px of a bottleneck, pushing two objects.
BOTTLENECK_2PX = {'genmin': 0.58, 'fix': 0.0}
