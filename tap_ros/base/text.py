# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Text that comes from outside (messages, files), made fit for a log line or a terminal."""

from collections.abc import Iterable
from difflib import get_close_matches

LIMIT = 200  # characters that are shown of one text


def escaped(text: object, limit: int = LIMIT) -> str:
    """
    Return text in one line: newlines, ESC and all else that does not print as escapes.

    :param text: anything; str() of it is taken.
    :param limit: most characters shown; what is left out is counted.
    """
    text = str(text)
    shown = ''.join(
        c if c.isprintable() else c.encode('unicode_escape', 'backslashreplace').decode()
        for c in text[:limit])
    return shown if len(text) <= limit else f'{shown}... ({len(text) - limit} more)'


def listing(names: Iterable[object], limit: int = 8) -> str:
    """
    Return names in one line, escaped, with commas between.

    :param names: of any number.
    :param limit: most names shown; the others are counted.
    """
    names = list(names)
    shown = ', '.join(escaped(name, 60) for name in names[:limit])
    return shown if len(names) <= limit else f'{shown} and {len(names) - limit} more'


def counted(count: int, noun: str) -> str:
    """Return a count with its noun, such as '1 episode' or '2 episodes'."""
    return f'{count} {noun}' if count == 1 else f'{count} {noun}s'


def meant(name: str, valid: Iterable[str]) -> str:
    """Return "did you mean 'the nearest'? " of valid names; '' where none is near."""
    near = get_close_matches(name, valid, 1)
    return f'did you mean {near[0]!r}? ' if near else ''
