# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
The state of a training run, and its way to a file and back.

Batches and augmentation are drawn from (seed, step), so that there are no random numbers in it.
"""

from collections.abc import Mapping
import copy
from dataclasses import dataclass, field
import json
import math
from pathlib import Path
from typing import Any, Generic, TypeVar

from tap_ros.base.errors import ConfigError, WeightsError
from tap_ros.base.text import escaped
from tap_ros.training.run_config import FREE
from tap_ros.weights.devices import placed
from tap_ros.weights.weights import load_tensors, save_tensors
import torch

Trained = TypeVar('Trained', bound=torch.nn.Module)

DISCRIMINATOR_RATE = 2e-4
WARMUP = 100  # steps over which the learning rate rises
GRADIENT_CLIP = 1.0  # largest norm of the gradient
_REMEDY = 'remove it to begin anew, or choose another --out folder'


@dataclass
class TrainingState(Generic[Trained]):
    """
    What changes during training.

    :param network: the network that is trained.
    :param average: moving average of its weights, in eval mode; what is shipped.
    :param helpers: ModuleDict of the networks that only training needs: recognition,
        discriminators; may be empty.
    :param average_decay: share of the average that stays at a step, 0..1.
    :param optimizers: list of Adams: of the network with what is trained along with it, and, if
        there are discriminators, theirs.
    :param step: number of steps done.
    :param seconds: time they took, over all sessions.
    :param precision: what the networks run in, 'float32' or 'bfloat16'; '': nothing was chosen.
    :param best: the average where its score was smallest, a state dict; empty: none was noted.
    :param best_score: that score; best_step: steps done then.
    """

    network: Trained
    average: Trained
    helpers: torch.nn.ModuleDict
    average_decay: float
    optimizers: list[torch.optim.Optimizer]
    step: int = 0
    seconds: float = 0.0
    precision: str = ''
    best: dict[str, torch.Tensor] = field(default_factory=dict)
    best_score: float = math.inf
    best_step: int = 0

    @property
    def modules(self) -> dict[str, torch.nn.Module]:
        """All networks, by their names in a checkpoint."""
        return {'network': self.network, 'average': self.average, 'helpers': self.helpers}

    def note(self, score: float) -> None:
        """Keep the average if its score is the smallest so far."""
        if score < self.best_score:
            self.best_score, self.best_step = score, self.step
            self.best = {name: value.clone() for name, value in self.average.state_dict().items()}

    def set_rates(self, steps: int) -> None:
        """
        Set this step's learning rates: a linear rise, then half a cosine down to 2 %.

        :param steps: length of the training.
        """
        rise = min(1.0, (self.step + 1) / (WARMUP + 1))
        fall = 0.5 + 0.5 * math.cos(math.pi * self.step / steps)
        for optimizer in self.optimizers:
            for group in optimizer.param_groups:
                group['lr'] = optimizer.defaults['lr'] * rise * (0.02 + 0.98 * fall)

    def clip_gradients(self) -> torch.Tensor:
        """Scale the network's gradients down to GRADIENT_CLIP; return the norm that they had."""
        return torch.nn.utils.clip_grad_norm_(
            self.optimizers[0].param_groups[0]['params'], GRADIENT_CLIP)

    @torch.no_grad()
    def update_average(self) -> None:
        """Move the average towards the network; faster at the beginning."""
        decay = min(self.average_decay, (1 + self.step) / (10 + self.step))
        averages: list[torch.Tensor] = list(self.average.parameters())
        weights: list[torch.Tensor] = list(self.network.parameters())
        torch._foreach_lerp_(averages, weights, 1 - decay)
        for mine, other in zip(self.average.buffers(), self.network.buffers()):
            mine.copy_(other)  # batch norm's statistics are averages already


