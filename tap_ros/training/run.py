# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
The run that every training is: steps, curves, scores and checkpoints, in a folder of its own.

A training hands `run` a function that makes its Course: its networks and batches, and what a step
and a score are.
"""

from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field
from functools import cached_property
import hashlib
import json
from pathlib import Path
import platform
import signal
import sys
import threading
import time
from typing import Any, Generic, TypeVar

import numpy as np
from tap_ros.errors import RecordingError
from tap_ros.files import only_writer, storage_errors, write_atomically
from tap_ros.recording.bags import check_first_picture, find_bags
from tap_ros.recording.cache import EpisodeStore, open_recordings
from tap_ros.recording.reading import reading_of
from tap_ros.training.checkpoints import load_checkpoint, save_checkpoint, start, TrainingState
from tap_ros.training.devices import device_name, pick_device
from tap_ros.training.inpainted import with_masks
from tap_ros.training.split import split_episodes, warn_if_few
from tap_ros.training.weights import save_weights
import torch
from torch.utils.tensorboard import SummaryWriter
from tqdm import tqdm

Trained = TypeVar('Trained', bound=torch.nn.Module)
Item = TypeVar('Item')  # what a step takes
Numbers = Mapping[str, float]


@dataclass(frozen=True)
class Run:
    """
    What a Course is made from.

    :param config: the settings, a dataclass that has those of RunSettings, OptimizerSettings and
        Reading.
    :param kind: of the weights file, 'predictor' or 'forward_model'.
    :param training: indices of the episodes to train on; held_out: of those to score.
    """

    config: Any
    kind: str
    device: torch.device
    store: EpisodeStore
    training: np.ndarray
    held_out: np.ndarray
    progress: bool

    @cached_property
    def data_hash(self) -> str:
        """What tells from which data a checkpoint is: recordings, and marks if there are."""
        marks = getattr(self.config, 'marks', '')
        if not marks or not Path(marks).is_file():  # who reads them says so
            return self.store.data_hash
        return hashlib.sha256(
            self.store.data_hash.encode() + Path(marks).read_bytes()).hexdigest()

    @property
    def checkpoint(self) -> Path:
        """Where the state of the run is kept."""
        return Path(self.config.out) / 'checkpoint.safetensors'

    def begin(self, network: Trained, helpers: Mapping[str, torch.nn.Module],
              todays: Callable[[dict[str, Any]], dict[str, Any]]) -> TrainingState[Trained]:
        """
        Begin, or go on from the checkpoint.

        :param network: with fresh weights; helpers: see checkpoints.start.
        :param todays: makes settings of earlier versions into those of today.
        """
        state = start(network, self.config.learning_rate, self.device, helpers)
        load_checkpoint(self.checkpoint, state, asdict(self.config), self.data_hash, todays)
        return state


@dataclass(frozen=True)
class Course(Generic[Trained, Item]):
    """
    How one kind of network is trained.

    :param batches: function of the first step and the one after the last to what each step takes.
    :param step: moves the weights once; returns a function to the numbers that curves show of it.
        The first two are on the progress bar.
    :param score: makes the scores of the averaged network and pictures (H, W, 3), both by name.
    :param about: what else the weights file tells of the run; what JSON can hold.
    :param patience: steps after which the run ends if the score 'relative', of the held-out
        episodes, has not become smaller; the weights are then those with the smallest. 0: never.
    """

    state: TrainingState[Trained]
    batches: Callable[[int, int], Iterable[Item]]
    step: Callable[[Item], Callable[[], Numbers]]
    score: Callable[[], tuple[Numbers, Mapping[str, np.ndarray]]]
    about: Mapping[str, Any] = field(default_factory=dict)
    patience: int = 0

    @property
    def patient(self) -> bool:
        """Whether there is hope yet that the score becomes smaller."""
        return not self.patience or self.state.step - self.state.best_step < self.patience

    def keep_the_best(self, last: int) -> None:
        """Score five times in its patience; at the end take the best weights."""
        state = self.state
        if self.patience and (
                state.step % max(1, self.patience // 5) == 0 or state.step == last):
            state.note(self.score()[0]['relative'])
            if state.best and (not self.patient or state.step == last):
                state.average.load_state_dict(state.best)


def run(config: Any, kind: str, prepare: Callable[[Run], Course[Trained, Item]],
        min_frames: int = 3, stop_at: int | None = None,
        progress: bool = True, after_step: Callable[[int], object] | None = None) -> str:
    """
    Train a network, or go on with a run that was interrupted.

    Leaves in the run's folder: config.json, run.json, scores.json, checkpoint.safetensors, the
    weights and TensorBoard curves with sample pictures. The first Ctrl-C ends the run after its
    step, when all of this is saved; a second one ends it at once.

    :param config: see Run; kind: likewise.
    :param prepare: makes the Course.
    :param min_frames: episodes with fewer are left out.
    :param stop_at: stop (and save) at this step instead of the last.
    :param progress: whether to show a progress bar.
    :param after_step: called with the number of steps done, after each of them.
    :return: path of the weights file.
    :raises ConfigError: if the folder holds a run with other settings or recordings.
    :raises RecordingError: if the recordings cannot be trained on.
    :raises WeightsError: if the checkpoint is damaged.
    :raises StorageError: if the disk is full, or another process trains there. What was saved
        stays; the run goes on from there.
    """
    device = pick_device(config.device)
    if config.threads:
        torch.set_num_threads(config.threads)
    reading = reading_of(config)
    paths = paths_of(config)
    check_first_picture(paths, reading, f'the {kind.replace("_", " ")}')
    store = open_recordings(paths, progress=progress, reading=reading)
    with _run_folder(config.out):
        parts = with_masks(store, split_episodes(
            store, config.test_fraction, min_frames, config.held_out), config.robot_mask)
        if not len(parts[0]):
            raise RecordingError('recordings: all that --held-out leaves is too short to '
                                 'train on; name others')
        if config.held_out and not len(parts[1]):
            raise RecordingError(f'--held-out {" ".join(config.held_out)}: holds no episode '
                                 'by itself; name whole bags, not files of a split one')
        warn_if_few(parts[1])
        torch.manual_seed(config.seed)
        this = Run(config, kind, device, store, *parts, progress)
        _train(this, prepare(this), min(config.steps, stop_at or config.steps), after_step)
    return str(Path(config.out) / f'{kind}.safetensors')


def paths_of(config: Any) -> list[str]:
    """Return the recordings, and of those held out what is not among them."""
    def files(path: str) -> set[Path]:
        return {file.resolve() for bag in find_bags(path) for file in bag}

    known = set().union(*map(files, config.recordings))
    return [*config.recordings, *(path for path in config.held_out if not files(path) <= known)]


def _train(run: Run, course: Course[Trained, Item], last: int,
           after_step: Callable[[int], object] | None) -> None:
    """Do the steps up to the last; see run."""
    config, state = run.config, course.state
    bar = tqdm(total=config.steps, initial=state.step, unit='step', disable=not run.progress,
               desc=run.kind.replace('_', ' '))
    curves = SummaryWriter(config.out, purge_step=state.step)
    with _first_interrupt() as interrupted, curves, bar:
        began = time.monotonic() - state.seconds
        batches = course.batches(state.step, last) if course.patient else ()
        for step, item in enumerate(batches, start=state.step):
            state.set_rates(config.steps, config.warmup)
            numbers = course.step(item)
            state.update_average(config.average_decay)
            state.step = step + 1
            # Tell and save.
            bar.update()
            if state.step % config.log_every == 0:
                shown = {**numbers(), 'learning_rate': state.optimizers[0].param_groups[0]['lr']}
                for name, value in shown.items():
                    curves.add_scalar(f'train/{name}', value, state.step)
                bar.set_postfix({name: f'{shown[name]:.4f}' for name in list(shown)[:2]})
            if after_step is not None:
                after_step(state.step)
            course.keep_the_best(config.steps)
            stopped = interrupted.is_set() or not course.patient
            if state.step % config.save_every == 0 or state.step == last or stopped:
                state.seconds = time.monotonic() - began
                _report(run, course, curves)  # first: one that is killed in between reports again
                save_checkpoint(run.checkpoint, state, asdict(config), run.data_hash)
            if stopped:
                break
    if interrupted.is_set():
        tqdm.write(f'{state.step} of {config.steps} steps are saved in {config.out}; the same '
                   'command goes on from there', sys.stderr)
        raise KeyboardInterrupt


@contextmanager
def _first_interrupt() -> Iterator[threading.Event]:
    """Note the first Ctrl-C instead of raising KeyboardInterrupt; only the main thread can."""
    asked = threading.Event()
    if threading.current_thread() is not threading.main_thread():
        yield asked
        return

    def note(*_: object) -> None:
        asked.set()
        signal.signal(signal.SIGINT, before)

    before = signal.signal(signal.SIGINT, note)
    try:
        yield asked
    finally:
        signal.signal(signal.SIGINT, before)


@contextmanager
def _run_folder(folder: str) -> Iterator[None]:
    """Write to the folder of a run as the only process; StorageError where that cannot be."""
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


def _report(run: Run, course: Course[Trained, Item], curves: SummaryWriter) -> None:
    """Write scores, sample pictures, what the run was, and the averaged weights."""
    state, store = course.state, run.store
    scores, pictures = course.score()
    for name, value in scores.items():
        curves.add_scalar(f'held_out/{name}', value, state.step)
    for name, picture in pictures.items():
        curves.add_image(name, picture, state.step, dataformats='HWC')
    about = {
        **({'precision': state.precision} if state.precision else {}),
        'steps': state.step, 'seconds': round(state.seconds, 1), 'seed': run.config.seed,
        **({'best_step': state.best_step} if course.patience else {}),
        'data_hash': store.data_hash,
        'camera_size': list(store.camera_size) if store.camera_size else None,
        'episodes': len(run.training), 'held_out': len(run.held_out),
        'machine': f'{platform.machine()}, {torch.get_num_threads()} threads, '
                   f'{device_name(run.device)}',
        'torch': torch.__version__, 'python': platform.python_version(), **course.about}
    settings = asdict(run.config)
    for name, values in (('config', settings), ('run', about), ('scores', scores)):
        write_atomically(Path(run.config.out, f'{name}.json'), json.dumps(values, indent=2) + '\n')
    save_weights(Path(run.config.out, f'{run.kind}.safetensors'), state.average, run.kind,
                 state.network.config, about | {'settings': settings, 'scores': scores})
