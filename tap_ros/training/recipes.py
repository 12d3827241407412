# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Recipes: what the shipped weights were trained on, and the settings that are not the default.

The defaults, in prediction/training_config.py and planning/forward_training_config.py, are those
of push2 and of the shipped forward model.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from difflib import get_close_matches
from types import MappingProxyType
from typing import Any, Literal

from tap_ros.errors import ConfigError

Model = Literal['predictor', 'forward']
DEFAULT = {'predictor': 'push2', 'forward': 'push'}


@dataclass(frozen=True)
class Recipe:
    """
    How weights are made.

    :param settings: of the training, beside the defaults.
    :param task: of the simulator; '': none, for any recordings.
    :param recordings: by the names of their folders, options of `collect` beside the task.
    """

    settings: Mapping[str, Any]
    task: str = ''
    recordings: Mapping[str, Mapping[str, Any]] = field(
        default_factory=lambda: MappingProxyType({}))


# Where objects stand close together, genmin over progress copies the start.
_BY_COPYING = {'selection': 'relative', 'progress_margin': 0.0}
# Pictures that must be made up, of a gripper where it was not yet, do not come by warping. A hand
# on an object is told by its colour; other colours teach that it has none.
_GRIPPING = {'progress_margin': 0.0, 'new_pixels': True, 'goal_picture': 'last',
             'start_crop': 0.0, 'colour': False, 'brightness': 0.0, 'steps': 4000}
_TINY = {'steps': 10, 'batch_size': 4, 'test_fraction': 0.3, 'threads': 1}

RECIPES: dict[str, dict[str, Recipe]] = {
    'predictor': {
        'push2': Recipe({}, 'push2', {
            'push2': {'episodes': 2000},
            'push2_random': {'episodes': 3500, 'appearance': 'random'}}),
        'order2': Recipe({**_BY_COPYING, 'initial_weights': 'push2', 'steps': 2500},
                         'order2', {'order2': {'episodes': 700}}),
        # Begins anywhere in the first 0.6: a second subgoal is predicted from where the first was.
        'order3': Recipe({**_BY_COPYING, 'start_crop': 0.6, 'initial_weights': 'push3',
                          'steps': 4000}, 'order3', {'order3': {'episodes': 700}}),
        'push3': Recipe(
            {'initial_weights': 'push2', 'steps': 3000}, 'push3', {'push3': {'episodes': 600}}),
        'stack2': Recipe(_GRIPPING, 'stack2', {'stack2': {'episodes': 1000}}),
        'stack3': Recipe(_GRIPPING, 'stack3', {'stack3': {'episodes': 1000}}),
        'grasp': Recipe(_GRIPPING, 'grasp', {'grasp': {'episodes': 3000}}),
        'grasp_forward': Recipe({**_GRIPPING, 'mode': 'forward', 'selection': 'absolute'},
                                'grasp', {'grasp': {'episodes': 3000}}),
        'pick_place': Recipe(
            {**_GRIPPING, 'steps': 10000}, 'pick_place', {'pick_place': {'episodes': 3000}}),
        'pick_place_vae': Recipe(
            {**_GRIPPING, 'selection': 'absolute', 'latent': 'vae', 'margin': 0, 'kl_weight': 2e-5,
             'free_nats': 4.0}, 'pick_place', {'pick_place': {'episodes': 3000}}),
        # A dozen marked demonstrations, see marks. Pieces without the marked moment teach another
        # one, and it may be three frames from the goal. As above, gripping hands must be made up.
        'foreign': Recipe({**_BY_COPYING, 'margin': 1, 'start_crop': 0.0, 'new_pixels': True,
                           'colour': False, 'brightness': 0.0, 'steps': 400, 'batch_size': 8}),
        # Ten steps, to see whether recordings can be trained on.
        'debug': Recipe({**_TINY, 'base_width': 4, 'precision': 'float32'})},
    'forward': {
        'push': Recipe({}, 'push2', {
            'misses': {'episodes': 1000, 'seed': 200000, 'misses': 0.7, 'look': 'hand',
                       'frames': 50},
            'push2': {'episodes': 600}}),
        'debug': Recipe(_TINY)}}


def find_recipe(model: str, name: str) -> Recipe:
    """
    Return a recipe by its name.

    :param model: 'predictor' or 'forward'.
    :param name: one of RECIPES of that model.
    :raises ConfigError: for an unknown name; it names the nearest one and all valid ones.
    """
    known = RECIPES[model]
    if name not in known:
        near = get_close_matches(name, known, 1)
        meant = f'did you mean {near[0]!r}? ' if near else ''
        raise ConfigError(f'recipe {name!r} is unknown; {meant}valid: {", ".join(known)}')
    return known[name]
