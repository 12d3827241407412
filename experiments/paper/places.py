# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Where recordings, runs and results are, and who may write to them."""

from dataclasses import dataclass
import hashlib
import json
from pathlib import Path

from tap_ros.errors import RecordingError
from tap_ros.recording.bags import find_bags
from tap_ros.recording.writer import count_episodes

_SETTINGS = 'collection.json'  # as sim_bridge.collect leaves it


@dataclass(frozen=True)
class Places:
    """
    The folders of a sweep.

    :param recordings: holds a recording for each task, under the task's name.
    :param runs: <scale>/<run>/ holds what a training leaves.
    :param results: for the pages and their data; runs/<scale>/<run>.json is that of a run.
    """

    recordings: str = 'bags'
    runs: str = 'runs/paper'
    results: str = 'docs/results'

    def recording(self, task):
        """Return the Path of a task's recording."""
        return Path(self.recordings) / task

    def result(self, run):
        """Return the Path of the result of a PaperRun."""
        return Path(self.results) / 'runs' / run.scale / f'{run.name}.json'


def read_json(path):
    """Read a JSON file; None where there is none that can be read."""
    try:
        return json.loads(Path(path).read_text())
    except (OSError, ValueError):
        return None


def is_collected(folder, episodes):
    """
    Say whether a recording is there, complete.

    :param folder: of the recording.
    :param episodes: how many it has to hold at least; a recording that `collect` did not make is
        taken as it is.
    :return: bool.
    """
    settings = read_json(Path(folder) / _SETTINGS)
    if settings is None:
        try:
            return bool(find_bags(folder))
        except RecordingError:
            return False
    if settings['episodes'] < episodes or not (Path(folder) / 'metadata.yaml').exists():
        return False
    try:
        found = sum(map(count_episodes, Path(folder).glob('*.mcap')))
    except RecordingError:
        return False
    return found >= settings['episodes']


def collected_episodes(folder):
    """Say how many episodes a folder was asked to hold, 0 if `collect` never wrote to it."""
    return (read_json(Path(folder) / _SETTINGS) or {'episodes': 0})['episodes']


def file_hash(path):
    """Return the SHA-256 of a file, in hexadecimal digits."""
    with open(path, 'rb') as stream:
        return hashlib.file_digest(stream, 'sha256').hexdigest()


def recording_hash(folder):
    """Compute EpisodeStore.data_hash of a recording without decoding anything."""
    digests = [file_hash(file) for bag in find_bags(folder) for file in bag]
    return hashlib.sha256(''.join(digests).encode()).hexdigest()
