# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What the pages say can be run, followed and found."""

from contextlib import suppress
from importlib import import_module
import os
from pathlib import Path
import re
import shlex
import subprocess
import sys

import cv2
import numpy as np
import pytest
import tap_ros
from tap_ros.apps.cli import read
from tap_ros.base.errors import TapError
import yaml

ROOT = Path(__file__).parents[2]
WRITTEN = [ROOT / 'README.md', ROOT / 'CONTRIBUTING.md', ROOT / 'bags' / 'README.md',
           ROOT / 'QUALITY_DECLARATION.md', ROOT / 'SECURITY.md',
           *sorted((ROOT / 'docs').glob('*.md'))]
PAGES = [*WRITTEN, *(page for page in sorted((ROOT / 'docs' / 'results').glob('*.md'))
                     if not page.stem.endswith('findings'))]  # those are parts of pages
SOURCES = [path for folder in ('tap_ros', 'sim_bridge', 'experiments', 'test', 'launch', 'scripts')
           for path in sorted((ROOT / folder).rglob('*.py'))] + [ROOT / 'setup.py']
# `folder/file.py`, or `file.py: function, Class.method`
REFERENCE = re.compile(r'`((?:[\w-]+/)*\w+\.py)(?:: ([\w., ]+))?`')


def of(page):
    """Return the name of a page for a test's id."""
    return str(page.relative_to(ROOT))


def anchors(page):
    """Return the anchors that GitHub gives to the headings of a page."""
    headings = re.findall(r'^#+ (.+)$', page.read_text(), re.M)
    return {re.sub(r'[^\w\- ]', '', heading.lower()).replace(' ', '-') for heading in headings}


def test_the_python_of_the_readme_runs_and_prints_what_it_says(tmp_path):
    page = (ROOT / 'README.md').read_text()
    block, = re.findall(r'^```python\n(.*?)^```$', page, re.M | re.S)
    written = {f'{name}.png' for name in re.findall(r"\('(\w+)', \w+\)", block)}
    made = re.findall(r'-m tap_ros predict .*--out (\S+)', page)
    assert 'subgoal.png' in written and made and written.isdisjoint(made)
    (tmp_path / 'bags').symlink_to(ROOT / 'bags')
    path = os.pathsep.join([str(ROOT), os.environ.get('PYTHONPATH', '')])
    run = subprocess.run([sys.executable, '-c', block], cwd=tmp_path, capture_output=True,
                         env=os.environ | {'PYTHONPATH': path}, text=True)
    assert run.returncode == 0, run.stderr
    said, = re.findall(r'print\(.*# (\[\[.*\]\])', block)
    assert run.stdout.split() == said.split()
    assert cv2.imread(str(tmp_path / 'subgoal.png')).shape == (256, 256, 3)


def test_the_clicks_of_the_page_are_on_the_objects_that_the_simulator_shows_first():
    page = (ROOT / 'docs' / 'ros.md').read_text()
    asked = yaml.safe_load(re.search(r"SelectObjects '(.*)'", page)[1])
    objects = tap_ros.Simulator('push2').reset(seed=0).object_pixels
    assert abs(np.transpose([asked['u'], asked['v']]) - objects).max() < 1.0


@pytest.mark.parametrize('page', WRITTEN, ids=of)
def test_the_commands_of_the_pages_have_these_options(page):
    for program, words in re.findall(r'^python -m (tap_ros|experiments) (.*)$', page.read_text(),
                                     re.M):
        line = import_module(f'{program}.__main__').LINE
        with suppress(TapError):  # a recording that is not here
            read(line, shlex.split(words, comments=True))


@pytest.mark.slow
def test_the_site_is_built_without_a_warning(tmp_path):
    pytest.importorskip('sphinx', reason='make docs brings it')
    run = subprocess.run(
        [sys.executable, '-m', 'sphinx', '-W', '--keep-going', '-q', '-c', 'docs/site', '.',
         tmp_path],
        cwd=ROOT, capture_output=True, text=True)
    assert run.returncode == 0, run.stderr
    api = (tmp_path / 'docs/site/api.html').read_text()
    assert all(f'tap_ros.{name}' in api for name in tap_ros.__all__)


@pytest.mark.parametrize('page', PAGES, ids=of)
def test_links_lead_somewhere(page):
    for link in re.findall(r'\]\(([^)\s]+)\)', page.read_text()):
        if re.match(r'\w+:', link):
            continue
        name, _, anchor = link.partition('#')
        target = (page.parent / name) if name else page
        assert target.exists(), f'{link} is not there'
        assert not anchor or anchor in anchors(target), f'{link}: no such heading'


@pytest.mark.parametrize('page', WRITTEN, ids=of)
def test_files_functions_and_tests_that_are_named_exist(page):
    for name, inside in REFERENCE.findall(page.read_text()):
        files = [path for path in SOURCES if f'/{of(path)}'.endswith(f'/{name}')]
        assert files, f'{name} is not there'
        for word in filter(None, re.split('[., ]+', inside)):
            assert any(re.search(rf'\b(?:def|class) {word}\b|^{word} = ', path.read_text(), re.M)
                       for path in files), f'{name} has no {word}'


def test_each_step_of_the_ways_is_where_the_page_says():
    text, steps = (ROOT / 'docs/architecture.md').read_text(), 0
    for block in re.findall(r'^```\n(.*?)^```$', text, re.M | re.S):
        for said, place in re.findall(r'^ *(?:-> )?(\S.*?) {2,}([\w/]+\.py)', block, re.M):
            source = (ROOT / place).read_text()
            names = re.match(r'((?:[A-Za-z_][\w.]*)(?:, [A-Za-z_]\w*)*):', said)
            for name in re.split(r'[., ]+', names.group(1)) if names else ():
                assert re.search(rf'^\s*(?:def|class) {name}\b|^{name} = ', source, re.M), (
                    name, place)
                steps += 1
    assert steps > 20
