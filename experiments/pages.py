# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Pages in Markdown: sentences stand in templates of Jinja2, tables come from pandas."""

from pathlib import Path
import re

from jinja2 import Environment, FileSystemLoader, StrictUndefined


def render(template, **values):
    """Fill a template of experiments/; one empty line is left where there are several."""
    text = _ENVIRONMENT.get_template(template).render(values)
    return re.sub(r'\n{3,}', '\n\n', text.strip('\n')) + '\n'


def markdown(table, left=1):
    """Write a DataFrame, '-' for nothing; so many columns are aligned to the left."""
    cells = table.astype(object).where(table.notna(), '-')
    rule = ['---' if i < left else '---:' for i in range(table.shape[1])]
    return '\n'.join(f'| {" | ".join(map(str, line))} |'
                     for line in [table.columns, rule, *cells.to_numpy()])


def share(found):
    """Write a share and its interval, (value, low, high) from 0 to 1, as '40% (37 to 43)'."""
    return '{:.0f}% ({:.0f} to {:.0f})'.format(*(100 * each for each in found))


_ENVIRONMENT = Environment(
    loader=FileSystemLoader(Path(__file__).parent), undefined=StrictUndefined, trim_blocks=True,
    lstrip_blocks=True)
_ENVIRONMENT.filters.update(markdown=markdown)
