# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The table of faults says what came of the trials."""

import json
import re

from fault_report import fault, page, ROOT, save, Trials
import pytest

RESULTS = ROOT / 'docs' / 'results'


def test_the_page_is_made_from_the_rows():
    rows = json.loads((RESULTS / 'faults.json').read_text())
    text = (RESULTS / 'faults.md').read_text()
    assert page(rows) == text
    lines = re.findall(r'^- \*\*.*', text, re.M)
    missed = sum('. **' in line for line in lines)
    assert (f'Of {len(lines)} kinds of faults {len(lines) - missed} end as they should in all '
            'trials' in (RESULTS / 'README.md').read_text())


def test_a_trial_holds_unless_something_is_raised(tmp_path):
    trials = Trials(fault('a cut', 'it is read', 40, 's').kwargs, share=0.1, patience=1.0)
    for trial in trials:
        with trials.one():
            trials.measured(trial)
            assert trial != 3, f'no luck with {trial}'
    save(tmp_path, trials.row('cut'))
    save(tmp_path, trials.row('cut', KeyError('x')))  # takes its place
    row, = json.loads((tmp_path / 'faults.json').read_text())
    assert (row['tried'], row['held'], row['figure']) == (5, 3, 3.0)
    assert 'no luck with 3' in row['why_not'] and 'KeyError' in row['why_not']
    assert '- **a cut**: it is read. **3/5**; 3 s; ' in (tmp_path / 'faults.md').read_text()
    with trials.one(), pytest.raises(ValueError):
        raise ValueError('what was expected')
    assert trials.held == 4
