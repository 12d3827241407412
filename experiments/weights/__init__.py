# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The shipped weights: how each was made, and the command that makes them again."""
