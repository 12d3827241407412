# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Read recordings once, episode by episode."""

from collections.abc import Iterator
from pathlib import Path

from tap_ros.recording.cache import open_recordings
from tap_ros.recording.episode import Episode
from tap_ros.recording.reading import AS_RECORDED, Reading


def iter_episodes(path: str | Path, reading: Reading = AS_RECORDED) -> Iterator[Episode]:
    """Yield the episodes of a recording; parameters and errors are those of open_recordings."""
    yield from open_recordings(path, progress=False, reading=reading)
