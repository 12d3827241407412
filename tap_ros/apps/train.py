# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Train by a recipe: the function `tap_ros.train`, and the commands `train ...`."""

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import fields, replace
from pathlib import Path
from typing import Any, Literal

from tap_ros.base.errors import ConfigError, TapError
from tap_ros.base.text import meant
from tap_ros.recording.reading import reading_of
from tap_ros.training import forward_config as forward_training_config
from tap_ros.training import predictor_config as training_config
from tap_ros.training.forward_config import ForwardTrainingConfig
from tap_ros.training.predictor_config import TrainingConfig
from tap_ros.weights import find_predictor

Model = Literal['predictor', 'forward']
Config = TrainingConfig | ForwardTrainingConfig

RECIPES: dict[str, dict[str, Any]] = {
    'predictor': training_config.RECIPES, 'forward': forward_training_config.RECIPES}


def train(recordings: str | Path | Sequence[str | Path], out: str | Path = '',
          model: Model = 'predictor', recipe: str = '', **settings: Any) -> Path:
    """
    Train a predictor, or the planner's forward model, or go on where a training was interrupted.

        weights = train('bags/push2', 'runs/push2')
        weights = train('bags/mine', 'runs/mine', crop='centre', size=64, steps=5000)
        weights = train('bags/push2', 'runs/try', recipe='debug')

    :param recordings: one or several: bag folders, folders of these, or .mcap files.
    :param out: the run's folder; by default runs/predictor or runs/forward.
    :param model: 'predictor' or 'forward'.
    :param recipe: its name, see training/predictor_config.py; by default that of the task that
        the recordings name, else with marks 'foreign', else push2's.
    :param settings: other settings than the recipe's: fields of TrainingConfig, or of
        ForwardTrainingConfig. Initial weights bring the network's shape and the pictures' size.
    :return: path of the weights file.
    :raises ConfigError: for a model, recipe or setting that is unknown or cannot be trained with.
    :raises TapError: for recordings that cannot be used, a damaged checkpoint, a full disk.
    """
    if model not in RECIPES:
        raise ConfigError(f'model {model!r} is unknown; valid: {", ".join(RECIPES)}')
    usual = next(iter(RECIPES[model].values()))
    known = [field.name for field in fields(usual)]
    for name in settings:
        if name not in known:
            raise ConfigError(f'setting {name!r} of a {model} is unknown; '
                              f'{meant(name, known)}see training/{model}_config.py')
    settings |= {'recordings': recordings, **({'out': out} if out else {})}
    for name, value in settings.items():
        if name in (
                'recordings', 'held_out', 'image_topic', 'label_topic', 'label_signals'):
            several = [value] if isinstance(value, str | Path) else value
            settings[name] = tuple(str(each) for each in several if str(each))
        elif isinstance(value, Path):
            settings[name] = str(value)
    chosen = defaults(replace(usual, recipe=recipe, **settings))
    return Path(_train(replace(chosen, **settings)))


def defaults(asked: Config) -> Any:
    """
    Return the settings of the recipe, where none is named that of the recordings.

    :param asked: what is asked for; what is not said is as in the first recipe.
    :return: the same kind. Initial weights bring the shape that they have, and marks choose the
        frames.
    :raises ConfigError: for an unknown recipe; it names the nearest one and all valid ones.
    """
    recipes = RECIPES['predictor' if isinstance(asked, TrainingConfig) else 'forward']
    shape = _shape(asked)
    sized = replace(asked, size=asked.size or shape.get('size', 0))
    name = asked.recipe or _recipe_of(sized, recipes)
    if name not in recipes:
        raise ConfigError(f'recipe {name!r} is unknown; {meant(name, recipes)}valid: '
                          f'{", ".join(recipes)}')
    marked = {'selection': 'marks'} if getattr(asked, 'marks', '') else {}
    return replace(recipes[name], recipe=name, **shape, **marked)


def _shape(asked: Config) -> dict[str, Any]:
    """Return the shape of a predictor's initial weights; where it cannot be read, the run says."""
    if isinstance(asked, TrainingConfig) and asked.initial_weights:
        with suppress(TapError):
            from tap_ros.weights.weights import load_weights  # torch takes seconds to import
            shape = load_weights(find_predictor(asked.initial_weights), 'predictor')[0]
            names = {'image_size': 'size', **{name: name for name in (
                'base_width', 'new_pixels', 'decoder', 'skips')}}
            return {names[name]: shape[name] for name in names if name in shape}
    return {}


def _recipe_of(asked: Config, recipes: dict[str, Any]) -> str:
    """Name the recipe for recordings: that of the task of their first episode, if there is one."""
    with suppress(TapError):  # what cannot be read, the run says
        from tap_ros.recording.bags import known_bags  # --help does without numpy
        from tap_ros.recording.cache import open_recordings
        task = asked.recordings and open_recordings(
            known_bags(asked.recordings), reading=reading_of(asked), network='the network')[0].task
        if task in recipes:
            return task
    return 'foreign' if getattr(asked, 'marks', '') else next(iter(recipes))


def _train(config: Config) -> str:
    """Train with settings; return the path of the weights."""
    if isinstance(config, TrainingConfig):
        from tap_ros.training.predictor import train  # torch takes seconds to import
        return train(config)
    from tap_ros.training.forward import train as train_forward
    return train_forward(config)


def run(config: Config) -> None:
    """Train with the options of a command, and print where the weights are."""
    print(_train(config))
