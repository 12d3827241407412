# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What every training is: steps, curves, scores and checkpoints, in a folder of its own."""

from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, ExitStack
from dataclasses import asdict
import hashlib
import json
from pathlib import Path
import platform
import signal
import sys
import threading
import time
from typing import Any, Generic, Self, TypeVar

import numpy as np
from tap_ros.base.errors import RecordingError
from tap_ros.base.files import only_writer, storage_errors, write_atomically
from tap_ros.base.progress import Progress
from tap_ros.recording.bags import known_bags
from tap_ros.recording.cache import open_recordings
from tap_ros.recording.marks import read_marks
from tap_ros.recording.reading import reading_of
from tap_ros.recording.topic_choice import Bag
from tap_ros.training.checkpoints import load_checkpoint, save_checkpoint, start, TrainingState
from tap_ros.training.run_config import RunConfig
from tap_ros.training.split import (
    describe_split,
    digests_of,
    parse_held_out,
    split_episodes,
    warn_if_few,
    with_masks,
)
from tap_ros.weights.devices import pick_device
from tap_ros.weights.weights import save_weights
import torch
from torch.utils.tensorboard import SummaryWriter

Trained = TypeVar('Trained', bound=torch.nn.Module)
Item = TypeVar('Item')  # what a step takes
Config = TypeVar('Config', bound=RunConfig)
Show = Callable[[np.ndarray], np.ndarray]  # from indices of episodes to a picture (H, W, 3)

LARGE = 128  # px a side, above which pictures are trained on for long


