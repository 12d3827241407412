# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Where many independent tasks run: processes of this machine, or a Ray cluster."""
