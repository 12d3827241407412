# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What people start: commands, and the functions that are called like them."""