def start(network: Trained, learning_rate: float, device: torch.device,
          average_decay: float,
          helpers: Mapping[str, torch.nn.Module] | None = None) -> TrainingState[Trained]:
    """
    Begin a training run.

    :param network: with fresh weights.
    :param learning_rate: of Adam at its highest; of discriminators it is DISCRIMINATOR_RATE.
    :param average_decay: share of the average of the weights that stays at a step, 0..1.
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
        torch.optim.Adam(group, rate, betas, fused=True)
        for group, rate in zip(groups, (learning_rate, DISCRIMINATOR_RATE)) if group]
    return TrainingState(network, average, helpers, average_decay, optimizers)


def save_checkpoint(path: str | Path, state: TrainingState[Any], settings: Mapping[str, Any],
                    data_hash: str) -> None:
    """
    Write the whole state of a run, in one step.

    :param path: the file.
    :param settings: dict of the run's settings.
    :param data_hash: of the recordings.
    :raises StorageError: if the disk is full; the checkpoint before stays.
    """
    parts = {**{name: module.state_dict() for name, module in state.modules.items()},
             'best': state.best, **{
                 f'optimizer.{k}.{i}': values for k, optimizer in enumerate(state.optimizers)
                 for i, values in optimizer.state_dict()['state'].items()}}
    save_tensors(path, {f'{part}.{name}': value for part, values in parts.items()
                        for name, value in values.items()}, {
        'kind': 'checkpoint', 'step': state.step, 'seconds': state.seconds,
        **({'best': [state.best_score, state.best_step]} if state.best else {}),
        'precision': state.precision, 'settings': settings, 'data_hash': data_hash})


def load_checkpoint(path: str | Path, state: TrainingState[Any], settings: Mapping[str, Any],
                    data_hash: str) -> None:
    """
    Put the state of a run back.

    :param path: the file; if there is none, nothing happens.
    :param state: TrainingState as start made it; changed in place.
    :param settings: dict of the run's settings.
    :param data_hash: of the recordings.
    :raises ConfigError: if the checkpoint is of other settings or other recordings.
    :raises WeightsError: if it is damaged, or no checkpoint of such a network.
    """
    if not Path(path).exists():
        return
    tensors, about = load_tensors(path)
    if about.get('kind') != 'checkpoint':
        raise WeightsError(f'{escaped(path)}: is no checkpoint; {_REMEDY}')
    begun, settings = about['settings'], json.loads(json.dumps(settings))  # no tuples
    if begun.keys() != settings.keys():
        raise ConfigError(f'{escaped(path)}: made by another version of tap_ros, which has other '
                          'settings; go on with that one, or choose another --out folder')
    for name in settings:
        if name not in FREE and begun[name] != settings[name]:
            raise ConfigError(
                f'{escaped(path)}: made with {name}={escaped(repr(begun[name]))}, not '
                f'{settings[name]!r}; to go on with it give the same settings, else choose '
                'another --out folder')
    if about.get('data_hash') != data_hash:
        raise ConfigError(f'{escaped(path)}: made from other recordings or marks; to go on with '
                          'it give the same in the same order, else choose another --out folder')
    try:
        # Put them back into networks and optimizers.
        for part, module in state.modules.items():
            module.load_state_dict({name.removeprefix(f'{part}.'): value for name, value
                                    in tensors.items() if name.startswith(f'{part}.')})
        state.best = {name: tensors[f'best.{name}'].clone() for name in state.average.state_dict()
                      if f'best.{name}' in tensors}
        for name, value in tensors.items():
            if name.startswith('optimizer.'):
                _, k, i, part = name.split('.')
                weight = state.optimizers[int(k)].param_groups[0]['params'][int(i)]
                # The fused Adam wants the weight's own strides.
                state.optimizers[int(k)].state[weight][part] = torch.empty_like(weight).copy_(
                    value) if value.shape == weight.shape else value.to(weight.device)
    except (LookupError, RuntimeError, TypeError, ValueError) as error:
        raise WeightsError(f'{escaped(path)}: is a checkpoint of something else '
                           f'({escaped(error)}); {_REMEDY}') from error
    state.step, state.seconds = about['step'], about['seconds']
    state.precision = about['precision']
    state.best_score, state.best_step = about.get('best', (math.inf, 0))
