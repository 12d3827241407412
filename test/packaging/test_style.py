# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Style that a machine can check: by ruff, and by the linters of ament where ROS 2 is from apt.

ament_copyright is not among them: it knows no SPDX line.
"""

import ast
from importlib.util import find_spec
from pathlib import Path
import re
import shutil
import subprocess
import sys

import pytest

ROOT = Path(__file__).parents[2]
FOLDERS = ('tap_ros', 'sim_bridge', 'experiments', 'test', 'launch', 'scripts', 'examples')
FILES = ('setup.py', 'docs/conf.py', 'docs/site/conf.py')
HEADER = ['# Copyright 2026 The tap_ros authors', '# SPDX-License-Identifier: Apache-2.0']
CHECKS = {  # .flake8 gives the reasons of the options
    'ruff': ('check', '--no-cache', '.'),
    'ament_flake8.main': ('--config', '.flake8', *FOLDERS, *FILES),
    'ament_pep257.main': (*FOLDERS, *FILES, '--add-ignore', 'D401', 'D402'),
    'ament_xmllint.main': ('package.xml', 'tap_msgs/package.xml', 'tap_ros')}


@pytest.mark.parametrize('name', CHECKS)
def test_linters_find_nothing(name):
    if find_spec(name.split('.')[0]) is None or 'xml' in name and not shutil.which('xmllint'):
        pytest.skip(f'{name} is not there')
    run = subprocess.run([sys.executable, '-m', name, *CHECKS[name]], cwd=ROOT, text=True,
                         stdout=subprocess.PIPE, stderr=subprocess.STDOUT)
    if 'Failed to locate the main schema resource' in run.stdout:
        pytest.skip('the schema of package.xml is out of reach')
    assert run.returncode == 0, run.stdout.partition('\nChecked files:')[0]


def test_docstrings_say_shapes_and_errors_instead_of_where_else_they_stand():
    said = [f'{path}: {text[:60]}' for folder in FOLDERS[:2]
            for path in (ROOT / folder).rglob('*.py')
            for node in ast.walk(ast.parse(path.read_text()))
            if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef)
            and (text := ast.get_docstring(node)) and re.search(
                r'[Ll]ikewise|see (Predictor|ForwardModel|World|Tracker)\b', text)]
    assert not said


def test_headers_name_authors_and_license():
    paths = [*map(ROOT.joinpath, FILES), *(
        path for folder in FOLDERS for path in (ROOT / folder).rglob('*.py'))]
    assert not [path for path in paths if path.read_text().splitlines()[:2] != HEADER]
