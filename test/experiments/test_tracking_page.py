# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The page on tracking says what its data say."""

import json
from pathlib import Path

from experiments import tracking

RESULTS = Path(__file__).parents[2] / 'docs' / 'results'


def test_the_page_is_made_from_the_data():
    found = json.loads((RESULTS / 'tracking.json').read_text())
    pushed = tracking.loop(RESULTS / 'tracking')
    assert tracking.page(found, pushed) == (RESULTS / 'tracking.md').read_text()
