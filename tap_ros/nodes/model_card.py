# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The model cards of the weights that a node has loaded, for recorders and for people."""

from collections.abc import Iterable
from contextlib import suppress
from pathlib import Path

from tap_ros.errors import WeightsError
from tap_ros.recording.attachments import MAX_CARD_BYTES
from tap_ros.text import escaped
from tap_ros.training.weights import stored_digest


def describe_weights(files: Iterable[Path]) -> str:
    """
    Return the model cards of weights, and the SHA-256 of their content.

    :param files: that a node has loaded.
    """
    return '\n'.join(map(_describe, files))


def _describe(weights: Path) -> str:
    """Return the card beside a file, if there is one, and a line that tells the file."""
    name = escaped(weights.name)
    text = f'# {name}\n\nNo model card is beside this file.\n'
    card = weights.with_suffix('.md')
    with suppress(OSError, ValueError):  # ValueError: it is no text
        if card.is_file() and card.stat().st_size <= MAX_CARD_BYTES // 4:
            text = card.read_text(encoding='utf-8')
    digest = 'unknown'
    with suppress(WeightsError):  # it was there when it was loaded
        digest = stored_digest(weights)
    return f'{text.rstrip()}\n\nLoaded: `{name}`, SHA-256 of its content `{digest}`.\n'
