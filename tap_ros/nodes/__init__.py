# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The nodes: each decodes, calls and encodes."""

import tap_ros.ros  # noqa: F401  ends here where ROS is lacking
