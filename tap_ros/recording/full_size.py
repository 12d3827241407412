# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Pictures of episodes as they were recorded, for people: read one by one, kept nowhere."""

from contextlib import suppress
import threading

import numpy as np
from tap_ros.base.errors import TapError
from tap_ros.images.crop import Crop
from tap_ros.messages.images import decode_image
from tap_ros.messages.stamps import to_nanoseconds
from tap_ros.recording.cache import EpisodeStore
from tap_ros.recording.mcap_file import McapFile
from tap_ros.recording.messages import decode


class FullSize:
    """
    The pictures of a store in the size of the camera; safe to use from several threads.

    :param store: EpisodeStore, of any size.
    :param part: of the pictures that is shown, as Crop takes it.
    """

    def __init__(self, store: EpisodeStore, part: str = '') -> None:
        self._store, self._crop = store, Crop(part)
        self._lock = threading.Lock()
        self._newest: McapFile | None = None  # read; one that was packed as a whole is in memory

    def picture(self, i: int, t: int) -> np.ndarray:
        """
        Return frame t of episode i, (H, W, 3) uint8 rgb.

        That of the store, where the file has no index or cannot be read any more.
        """
        path, topic, log, stamp = self._store.recorded(i, t)
        with suppress(TapError, OSError):
            with self._lock:
                file = self._store.bag(i).file(path)
                if self._newest not in (None, file):
                    self._newest.close()
                self._newest = file
                messages = file.at(topic, log)
            for kind, data in messages:
                message = decode(kind, data)
                if to_nanoseconds(message.header.stamp) == stamp:
                    return self._crop.image(decode_image(message))
        return self._store.frames(i)[t]
