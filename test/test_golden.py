# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Predictions, plans, a closed loop, bags and trainings are, bit for bit, what they were."""

from pathlib import Path
import subprocess
import sys

import pytest

ROOT = Path(__file__).parents[1]


@pytest.mark.minutes
def test_digests_are_as_before():
    run = subprocess.run([sys.executable, ROOT / 'scripts' / 'golden.py'], cwd=ROOT, text=True,
                         capture_output=True)
    if run.returncode == 2:
        pytest.skip(run.stdout.splitlines()[-1])
    assert run.returncode == 0, run.stdout[-3000:] + run.stderr[-3000:]
