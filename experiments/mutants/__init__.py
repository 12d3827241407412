# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Mutation testing: which small changes of the code the tests notice."""
