# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The paper's prediction results on our own recordings: which runs, making them, their numbers."""
