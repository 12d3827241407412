# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Trainings: a loop for each model, its settings and its loss; and what all runs share."""
