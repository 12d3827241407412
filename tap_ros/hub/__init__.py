# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Trained weights to and from the Hugging Face Hub."""
