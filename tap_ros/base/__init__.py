# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What every folder may need: errors, files, options, plug-ins, engines, search."""
