# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What the cache knows of files: their SHA-256, and what was found out of their content."""

from collections.abc import Callable
from contextlib import suppress
import hashlib
import json
import os
from pathlib import Path
import time
from typing import Any

from tap_ros.base.errors import RecordingError
from tap_ros.recording.raw_files import bytes_of, parts_of, stats_of

FORMAT = 11  # of the cache; another number makes all files be decoded again
ENVIRONMENT = 'TAP_ROS_CACHE'
_SETTLED_NS = 2 * 10**9  # a file changed later may change again and show the same time


def cache_folder() -> Path:
    """Return the folder of the cache: $TAP_ROS_CACHE or ~/.cache/tap_ros."""
    return Path(os.environ.get(ENVIRONMENT) or '~/.cache/tap_ros').expanduser()


def digest_of(cache: Path, path: Path) -> str:
    """Return the SHA-256 of a file; of one that was read before and not changed since, as then."""
    if not path.is_file():
        bytes_of(path)  # says why it cannot be read

    def read() -> str:
        try:
            with open(path, 'rb') as stream:
                digest = hashlib.file_digest(stream, 'sha256')
            for log in parts_of(path)[1:]:
                digest.update(log.read_bytes())
            return digest.hexdigest()
        except OSError as error:
            raise RecordingError(f'{path}: cannot be read: {error.strerror}') from error

    stats = stats_of(path)
    if time.time_ns() - max(max(one[2:]) for one in stats) < _SETTLED_NS:
        return read()
    return str(remembered(cache, ['file', str(path.resolve()), stats], read))


def remembered(cache: Path, key: list[Any], find: Callable[[], Any]) -> Any:
    """Return what was found before by a key; else find and keep it. JSON holds both."""
    path = cache / 'known' / hashlib.sha256(json.dumps([FORMAT, *key]).encode()).hexdigest()
    with suppress(OSError, ValueError):
        return json.loads(path.read_text())
    value = find()
    with suppress(OSError):  # who decodes into the cache says so
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(json.dumps(value))
    return value
