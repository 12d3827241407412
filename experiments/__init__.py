# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What makes the tables, figures, pages and benchmarks; not installed."""

import tap_ros  # noqa: F401  while sys.argv tells it that a program of ours is run by -m
