# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What the commands `train predictor` and `train forward` share."""

from dataclasses import asdict, dataclass, fields, replace
import os
from typing import Annotated, Any, TypeVar

from tap_ros.errors import ConfigError
from tap_ros.options import default_text
from tap_ros.recording.reading import Reading
from tap_ros.training.recipes import DEFAULT, find_recipe, Model
from tap_ros.training.train import recipe_of, train
from tyro import conf

Recordings = Annotated[conf.Positional[tuple[str, ...]], conf.arg(
    metavar='BAG [BAG ...]', help_behavior_hint='(required)')]


@dataclass(frozen=True, kw_only=True)
class RecipeOption:
    """
    Whose settings are the defaults.

    :param recipe: name of a recipe (training/recipes.py); without it that of the task that the
        recordings name, else the one whose defaults are shown here.
    """

    recipe: Annotated[str, conf.arg(metavar='NAME', help_behavior_hint=default_text)] = ''


Options = TypeVar('Options', bound=RecipeOption)


def with_recipe(model: Model, args: Options) -> Options:
    """
    Put the settings of the recipe into the options of a command.

    :param model: 'predictor' or 'forward'.
    :param args: options; their fields beside `recipe` are dataclasses of settings.
    """
    given = settings_of(args)
    if not given['recordings']:
        raise ConfigError('missing: BAG; name the recordings, or see --help')
    recipe = args.recipe or recipe_of(model, given['recordings'], Reading(**{
        field.name: given[field.name] for field in fields(Reading)}))
    settings = find_recipe(model, recipe).settings
    changed: dict[str, Any] = {
        name: replace(part, **{key: settings[key] for key in asdict(part).keys() & settings})
        for name, part in vars(args).items() if name != 'recipe'}
    return replace(args, **changed)


def settings_of(args: RecipeOption) -> dict[str, Any]:
    """Return the settings of all parts of a command's options, by name."""
    return {name: value for key, part in vars(args).items() if key != 'recipe'
            for name, value in asdict(part).items()}


def run_training(model: Model, args: RecipeOption) -> None:
    """Train with the options' settings, and print where the weights are."""
    settings = settings_of(args)
    weights = train(settings.pop('recordings'), settings.pop('out'), model,
                    args.recipe or DEFAULT[model], **settings)
    if not int(os.environ.get('LOCAL_RANK', 0)):
        print(weights)
