# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
The option `train predictor --choose`: short trainings of each selection, on a page to choose from.

No error, and nothing else that needs no marks, tells which selection has found the bottleneck. So
a person looks at strips; or marks that are held out decide.
"""

from base64 import b64encode
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path
import shlex
from typing import Any, get_args

from jinja2 import Environment
import numpy as np
from tap_ros.errors import ConfigError
from tap_ros.evaluation.choose import Options
from tap_ros.evaluation.intervals import share_interval
from tap_ros.evaluation.keyframes import is_hit
from tap_ros.evaluation.prediction import evaluate
from tap_ros.evaluation.strips import draw_strips
from tap_ros.files import write_atomically
from tap_ros.images.drawing import png_bytes
from tap_ros.prediction.methods import Selection
from tap_ros.prediction.predictor import load_network
from tap_ros.prediction.training import train
from tap_ros.prediction.training_config import DEFAULTS, TrainingConfig
from tap_ros.recording.cache import EpisodeStore, open_recordings
from tap_ros.recording.marks import Marks, read_marks
from tap_ros.recording.reading import reading_of
from tap_ros.training.inpainted import fill, with_masks
from tap_ros.training.recipes import find_recipe
from tap_ros.training.run import paths_of
from tap_ros.training.split import FEW, split_episodes, warn_if_few
from tap_ros.training.train import recipe_of, settings_of

TRIAL = {'steps': 400, 'batch_size': 8}  # at most
HELD_OUT = 0.3  # share of the demonstrations, at least
STRIPS = 8  # held-out demonstrations that are drawn
LOOKS_FOR = {'relative': 'what copying the start or the goal shows worst',
             'progress': 'what looks about half way from the start to the goal',
             'absolute': "what is predicted with the least error, the paper's method",
             'fix': 'the middle of the time', 'marks': 'what is marked',
             'still': 'where pictures change least between start and goal'}


@dataclass(frozen=True)
class Trial:
    """
    A selection that was tried.

    :param picture: sheet of strips, PNG in base64.
    :param hits: bool (N,), which of N marked held-out demonstrations it hits.
    :param command: that trains it.
    """

    name: str
    picture: str
    hits: np.ndarray
    command: str

    @property
    def share(self) -> str:
        """How often held-out marks are hit, in words."""
        value, low, high = share_interval(self.hits)
        return (f'{int(self.hits.sum())} of {len(self.hits)} held-out marks, {value:.0%} '
                f'({low:.0%}, {high:.0%})')


def run(args: Options) -> None:
    """
    Try the selections, print where the page is, and what marks say.

    :raises ConfigError: for settings that no selection can be trained with.
    """
    settings = settings_of(args)
    out = Path(settings['out'] or 'runs/predictor')
    configs = _configs(settings, out)
    first = next(iter(configs.values()))
    store = open_recordings(paths_of(first), reading=reading_of(first))
    marks = read_marks(settings['marks'], store) if settings['marks'] else None
    training, held_out = with_masks(store, split_episodes(
        store, first.test_fraction, held_out=first.held_out), first.robot_mask)
    if not len(held_out):
        raise ConfigError('recordings: no demonstration is left to be held out; record more')
    warn_if_few(held_out)
    tried = [Trial(name, *_try(config, store, held_out, marks), command_of(args, name))
             for name, config in configs.items()]
    said = decide(tried)
    page = Environment(autoescape=True).from_string(
        files('tap_ros.evaluation').joinpath('choose.html').read_text())
    write_atomically(out / 'choose.html', page.render(
        tried=tried, said=said, looks_for=LOOKS_FOR, steps=first.steps, training=len(training),
        held_out=len(held_out)))
    print('\n'.join([*said, str(out / 'choose.html')]))


def _configs(settings: Mapping[str, Any], out: Path) -> dict[str, TrainingConfig]:
    """Return the configuration of each selection that goes with the other settings."""
    found, refused = {}, None
    for name in ('fix', *get_args(Selection)):
        if name == 'marks' and not settings['marks']:
            continue
        changes = _settings_of(name, settings) | {'out': str(out / 'choose' / name)}
        changes |= {key: min(settings[key], most) for key, most in TRIAL.items()}
        changes['test_fraction'] = max(settings['test_fraction'], HELD_OUT)
        try:
            found[name] = TrainingConfig(**{**settings, 'marks': '', **changes})
        except ConfigError as error:
            refused = error
    if not found and refused:
        raise refused
    return found


def _settings_of(name: str, settings: Mapping[str, Any]) -> dict[str, Any]:
    """Return the settings that make a selection."""
    if name == 'fix':
        return {'loss': 'fix', 'selection': DEFAULTS['selection']}
    return {'loss': 'genmin', 'selection': name} | (
        {'marks': settings['marks']} if name == 'marks' else {})


def _try(config: TrainingConfig, store: EpisodeStore, held_out: np.ndarray,
         marks: Marks | None) -> tuple[str, np.ndarray]:
    """Train a selection; return its strips as PNG in base64, and which marks it hits."""
    network, _ = load_network(train(config))
    filled = fill(store, config.robot_mask)
    known = marks.episodes if marks else {}
    marked = np.array([i for i in held_out.tolist() if i in known], int)
    hits = np.zeros(0, bool)
    if len(marked):
        matched = evaluate(network, store, marked, 'recorded', filled)['prediction'].match_step
        hits = np.array([is_hit(known[i], t, 1) for i, t in zip(
            marked.tolist(), matched.tolist())])
    shown = np.concatenate([marked, np.setdiff1d(held_out, marked)])[:STRIPS]
    sheet = draw_strips(network, store, shown, 'recorded', filled, marks)
    return b64encode(png_bytes(sheet)).decode(), hits


def command_of(args: Options, name: str) -> str:
    """Write the command that trains a selection with the other options as they are."""
    given = settings_of(args)
    recipe = args.recipe or recipe_of('predictor', given['recordings'], given)
    usual = {**DEFAULTS, **find_recipe('predictor', recipe).settings}
    changed = {key: value for key, value in given.items()
               if key not in ('recordings', 'selection', 'loss', 'marks')
               and value != usual.get(key, '')} | _settings_of(name, given)
    words = ['python', '-m', 'tap_ros', 'train', 'predictor', *given['recordings'],
             '--recipe', recipe]
    for key, value in changed.items():
        option = key.replace('_', '-')
        if isinstance(value, bool):
            words.append(f'--{option}' if value else f'--no-{option}')
        elif key == 'image_topic':
            words += [word for topic in value for word in (f'--{option}', topic)]
        else:
            words += [f'--{option}', *map(str, value if isinstance(value, tuple) else [value])]
    return shlex.join(words)


def decide(tried: Sequence[Trial]) -> list[str]:
    """Say which selection the held-out marks choose, if there are any."""
    count = len(tried[0].hits)
    if count < FEW:
        return ['look at the page and choose: ' + (
            f'{count} held-out marks are too few; mark more to let them choose' if count else
            'no marks are held out that could')]
    best = max(tried, key=lambda one: int(one.hits.sum()))
    low = share_interval(best.hits).low
    near = [one.name for one in tried
            if one is not best and share_interval(one.hits).high > low]
    return [f'{best.name} hits most: {best.share}'
            + (f'; not told from: {", ".join(near)}' if near else ''), best.command]
