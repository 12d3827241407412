# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The folder of a training run: one process writes to it, and a full disk is told in one line."""

from collections.abc import Iterator, Mapping, Sized
from contextlib import contextmanager
import json
from pathlib import Path
import platform
import threading
from typing import Any, TYPE_CHECKING

from tap_ros.files import only_writer, storage_errors, write_atomically
from tap_ros.training.checkpoints import TrainingState
from tap_ros.training.devices import device_name
import torch

if TYPE_CHECKING:
    from tap_ros.recording.cache import EpisodeStore


@contextmanager
def run_folder(folder: str | Path) -> Iterator[None]:
    """
    Write to the folder of a training run, as the only process.

    :param folder: made if it is not there.
    :raises StorageError: when another process trains there, or it cannot be written.
    """
    def tell(failed: threading.ExceptHookArgs) -> None:
        # The thread that writes the curves; its error is raised where the next point is added.
        if not isinstance(failed.exc_value, OSError):
            before(failed)

    with only_writer(folder), storage_errors(folder):
        before, threading.excepthook = threading.excepthook, tell
        try:
            yield
        finally:
            threading.excepthook = before


def run_facts(state: TrainingState[Any], seed: int, store: 'EpisodeStore', training: Sized,
              held_out: Sized) -> dict[str, Any]:
    """
    Return what is known of a run, for run.json and the weights file.

    :param state: checkpoints.TrainingState.
    :param seed: of the run.
    :param store: EpisodeStore; training, held_out: indices of its episodes.
    :return: dict that JSON can hold.
    """
    device = device_name(next(state.network.parameters()).device)
    chosen = {'precision': state.precision} if state.precision else {}
    return chosen | {
        'steps': state.step, 'seconds': round(state.seconds, 1), 'seed': seed,
        'data_hash': store.data_hash,
        'camera_size': list(store.camera_size) if store.camera_size else None,
        'episodes': len(training), 'held_out': len(held_out),
        'machine': f'{platform.machine()}, {torch.get_num_threads()} threads, {device}',
        'torch': torch.__version__, 'python': platform.python_version()}


def describe_run(folder: str | Path, **files: Mapping[str, Any]) -> None:
    """
    Write what a run was.

    :param folder: of the run.
    :param files: name without .json to what stands in the file.
    """
    for name, values in files.items():
        write_atomically(Path(folder, f'{name}.json'), json.dumps(values, indent=2) + '\n')
