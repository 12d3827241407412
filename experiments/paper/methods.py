# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The methods of the paper (section 4) by their names in its tables and in results."""

import re

from tap_ros.base.errors import ConfigError

_NAME = re.compile(r'(?P<loss>fix|min|genmin)(?P<number>\d+(\.\d+)?)?'
                   r'(?P<model>-wo-gan|-vae-gan|-vae)?(\+(?P<selection>relative|progress|still|marks))?')


def method_fields(name):
    """
    Turn a method's name, TrainingConfig.method, into fields of TrainingConfig.

    As in the paper's tables, fix, min and genmin alone are trained with l1 and GAN; -wo-gan is l1
    only, -vae the CVAE without GAN (Eq. 9), -vae-gan both (Eq. 10). A number is the fraction of
    fix or the beta of genmin. +relative, +progress, +still and +marks are not in the paper.

    :param name: for example 'fix0.25', 'genmin4', 'genmin-vae-gan', 'genmin-wo-gan+relative'.
    :return: dict of loss, selection, gan, latent, fraction and beta.
    :raises ConfigError: if it is no such name.
    """
    found = _NAME.fullmatch(name)
    if not found or found['loss'] == 'min' and found['number'] or (
            found['selection'] and found['loss'] != 'genmin' and (
                found['loss'], found['selection']) != ('fix', 'marks')):
        raise ConfigError(f'method {name!r} is unknown; expected fix, fix<fraction>, min, genmin '
                          'or genmin<beta>, each with -wo-gan, -vae or -vae-gan, and genmin with '
                          '+relative, +progress, +still or +marks, fix with +marks')
    loss, model, number = found['loss'], found['model'], found['number']
    return {'loss': loss, 'selection': found['selection'] or 'absolute',
            'gan': model in (None, '-vae-gan'),
            'latent': 'vae' if model in ('-vae', '-vae-gan') else 'none',
            'fraction': float(number) if number and loss == 'fix' else 0.5,
            'beta': float(number) if number and loss == 'genmin' else 4.0}
