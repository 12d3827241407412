# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Ctrl-C while a command or a node is still imported."""

import os


def leave_at_once(*_: object) -> None:
    """Say so and end: the handler of SIGINT while a command or a node is imported."""
    os.write(2, b'interrupted\n')
    os._exit(130)
