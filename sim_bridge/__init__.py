# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The simulated world of tap_ros."""

import tap_ros.base  # noqa: F401  its handler of Ctrl-C, before what takes long to import

# isort: split
import sim_bridge.world.opengl  # noqa: F401  before anything imports MuJoCo
