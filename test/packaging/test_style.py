# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Style that a machine can check."""

from pathlib import Path
import subprocess
import sys

import pytest

ROOT = Path(__file__).parents[2]
FOLDERS = ('tap_ros', 'sim_bridge', 'experiments', 'test', 'launch', 'scripts')
FILES = [ROOT / 'setup.py', ROOT / 'docs' / 'conf.py',
         *(path for folder in FOLDERS for path in sorted((ROOT / folder).rglob('*.py')))]
HEADER = ['# Copyright 2026 The tap_ros authors', '# SPDX-License-Identifier: Apache-2.0']


def test_ruff_finds_nothing():
    run = subprocess.run([sys.executable, '-m', 'ruff', 'check', '--no-cache', '.'], cwd=ROOT,
                         text=True, stdout=subprocess.PIPE)
    assert run.returncode == 0, run.stdout


@pytest.mark.parametrize('path', FILES, ids=lambda path: str(path.relative_to(ROOT)))
def test_header_names_authors_and_license(path):
    assert path.read_text().splitlines()[:2] == HEADER
