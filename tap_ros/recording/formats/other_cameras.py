# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What cameras beside the first one saw, kept on topics of their own."""

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from itertools import chain, count
import re
from typing import Any

import numpy as np
from tap_ros.base.errors import RecordingError
from tap_ros.base.text import escaped
from tap_ros.messages.topics import camera_view
from tap_ros.recording.formats.pictures import Skipped
from tap_ros.recording.trust import MOST_BYTES, MOST_FRAMES


class OtherCamera:
    """
    What a camera beside the first one saw.

    :param key: its name in the files.
    :ivar count: pictures so far.
    """

    def __init__(self, key: str) -> None:
        self.key, self.count = key, 0

    def view(self, read: Callable[[], Iterable[Any]], rows: np.ndarray,
             decode: Callable[[Any], np.ndarray], skipped: Skipped,
             place: str) -> Iterator[np.ndarray | None]:
        """
        Yield the pictures of the rows (T,) of an episode; None for those of no use.

        :param read: returns all rows of its own; decode: makes a picture of one.
        """
        wanted, size = set(rows.tolist()), 0
        with skipped.errors_of('view', f'{place} of {escaped(self.key, 60)}'):
            for row, each in enumerate(read()):
                if row not in wanted:
                    continue
                picture = None
                with skipped.errors_of('picture', f'{row} of {place}, {escaped(self.key, 60)}'):
                    picture = decode(each)
                    size += picture.nbytes
                if row >= MOST_FRAMES or size > MOST_BYTES:
                    raise RecordingError(f'it has more than {MOST_BYTES >> 30} GiB; keep less of '
                                         'each picture (--size)')
                self.count += picture is not None
                yield picture


def other_cameras(keys: Sequence[str]) -> dict[str, OtherCamera]:
    """Return each camera but the first by the name that its topic gets."""
    return dict(zip(view_names(keys[1:]), map(OtherCamera, keys[1:])))


def print_views(others: Mapping[str, Any]) -> None:
    """Print of each other camera, by its topic's name, how many pictures there were."""
    for name, one in others.items():
        print(f'{camera_view(name).recorded}: {one.count} pictures of {escaped(one.key)}')


def view_names(keys: Iterable[str]) -> list[str]:
    """Return a name that a topic can have for each camera, by the last part of its feature."""
    names = ['camera']  # the first one's own
    for key in keys:
        name = re.sub('[^A-Za-z0-9]+', '_', key.rpartition('.')[2])[:40].strip('_')
        name = name if name[:1].isalpha() else f'view_{name}'.rstrip('_')
        tries = chain([name], (f'{name}_{number}' for number in count(2)))
        names.append(next(one for one in tries if one not in names))
    return names[1:]
