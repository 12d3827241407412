# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
The linters of ament find nothing, where they are installed: with ROS 2 from apt they are.

ament_copyright is not among them: it knows no SPDX line. test_style.py checks both lines.
"""

from importlib.util import find_spec
from pathlib import Path
import shutil
import subprocess
import sys

import pytest

ROOT = Path(__file__).parents[2]
CODE = ('tap_ros', 'sim_bridge', 'experiments', 'test', 'launch', 'scripts', 'setup.py',
        'docs/conf.py')
CHECKED = {
    'ament_flake8': CODE,
    'ament_pep257': CODE,
    'ament_xmllint': ('package.xml', 'tap_msgs/package.xml', 'tap_ros'),
}
OPTIONS = {  # .flake8 gives the reasons
    'ament_flake8': ('--config', '.flake8'),
    'ament_pep257': ('--add-ignore', 'D401', 'D402'),
    'ament_xmllint': (),
}


def lint(name, *paths):
    """
    Run a linter from the folder of the package.

    :return: its exit status and what it printed; the test is skipped where it cannot be run.
    """
    if find_spec(name) is None:
        pytest.skip(f'{name} is not there')
    if name == 'ament_xmllint' and shutil.which('xmllint') is None:
        pytest.skip('xmllint is not there')
    run = subprocess.run(
        [sys.executable, '-m', f'{name}.main', *map(str, paths), *OPTIONS[name]], cwd=ROOT,
        text=True, stdout=subprocess.PIPE, stderr=subprocess.STDOUT)
    if 'Failed to locate the main schema resource' in run.stdout:
        pytest.skip('the schema of package.xml is out of reach')
    return run.returncode, run.stdout


@pytest.mark.parametrize('name', CHECKED)
def test_ament_finds_nothing(name):
    status, output = lint(name, *CHECKED[name])
    assert status == 0, output.partition('\nChecked files:')[0]


@pytest.mark.parametrize('name, file, text', [
    ('ament_flake8', 'wrong.py', 'import sys\nimport os\nprint(os, sys)\n'),
    ('ament_pep257', 'wrong.py', '"""no capital, no full stop"""\n'),
    ('ament_xmllint', 'wrong.xml', '<package>\n'),
])
def test_ament_would_find_what_is_wrong(tmp_path, name, file, text):
    (tmp_path / file).write_text(text)
    status, output = lint(name, tmp_path / file)
    assert status == 1, output
