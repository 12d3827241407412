# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The examples of docs/python.md; with those of parts one for each name of tap_ros."""

from pathlib import Path
import re

import tap_ros

DOCS = Path(__file__).parents[1] / 'docs'
PAGE = (DOCS / 'python.md').read_text()
SHOWN = PAGE + (DOCS / 'extending.md').read_text() + ''.join(
    path.read_text() for path in DOCS.parent.glob('examples/**/*.py'))
BLOCKS = re.findall(r'^```python\n(.*?)^```$', PAGE, re.M | re.S)


def test_the_examples_run_and_have_every_name(tmp_path, monkeypatch, capsys):
    for name in set(tap_ros.__all__) - {'iter_episodes'}:  # open_recordings does for all
        assert re.search(rf'^from tap_ros import .*\b{name}\b', SHOWN, re.M), name
    (tmp_path / 'bags').symlink_to(Path(__file__).parents[1] / 'bags')
    monkeypatch.chdir(tmp_path)
    names = {}
    for block in BLOCKS:
        if 'Client' not in block:  # test_client.py runs that with nodes
            exec(block, names)  # one after the other, as somebody would type them
    assert 'push5' in capsys.readouterr().out
