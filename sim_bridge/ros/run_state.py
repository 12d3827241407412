# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Whether simulated time passes, and how much of it may be asked for at once."""

from enum import IntEnum

MAX_PERIODS = 100  # of a call that is answered when they have passed: about a second
MAX_STEPS = 100_000  # of a goal that can be cancelled


class RunState(IntEnum):
    """What a simulation does; the numbers are those of simulation_interfaces/SimulationState."""

    STOPPED = 0  # paused at the start of a scene
    PLAYING = 1
    PAUSED = 2
    QUITTING = 3
