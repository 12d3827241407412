# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""How MuJoCo draws: off-screen, on a machine without a display too. Imported before MuJoCo."""

import os

# MuJoCo reads it once, when it is imported.
_chosen = os.environ['MUJOCO_GL'] = os.environ.get('MUJOCO_GL') or 'egl'
GL_PROBLEM = ''  # why nothing can be drawn
try:
    import mujoco
except Exception as error:  # no such value, or its library is not there; physics needs neither
    GL_PROBLEM = str(error)
    os.environ['MUJOCO_GL'] = 'disabled'
    import mujoco  # noqa: F401
    os.environ['MUJOCO_GL'] = _chosen
