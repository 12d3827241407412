# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Text from outside cannot forge lines or colours."""

import pytest
from tap_ros.text import escaped, listing


@pytest.mark.parametrize('text', [
    'a\nb', 'a\rb', '\x1b[31mred', 'a\x00b', 'a\x85b', 'a\u2028b', 'a\u202eb', 'a\ud800b', '\x9b'])
def test_what_does_not_print_is_escaped(text):
    shown = escaped(text)
    assert shown.isprintable() and '\\' in shown
    assert len(f'{shown}'.splitlines()) == 1


def test_what_prints_stays():
    assert escaped('object 3, größer, 物') == 'object 3, größer, 物'


def test_long_texts_and_lists_are_cut_and_counted():
    assert escaped('x' * 1000) == 'x' * 200 + '... (800 more)'
    assert listing(['a', 'b\n', 'c'], limit=2) == 'a, b\\n and 1 more'
    assert listing([]) == ''
