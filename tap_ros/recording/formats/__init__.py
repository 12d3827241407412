# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Recordings from other formats and to them; what that needs is imported by its command alone."""
