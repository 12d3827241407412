# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Films with labels by hand, as episodes.

Labels lie in a small JSON file; null where an object is not seen:

    {"films": [
    {"film": "0003/0.mp4", "objects": ["cup", "plate"], "first": 0, "last": 120, "step": 2,
     "labels": {"0": [[101, 60], [150, 90]], "10": [[104, 61], null]}}
    ]}

A film is a path from a folder that is given with them. Pixels are (u, v) of the film's own size;
every step-th frame from the first to the last is looked at; those of the first label are clicked.
"""

from collections.abc import Sequence
import json
from pathlib import Path
from typing import Any

import numpy as np
from tap_ros.errors import ConfigError
from tap_ros.recording.episode import Episode
from tap_ros.recording.formats.pictures import make_episode, video_frames
from tap_ros.text import escaped


def read_films(labels: str | Path, folders: Sequence[str | Path]) -> list[Episode]:
    """
    Read films and their labels.

    :param folders: where the films are looked for.
    :raises ConfigError: for a file that is none of labels, or without films.
    :raises RecordingError: for a film that cannot be read.
    """
    try:
        told = json.loads(Path(labels).read_text())['films']
        return [_film(one, folders) for one in told]
    except (ValueError, LookupError, TypeError) as error:
        raise ConfigError(f'{labels}: expected films with labels, see evaluation/films.py; '
                          f'{escaped(error)}') from error


def _film(told: dict[str, Any], folders: Sequence[str | Path]) -> Episode:
    """Read one film."""
    found = [path for folder in folders if (path := Path(folder, told['film'])).is_file()]
    if not found:
        raise ConfigError(f'{escaped(told["film"])} is in none of the folders of --recordings')
    wanted = range(told.get('first', 0), told['last'] + 1, told.get('step', 1))
    frames = [frame for i, (_, frame) in enumerate(video_frames(found[0])) if i in wanted]
    T, K = len(frames), len(told['objects'])
    pixels = np.full((T, K, 2), np.nan, np.float32)
    for number, places in told['labels'].items():
        for k, place in enumerate(places):
            if place is not None:
                pixels[wanted.index(int(number)), k] = place
    return make_episode(frames, np.arange(T) / 10, tuple(told['objects']), object_pixels=pixels,
                        object_source='by hand', task=told['film'])
