# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The simulated world of tap_ros."""

import os

# Off-screen rendering on a machine without a display; MuJoCo reads it once, when it is imported.
os.environ.setdefault('MUJOCO_GL', 'egl')
