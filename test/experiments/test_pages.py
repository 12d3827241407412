# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Laws of how pages, tables and numbers are written."""

from experiments import pages
import numpy as np
import pandas as pd


def test_numbers_keep_their_place_and_what_is_missing_stays_missing():
    rows = pd.DataFrame({'value': [0.5, np.nan, -0.25], 'ci_low': [0.4, np.nan, -0.3],
                         'ci_high': [0.75, np.nan, 0.1]}, index=['a', 'b', 'c'])
    assert pages.number(rows['value'], 0, 100, '+').tolist()[::2] == ['+50', '-25']
    texts = pages.interval(rows, 2)
    assert texts['a'] == '0.50 (0.40 to 0.75)' and texts['c'] == '-0.25 (-0.30 to 0.10)'
    assert texts.isna().tolist() == [False, True, False]
    assert pages.interval(rows.iloc[:0]).empty


def test_a_table_is_markdown_with_something_in_every_cell():
    table = pd.DataFrame({'method': ['fix', 'min'], 'l1': pd.Series(['0.1', None], dtype='string'),
                          'n': [3, 4]})
    assert pages.markdown(table).splitlines() == [
        '| method | l1 | n |', '| --- | ---: | ---: |', '| fix | 0.1 | 3 |', '| min | - | 4 |']
    assert '| min |  | 4 |' in pages.markdown(table, missing='')
