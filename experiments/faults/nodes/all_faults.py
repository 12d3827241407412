# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""All faults, in the order of the page."""

from experiments.faults import disk, recordings, weights
from experiments.faults.nodes import (
    changes,
    clients,
    generated,
    killed,
    lockstep,
    recorder_disk,
    silence,
    soak,
    start_stop,
)

GROUPS = {
    'Inputs that fall silent or tell nonsense': silence.FAULTS,
    'Scenes, clocks and names': changes.FAULTS,
    'Goals one after another': lockstep.FAULTS,
    'Nodes that are killed': killed.FAULTS,
    'Many clients, large requests': clients.FAULTS,
    'Generated messages': generated.FAULTS,
    'Recordings': recordings.FAULTS,
    'Weights and disks': weights.FAULTS + disk.FAULTS + recorder_disk.FAULTS,
    'Start, stop, and long runs': start_stop.FAULTS + soak.FAULTS,
}
