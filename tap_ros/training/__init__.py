# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What every training shares: data, devices, weights files, the state of a run."""
