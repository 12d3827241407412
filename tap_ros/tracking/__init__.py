# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Objects followed in camera pictures from a click on each, without ground truth."""
