# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The skeletons that docs/extending.md names, copied as a package and run as they stand."""

import os
from pathlib import Path
import shutil
import subprocess
import sys
import tomllib

import pytest
from tap_ros.base.plugins import BUILT_IN

ROOT = Path(__file__).parents[2]
EXAMPLES = ROOT / 'examples'
LISTED = tomllib.loads((EXAMPLES / 'pyproject.toml').read_text())['project']['entry-points']


def test_each_part_has_a_skeleton_a_test_and_a_name():
    assert set(LISTED) == set(BUILT_IN)
    page = (ROOT / 'docs' / 'extending.md').read_text()
    for group in LISTED.values():
        (name, place), = group.items()
        part = place.partition(':')[0].replace('.', '/')
        for file in (f'{part}.py', f'test_{Path(part).name}.py'):
            assert (EXAMPLES / file).exists() and f'](../examples/{file})' in page, file
        assert any(use in page for use in (f':={name}', f"'{name}:")), name


@pytest.mark.slow
def test_the_skeletons_run_and_are_found_by_name(tmp_path):
    shutil.copytree(EXAMPLES, tmp_path, dirs_exist_ok=True)
    about = tmp_path / 'my_package-1.0.dist-info'
    about.mkdir()
    (about / 'METADATA').write_text('Metadata-Version: 2.1\nName: my-package\nVersion: 1.0\n')
    (about / 'entry_points.txt').write_text('\n'.join(
        f'[{group}]\n' + '\n'.join(f'{name} = {place}' for name, place in found.items())
        for group, found in LISTED.items()))
    path = os.pathsep.join([str(tmp_path), str(ROOT), os.environ.get('PYTHONPATH', '')])
    run = subprocess.run(
        [sys.executable, '-m', 'pytest', '-q', '-p', 'no:cacheprovider', '.'], cwd=tmp_path,
        env=os.environ | {'PYTHONPATH': path}, text=True, stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT)
    assert run.returncode == 0 and f'{len(BUILT_IN)} passed' in run.stdout, run.stdout
