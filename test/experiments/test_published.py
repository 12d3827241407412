# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The paper's numbers agree with each other, and with what the pages cite."""

from pathlib import Path
import re

from experiments.paper import published
import pytest

ROOT = Path(__file__).parents[2]
README, REPRODUCTION = ((ROOT / name).read_text() for name in
                        ('README.md', 'docs/reproduction.md'))


@pytest.mark.parametrize('task', published.TABLE_1)
def test_the_gains_of_the_text_are_those_of_table_1(task):
    rows = published.TABLE_1[task]
    assert published.GAINS[task] == pytest.approx(
        1 - rows['genmin'][0] / rows['fix'][0], abs=1e-3)
    # Section 4: best of 100 samples is below every method without samples in two tasks.
    best = rows['genmin-vae-best-of-100'][0]
    others = min(row[0] for name, row in rows.items() if 'best' not in name)
    assert (best < others) == (task != 'grasp')


def paper_column(page, title):
    """Return the cells of a table's column in the row that begins so, as numbers."""
    row = next(line for line in page.splitlines() if line.startswith(f'| {title} |'))
    return [float(number) for number in re.findall(r'[\d.]+', row.split('|')[2])]


@pytest.mark.parametrize('title, value', [
    ('bottlenecks predicted at 2 px, two objects: `genmin`',
     100 * published.BOTTLENECK_2PX['genmin']),
    ('the same: fixed time (`fix`)', 100 * published.BOTTLENECK_2PX['fix']),
    ('final distance, two objects: direct', published.TABLE_2['push2', 'direct'][0]),
    ('final distance, three objects: direct', published.TABLE_2['push3', 'direct'][0])])
def test_the_readme_cites_the_paper(title, value):
    assert paper_column(README, title) == pytest.approx([value])


@pytest.mark.parametrize('title, method', [
    ('direct', 'direct'), ('via the subgoal of `fix`', 'fix'),
    ('via the subgoal of `genmin`', 'genmin')])
def test_the_comparison_cites_table_2(title, method):
    row = next(line for line in REPRODUCTION.splitlines() if line.startswith(f'| {title} | 1'))
    cells = row.split('|')
    assert (float(cells[2]), float(cells[4])) == tuple(
        published.TABLE_2[task, method][0] for task in ('push2', 'push3'))