class Run(Generic[Config]):
    """
    A training, or the rest of one that was interrupted.

        with Run(config, 'predictor') as run:
            state = run.begin(network, average_decay)
            for step, item in run.steps(draw, score, show):
                ...  # moves state.network by state.optimizers
                run.show({'loss': loss})

    Leaves in the run's folder: config.json, run.json, scores.json, checkpoint.safetensors, the
    weights and TensorBoard curves with sample pictures. The first Ctrl-C ends the run after its
    step, when all of this is saved; a second one ends it at once.

    :param kind: of the weights file, 'predictor' or 'forward_model'.
    :param min_frames: episodes with fewer are left out.
    :param stop_at: stop (and save) at this step instead of the last.
    :param progress: whether to show a progress bar.
    :param after_step: called with the number of steps done, after each of them.
    :ivar store: the EpisodeStore; training, held_out: indices of its episodes.
    :ivar about: what else the weights file shall tell of the run; what JSON can hold.
    :ivar weights: path of the weights file.
    :raises ConfigError: if the folder holds a run with other settings or recordings.
    :raises RecordingError: if the recordings cannot be trained on.
    :raises WeightsError: if the checkpoint is damaged.
    :raises StorageError: if the disk is full, or another process trains there. What was saved
        stays; the run goes on from there.
    """

    def __init__(self, config: Config, kind: str, min_frames: int = 3,
                 stop_at: int | None = None, progress: bool = True,
                 after_step: Callable[[int], object] | None = None) -> None:
        config.check()
        self.config, self.kind, self.progress = config, kind, progress
        self.about: dict[str, Any] = {}
        self.weights = str(Path(config.out, f'{kind}.safetensors'))
        self.checkpoint = Path(config.out, 'checkpoint.safetensors')
        self._min_frames, self._after_step = min_frames, after_step
        self._last = min(config.steps, stop_at or config.steps)
        self._shown: Mapping[str, torch.Tensor | float] = {}

    def __enter__(self) -> Self:
        """Open the recordings, and the folder as its only process."""
        config = self.config
        self.device = pick_device(config.device)
        if config.threads:
            torch.set_num_threads(config.threads)
        self.store = open_recordings(
            bags_of(config), progress=self.progress, reading=reading_of(config),
            network=f'the {self.kind.replace("_", " ")}')
        # What tells from which data a checkpoint is: recordings, and marks if there are.
        self._data_hash = self.store.data_hash
        marked: Mapping[int, Any] = {}
        if marks := getattr(config, 'marks', ''):
            marked = read_marks(marks, self.store).marked
            self._data_hash = hashlib.sha256(
                self._data_hash.encode() + Path(marks).read_bytes()).hexdigest()
        self.training, self.held_out = with_masks(self.store, split_episodes(
            self.store, config.test_fraction, self._min_frames, config.held_out, marked,
            config.split), config.robot_mask)
        if not len(self.training):
            raise RecordingError('recordings: all that --held-out leaves is too short to '
                                 'train on; name others')
        if config.held_out and not len(self.held_out):
            raise RecordingError(f'--held-out {" ".join(config.held_out)}: holds no episode '
                                 'that is long enough by itself; name whole bags, not files of '
                                 'a split one, or demonstrations: BAG:7')
        print(describe_split(self.held_out, self.training, marked), file=sys.stderr)
        if (side := max(self.store.image_size)) > LARGE:
            print(f'pictures of {side} px are trained on as they are; --size 64, as the shipped '
                  'weights have it, is faster', file=sys.stderr)
        warn_if_few(self.held_out)
        digests = digests_of(self.store)
        self._held_out_digests = sorted({digests[i] for i in self.held_out})
        torch.manual_seed(config.seed)
        self._stack = ExitStack()
        self._stack.enter_context(_run_folder(config.out))
        return self

    def __exit__(self, *error: Any) -> bool | None:
        """Close everything."""
        return self._stack.__exit__(*error)

    def begin(self, network: Trained, average_decay: float,
              helpers: Mapping[str, torch.nn.Module] | None = None) -> TrainingState[Trained]:
        """
        Begin, or go on from the checkpoint.

        :param network: with fresh weights; average_decay, helpers: see checkpoints.start.
        """
        state = start(network, self.config.learning_rate, self.device, average_decay, helpers)
        load_checkpoint(self.checkpoint, state, asdict(self.config), self._data_hash)
        self.state: TrainingState[Any] = state
        return state

    def show(self, values: Mapping[str, torch.Tensor | float]) -> None:
        """Show numbers of a step in the curves, the first two on the progress bar."""
        self._shown = values

    def steps(self, draw: Callable[[int], Item], score: Callable[[], Mapping[str, float]],
              show: Show, patience: int = 0) -> Iterator[tuple[int, Item]]:
        """
        Yield the number of each step and what it takes; after it show, score and save.

        :param draw: makes what a step takes from its number, two steps ahead in another thread.
        :param score: scores the averaged network on the held-out episodes.
        :param show: draws what it does in some of those that it is given.
        :param patience: steps after which the run ends if the score 'relative', of the held-out
            episodes, has not become smaller; the weights are then those with the smallest.
            0: never.
        :raises KeyboardInterrupt: after the step in which Ctrl-C was pressed, and all is saved.
        """
        config, state = self.config, self.state
        bar: Any = Progress(total=config.steps, initial=state.step, unit='step',
                            disable=not self.progress, desc=self.kind.replace('_', ' '))
        interrupted, curves, _ = map(self._stack.enter_context, (
            _first_interrupt(), SummaryWriter(config.out, purge_step=state.step), bar))
        began = time.monotonic() - state.seconds

        def hopeless() -> bool:
            return 0 < patience <= state.step - state.best_step

        last = state.step if hopeless() else self._last
        for step, item in _drawn_ahead(draw, state.step, last):
            state.set_rates(config.steps)
            yield step, item
            state.update_average()
            state.step = step + 1
            # Tell and save.
            bar.update()
            if state.step % config.log_every == 0:
                rate = state.optimizers[0].param_groups[0]['lr']
                for name, value in {**self._shown, 'learning_rate': rate}.items():
                    curves.add_scalar(f'train/{name}', value, state.step)
                bar.set_postfix({name: f'{float(self._shown[name]):.4f}'
                                 for name in list(self._shown)[:2]})
            if self._after_step is not None:
                self._after_step(state.step)
            at_end = state.step == config.steps
            if patience and (state.step % max(1, patience // 5) == 0 or at_end):
                state.note(score()['relative'])
                if state.best and (hopeless() or at_end):
                    state.average.load_state_dict(state.best)
            stopped = interrupted.is_set() or hopeless()
            if state.step % config.save_every == 0 or state.step == last or stopped:
                state.seconds = time.monotonic() - began
                if patience:
                    self.about['best_step'] = state.best_step
                self._report(score(), show, curves)  # first: one killed in between reports again
                save_checkpoint(self.checkpoint, state, asdict(config), self._data_hash)
            if stopped:
                break
        if interrupted.is_set():
            Progress.write(f'{state.step} of {config.steps} steps are saved in {config.out}; the '
                           'same command goes on from there', sys.stderr)
            raise KeyboardInterrupt

    def _report(self, scores: Mapping[str, float], show: Show, curves: SummaryWriter) -> None:
        """Write scores, sample pictures, what the run was, and the averaged weights."""
        config, state, store = self.config, self.state, self.store
        settings = asdict(config)
        for name, value in scores.items():
            curves.add_scalar(f'held_out/{name}', value, state.step)
        for name, part in (('training', self.training), ('held_out', self.held_out)):
            if len(part):
                curves.add_image(name, show(part), state.step, dataformats='HWC')
        about = {
            **({'precision': state.precision} if state.precision else {}),
            'steps': state.step, 'seconds': round(state.seconds, 1), 'seed': config.seed,
            'data_hash': store.data_hash,
            'camera_size': list(store.camera_size) if store.camera_size else None,
            'episodes': len(self.training), 'held_out': len(self.held_out),
            'held_out_digests': self._held_out_digests,
            'machine': f'{platform.machine()}, {torch.get_num_threads()} threads, '
                       + (torch.cuda.get_device_name(self.device)
                          if self.device.type == 'cuda' else self.device.type),
            'torch': torch.__version__, 'python': platform.python_version(), **self.about}
        for name, values in (('config', settings), ('run', about), ('scores', scores)):
            write_atomically(Path(config.out, f'{name}.json'), json.dumps(values, indent=2) + '\n')
        save_weights(self.weights, state.average, self.kind, state.network.config,
                     about | {'settings': settings, 'scores': scores})


def bags_of(config: RunConfig) -> list[Bag]:
    """Return the recordings, and of those held out what is not among them."""
    bags = known_bags(config.recordings)
    known = {file.resolve() for bag in bags for file in bag.files}
    return bags + [bag for bag in known_bags([parse_held_out(one)[0] for one in config.held_out])
                   if not {file.resolve() for file in bag.files} <= known]


def _drawn_ahead(draw: Callable[[int], Item], first: int, last: int) -> Iterator[tuple[int, Item]]:
    """Yield the steps from the first to before the last, and what is drawn for each."""
    with ThreadPoolExecutor(1) as pool:
        ahead = [pool.submit(draw, step) for step in range(first, min(first + 2, last))]
        for step in range(first, last):
            if step + 2 < last:
                ahead.append(pool.submit(draw, step + 2))
            yield step, ahead.pop(0).result()


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
    def quiet(failed: threading.ExceptHookArgs) -> None:
        # The thread that writes the curves; its error is raised where the next point is added.
        if not isinstance(failed.exc_value, OSError):
            before(failed)

    with only_writer(folder), storage_errors(folder):
        before, threading.excepthook = threading.excepthook, quiet
        try:
            yield
        finally:
            threading.excepthook = before
