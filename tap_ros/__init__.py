# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Time-agnostic prediction as a subgoal service for robots, with ROS 2."""

import os

# By default an idle thread of libgomp spins for milliseconds before it sleeps. On cores that are
# busy with something else that makes small networks 10 times slower; a fifth of it costs nothing.
if 'OMP_WAIT_POLICY' not in os.environ:
    os.environ.setdefault('GOMP_SPINCOUNT', '60000')
