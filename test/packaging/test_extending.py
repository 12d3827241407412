# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The skeletons of docs/extending.md, copied out into a package and run as they stand."""

import os
from pathlib import Path
import re
import subprocess
import sys
import tomllib

import pytest
from tap_ros.base.plugins import BUILT_IN

ROOT = Path(__file__).parents[2]
PAGE = (ROOT / 'docs' / 'extending.md').read_text()
FILES = re.findall(r'^```python\n# (\S+)\n(.*?)^```$', PAGE, re.M | re.S)
LISTED = tomllib.loads(re.search(r'^```toml\n(.*?)^```$', PAGE, re.M | re.S)[1])[
    'project']['entry-points']


def test_each_part_has_a_skeleton_a_test_and_a_name():
    assert set(LISTED) == set(BUILT_IN)
    parts = {place.partition(':')[0].rpartition('.')[2]
             for group in LISTED.values() for place in group.values()}
    assert [name for name, _ in FILES] == [
        name for part in re.findall(r'my_package/(\w+)\.py', PAGE)
        for name in (f'my_package/{part}.py', f'test_{part}.py')]
    assert parts == {Path(name).stem for name, _ in FILES if '/' in name}


@pytest.mark.slow
def test_the_skeletons_run_and_are_found_by_name(tmp_path):
    for name, text in FILES:
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_text(text)
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
