# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Pictures of episodes as they were recorded, for people: read one by one, kept nowhere."""

from contextlib import suppress
from functools import lru_cache
from pathlib import Path
import threading

import numpy as np
from tap_ros.base.errors import TapError
from tap_ros.images.crop import Crop
from tap_ros.messages.images import decode_image
from tap_ros.messages.stamps import to_nanoseconds
from tap_ros.recording.cache import EpisodeStore
from tap_ros.recording.mcap_file import McapFile
from tap_ros.recording.messages import decode
from tap_ros.recording.sqlite_file import open_file

_MOST_OPEN = 4  # files; one that was packed as a whole stands in memory


class FullSize:
    """
    The pictures of a store in the size of the camera; safe to use from several threads.

    :param store: EpisodeStore, of any size.
    :param part: of the pictures that is shown, as Crop takes it.
    """

    def __init__(self, store: EpisodeStore, part: str = '') -> None:
        self._store, self._crop = store, Crop(part)
        self._lock = threading.Lock()
        self._file = lru_cache(_MOST_OPEN)(open_file)

    def picture(self, i: int, t: int) -> np.ndarray:
        """
        Return frame t of episode i, (H, W, 3) uint8 rgb.

        That of the store, where the file has no index or cannot be read any more.
        """
        path, topic, log, stamp = self._store.recorded(i, t)
        with suppress(TapError, OSError):
            for kind, data in self._messages(path, topic, log):
                message = decode(kind, data)
                if to_nanoseconds(message.header.stamp) == stamp:
                    return self._crop.image(decode_image(message))
        return self._store.frames(i)[t]

    def _messages(self, path: Path, topic: str, log: int) -> list[tuple[str, memoryview]]:
        with self._lock:
            file: McapFile = self._file(path)
            return file.at(topic, log)
