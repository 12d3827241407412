# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0

from dataclasses import replace

from tap_ros import get_arm, Mount

TALL = replace(get_arm('ur10e'), name='tall', mount=Mount((0.0, 0.7, 0.1), -1.5708, 0.206))
