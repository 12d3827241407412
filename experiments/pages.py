# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Pages in Markdown: sentences stand in templates of Jinja2, tables come from pandas."""

from pathlib import Path
import re

from jinja2 import Environment, FileSystemLoader, StrictUndefined


def render(template, **values):
    """
    Fill a template.

    :param template: its path in experiments/.
    :param values: what it names.
    :return: Markdown, with one empty line where the template leaves several.
    :raises jinja2.UndefinedError: if it names something else.
    """
    text = _ENVIRONMENT.get_template(template).render(values)
    return re.sub(r'\n{3,}', '\n\n', text.strip('\n')) + '\n'


def markdown(table, left=1, missing='-', also_left=()):
    """
    Write a table.

    :param table: DataFrame; its index is not shown.
    :param left: so many columns are aligned to the left, the others to the right.
    :param missing: stands in cells that have nothing.
    :param also_left: names of further columns that are aligned to the left.
    """
    cells = table.astype(object).where(table.notna(), missing)
    rule = ['---' if i < left or name in also_left else '---:'
            for i, name in enumerate(table.columns)]
    return '\n'.join(f'| {" | ".join(map(str, line))} |'
                     for line in [table.columns, rule, *cells.to_numpy()])


def number(values, digits=4, unit=1, sign=''):
    """
    Write numbers.

    :param values: Series; NaN stays.
    :param digits: behind the point.
    :param unit: is multiplied with.
    :param sign: '+' to write that, too.
    :return: Series of strings.
    """
    texts = (values * unit).map(f'{{:{sign}.{digits}f}}'.format, na_action='ignore')
    return texts.astype('string')


def interval(rows, digits=4, unit=1, sign='', after='', form='{}{} ({} to {})'):
    """
    Write values with their intervals, such as '0.0123 (0.0120 to 0.0126)'.

    :param rows: DataFrame with columns value, ci_low, ci_high; lines of NaN stay.
    :param digits, unit, sign: as for number.
    :param after: stands behind the value.
    :param form: of value, after, low and high.
    :return: Series of strings.
    """
    parts = [number(rows[name], digits, unit, sign) for name in ('value', 'ci_low', 'ci_high')]
    texts = [form.format(value, after, low, high) for value, low, high in zip(*parts)]
    return parts[0].mask(parts[0].notna(), texts)


def share(found):
    """Write a share and its interval, (value, low, high) from 0 to 1, as '40% (37 to 43)'."""
    return '{:.0f}% ({:.0f} to {:.0f})'.format(*(100 * each for each in found))


_ENVIRONMENT = Environment(
    loader=FileSystemLoader(Path(__file__).parent), undefined=StrictUndefined, trim_blocks=True,
    lstrip_blocks=True)
_ENVIRONMENT.filters.update(markdown=markdown)
