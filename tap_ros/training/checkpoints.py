# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
A training run: its state, its way to a file and back, and its folder.

Batches and augmentation are drawn from (seed, step), so that there are no random numbers in it.
"""

from collections.abc import Callable, Iterator, Mapping, Sized
from contextlib import contextmanager
import copy
from dataclasses import dataclass
import json
import math
from pathlib import Path
import platform
import threading
from typing import Any, Generic, TYPE_CHECKING, TypeVar

from tap_ros.errors import ConfigError, WeightsError
from tap_ros.files import only_writer, storage_errors, write_atomically
from tap_ros.text import escaped
from tap_ros.training.devices import device_name, placed
from tap_ros.training.weights import load_tensors, save_tensors
import torch

if TYPE_CHECKING:
    from tap_ros.recording.cache import EpisodeStore

Trained = TypeVar('Trained', bound=torch.nn.Module)

# Settings that change where a run happens and what it shows, not what it learns.
FREE = ('recordings', 'out', 'device', 'threads', 'log_every', 'save_every')
_REMEDY = 'remove it to begin anew, or choose another --out folder'


@dataclass
class TrainingState(Generic[Trained]):
    """
    What changes during training.

    :param network: the network that is trained.
    :param average: moving average of its weights, in eval mode; what is shipped.
    :param helpers: ModuleDict of the networks that only training needs: recognition,
        discriminators; may be empty.
    :param optimizers: list of Adams: of the network with what is trained along with it, and, if
        there are discriminators, theirs.
    :param step: number of steps done.
    :param seconds: time they took, over all sessions.
    :param precision: what the networks run in, 'float32' or 'bfloat16'; '': nothing was chosen.
    """

    network: Trained
    average: Trained
    helpers: torch.nn.ModuleDict
    optimizers: list[torch.optim.Optimizer]
    step: int = 0
    seconds: float = 0.0
    precision: str = ''

    def set_rates(self, steps: int, warmup: int, *highest: float) -> None:
        """
        Set this step's learning rates: a linear rise, then half a cosine down to 2 %.

        :param steps: length of the training.
        :param warmup: steps of the rise.
        :param highest: of each optimizer, the rate after the rise.
        """
        rise = min(1.0, (self.step + 1) / (warmup + 1))
        fall = 0.5 + 0.5 * math.cos(math.pi * self.step / steps)
        for optimizer, rate in zip(self.optimizers, highest):
            for group in optimizer.param_groups:
                group['lr'] = rate * rise * (0.02 + 0.98 * fall)

    @torch.no_grad()
    def update_average(self, decay: float) -> None:
        """
        Move the average towards the network; faster at the beginning.

        :param decay: share of the average that stays, 0..1.
        """
        decay = min(decay, (1 + self.step) / (10 + self.step))
        averages: list[torch.Tensor] = list(self.average.parameters())
        weights: list[torch.Tensor] = list(self.network.parameters())
        torch._foreach_lerp_(averages, weights, 1 - decay)
        for mine, other in zip(self.average.buffers(), self.network.buffers()):
            mine.copy_(other)  # batch norm's statistics are averages already


def start(network: Trained, learning_rate: float, device: torch.device,
          helpers: Mapping[str, torch.nn.Module] | None = None) -> TrainingState[Trained]:
    """
    Begin a training run.

    :param network: with fresh weights.
    :param learning_rate: of Adam.
    :param device: torch device.
    :param helpers: dict of the networks that only training needs. Those whose name ends in
        'discriminator' are trained against the others.
    :return: TrainingState.
    """
    helpers = placed(torch.nn.ModuleDict(helpers or {}), device)
    network = placed(network, device)
    average = copy.deepcopy(network).eval().requires_grad_(False)
    groups = [list(network.parameters()), []]
    for name, helper in helpers.items():
        groups[name.endswith('discriminator')] += helper.parameters()
    # DCGAN's beta1 of 0.5 where networks are trained against each other.
    betas = (0.5 if groups[1] else 0.9, 0.999)
    optimizers: list[torch.optim.Optimizer] = [
        torch.optim.Adam(group, learning_rate, betas, fused=True) for group in groups if group]
    return TrainingState(network, average, helpers, optimizers)


def save_checkpoint(path: str | Path, state: TrainingState[Any], settings: Mapping[str, Any],
                    data_hash: str) -> None:
    """
    Write the whole state of a run, in one step.

    :param path: the file.
    :param state: TrainingState.
    :param settings: dict of the run's settings.
    :param data_hash: of the recordings.
    :raises StorageError: if the disk is full; the checkpoint before stays.
    """
    tensors = {f'network.{name}': value for name, value in state.network.state_dict().items()}
    tensors |= {f'average.{name}': value for name, value in state.average.state_dict().items()}
    tensors |= {f'helpers.{name}': value for name, value in state.helpers.state_dict().items()}
    for k, optimizer in enumerate(state.optimizers):
        for i, values in optimizer.state_dict()['state'].items():
            tensors |= {f'optimizer.{k}.{i}.{name}': value for name, value in values.items()}
    save_tensors(path, tensors, {
        'kind': 'checkpoint', 'step': state.step, 'seconds': state.seconds,
        'precision': state.precision, 'settings': settings, 'data_hash': data_hash})


def load_checkpoint(path: str | Path, state: TrainingState[Any], settings: Mapping[str, Any],
                    data_hash: str, todays: Callable[[dict[str, Any]], dict[str, Any]]) -> None:
    """
    Put the state of a run back.

    :param path: the file; if there is none, nothing happens.
    :param state: TrainingState as start made it; changed in place.
    :param settings: dict of the run's settings.
    :param data_hash: of the recordings.
    :param todays: makes settings of earlier versions into those of today.
    :raises ConfigError: if the checkpoint is of other settings or other recordings.
    :raises WeightsError: if it is damaged, or no checkpoint of such a network.
    """
    if not Path(path).exists():
        return
    tensors, about = load_tensors(path)
    if (about.get('kind') != 'checkpoint' or not isinstance(about.get('settings'), dict)
            or not isinstance(about.get('step'), int)
            or not isinstance(about.get('seconds'), (int, float))
            or about.get('precision', '') not in ('', 'float32', 'bfloat16')):
        raise WeightsError(f'{escaped(path)}: is no checkpoint; {_REMEDY}')
    begun = todays(about['settings'])
    for name in {**begun, **settings}:
        before, value = begun.get(name), settings.get(name)
        if name not in FREE and before != value:
            raise ConfigError(
                f'{escaped(path)}: made with {name}={escaped(repr(before))}, not {value!r}; to go '
                'on with it give the same settings, else choose another --out folder')
    if about.get('data_hash') != data_hash:
        raise ConfigError(f'{escaped(path)}: made from other recordings; to go on with it give '
                          'the same ones in the same order, else choose another --out folder')
    try:
        _put_back(state, tensors)
    except (LookupError, RuntimeError, TypeError, ValueError) as error:
        raise WeightsError(f'{escaped(path)}: is a checkpoint of something else '
                           f'({escaped(error)}); {_REMEDY}') from error
    state.step, state.seconds = about['step'], about['seconds']
    state.precision = about.get('precision', '')


def _put_back(state: TrainingState[Any], tensors: Mapping[str, torch.Tensor]) -> None:
    """Put tensors of a checkpoint back into networks and optimizers."""
    for prefix, module in (('network.', state.network), ('average.', state.average),
                           ('helpers.', state.helpers)):
        module.load_state_dict({name[len(prefix):]: value for name, value in tensors.items()
                                if name.startswith(prefix)})
    for k, optimizer in enumerate(state.optimizers):
        for i, weight in enumerate(optimizer.param_groups[0]['params']):
            for name in [name for name in tensors if name.startswith(f'optimizer.{k}.{i}.')]:
                value = tensors[name].to(weight.device)
                if value.shape == weight.shape:  # the fused Adam wants the weight's own strides
                    value = torch.empty_like(weight).copy_(value)
                optimizer.state[weight][name.rsplit('.', 1)[1]] = value


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

    :param state: TrainingState.
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
