# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What makes the tables, figures, pages and benchmarks; not installed."""
