# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Bags of simulators that are not ours, and how well keyframes without training do on them."""
