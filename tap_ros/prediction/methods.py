# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The methods of the paper by their names (section 4), and the forms of ours beside them."""

from dataclasses import dataclass
import re
from typing import get_args, Literal

from tap_ros.errors import ConfigError

Mode = Literal['bidirectional', 'forward']
MODES = get_args(Mode)
SELECTIONS = ('time_preference', 'relative_to_copying', 'cost_of_reaching', 'picture_progress')
DEFAULT_BETA = 4.0  # of plain genmin in forward prediction; in the paper 2, 4 and 7 did best
NAMES = ('fix, fix0.25 ... fix1.00 (a share of the episode), min, genmin, genmin<beta> (forward), '
         'each with -wo-gan, -vae or -vae-gan, and genmin with +relative, +reach or '
         '+progress (bidirectional)')
_NAME = re.compile(
    r'(?P<loss>fix|min|genmin)(?P<number>\d+(\.\d+)?|inf)?'
    r'(?P<model>-wo-gan|-vae-gan|-vae)?(?P<selection>\+relative|\+reach|\+progress)?')


@dataclass(frozen=True)
class Method:
    """
    What a name stands for.

    :param name: as given.
    :param loss: 'fix' (Eq. 1), 'min' (Eq. 2) or 'genmin' (Eq. 5).
    :param fraction: of the episode at which fix has its target, 0 to 1; None for the others.
    :param beta: of the linear preference of genmin<beta>; None where the name says nothing.
    :param gan: whether discriminators take part (Eq. 11).
    :param vae: whether there is a latent z (Eq. 9); with gan it is Eq. 10.
    :param selection: the selection error E'_t of genmin, one of SELECTIONS.
    """

    name: str
    loss: str
    fraction: float | None
    beta: float | None
    gan: bool
    vae: bool
    selection: str


def parse_method(name: str) -> Method:
    """
    Find out what a method's name stands for.

    As in the paper's tables, fix, min and genmin alone are trained with l1 and GAN; -wo-gan is l1
    only, -vae the CVAE without GAN, -vae-gan both. +relative, +reach and +progress are not in the
    paper: they select by relative_to_copying, by cost_of_reaching and with the preference over
    picture_progress (see losses).

    :param name: for example 'fix0.25', 'genmin4', 'genmin-vae-gan', 'genmin-wo-gan+relative'.
    :return: Method.
    :raises ConfigError: if it is no such name.
    """
    found = _NAME.fullmatch(name)
    if not found:
        raise ConfigError(f'method: expected one of {NAMES}; got {name!r}')
    loss, model = found['loss'], found['model']
    number = None if found['number'] is None else float(found['number'])
    if loss == 'fix' and number is not None and not 0 < number <= 1:
        raise ConfigError(f'method: fix{found["number"]}: expected a share of the episode above 0 '
                          'and at most 1, such as fix0.25')
    if loss == 'min' and number is not None:
        raise ConfigError(f'method: {name!r}: min takes no number; genmin<beta> does')
    if loss == 'genmin' and number == 0:
        raise ConfigError('method: genmin0: expected a beta above 0, such as genmin0.5')
    if loss != 'genmin' and found['selection']:
        raise ConfigError(f'method: {name!r}: only genmin chooses by another error')
    return Method(
        name, loss,
        fraction=(0.5 if number is None else number) if loss == 'fix' else None,
        beta=number if loss == 'genmin' else None,
        gan=model in (None, '-vae-gan'), vae=model in ('-vae', '-vae-gan'),
        selection={None: SELECTIONS[0], '+relative': SELECTIONS[1],
                   '+reach': SELECTIONS[2], '+progress': SELECTIONS[3]}[found['selection']])
