# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Run the command line: python -m tap_ros."""

import sys

from tap_ros.apps.cli import main

sys.exit(main())
