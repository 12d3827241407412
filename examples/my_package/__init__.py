# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
