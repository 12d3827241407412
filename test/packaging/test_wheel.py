# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The wheel that pip makes of the source distribution works outside of the checkout."""

import os
from pathlib import Path
import re
import shutil
import subprocess
import sys

import pytest

ROOT = Path(__file__).parents[2]
PARTS = ('tap_ros', 'sim_bridge', 'config', 'launch', 'resource', 'setup.py', 'setup.cfg',
         'pyproject.toml', 'package.xml', 'README.md', 'LICENSE')
BUILD = 'import sys; from setuptools.build_meta import build_sdist; build_sdist(sys.argv[1])'


@pytest.mark.minutes
def test_the_wheel_predicts_trains_and_plans_outside_of_the_checkout(tmp_path):
    site, sources, empty = (tmp_path / name for name in ('site', 'sources', 'empty'))
    empty.mkdir()
    sources.mkdir()
    for part in PARTS:
        copy = shutil.copytree if (ROOT / part).is_dir() else shutil.copy
        copy(ROOT / part, sources / part)
    (empty / 'bags').symlink_to(ROOT / 'bags')

    def run(*words, cwd=empty):
        # The dependencies are those of the running environment; our packages are not in it.
        environment = os.environ | {'PYTHONPATH': str(site), 'TAP_ROS_CACHE': str(tmp_path)}
        return subprocess.run([sys.executable, *map(str, words)], cwd=cwd, env=environment,
                              text=True, capture_output=True)

    done = run('-c', BUILD, tmp_path, cwd=sources)
    assert done.returncode == 0, done.stderr
    archive, = tmp_path.glob('*.tar.gz')
    done = run('-m', 'pip', 'install', '--no-index', '--no-deps', '--no-build-isolation',
               '--target', site, archive)
    assert done.returncode == 0, done.stderr
    for package in ('tap_ros', 'sim_bridge'):
        assert all((site / path.relative_to(ROOT)).exists() for path in (ROOT / package).rglob('*')
                   if '__pycache__' not in path.parts)

    blocks = re.findall(r'^```python\n(.*?)^```$', (ROOT / 'docs' / 'python.md').read_text(),
                        re.M | re.S)
    script = ''.join(block for block in blocks if 'Client' not in block)
    done = run('-c', f'{script}\nimport sim_bridge, tap_ros\n'
               'print(plan.action.shape, tap_ros.__file__, sim_bridge.__file__)')
    assert done.returncode == 0, done.stderr
    assert done.stdout.splitlines()[-1] == (
        f'(4,) {site}/tap_ros/__init__.py {site}/sim_bridge/__init__.py')
    assert (empty / 'runs' / 'try' / 'predictor.safetensors').exists()

    for module, word in (('tap_ros', 'call'), ('tap_ros', 'demo'), ('tap_ros', 'explore'),
                         ('tap_ros.nodes', 'predictor_node')):
        done = run('-m', module, *filter(None, [word]))
        assert done.returncode == 1 and done.stderr.startswith('error: ')
        assert 'checkout' in done.stderr and done.stderr.count('\n') == 1
