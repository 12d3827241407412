# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Names of methods in results: copying, the best of 100, networks, variants; and their order."""

import re

from experiments.paper.runs import LONG, OURS, PAST_VARIANTS, VARIANTS
from tap_ros.prediction.methods import method_fields

COPIES = ('copy-start', 'copy-goal')
BEST = 'best-of-100'


def best_of_name(method):
    """
    Name the best of 100 samples of a method.

    The paper's genmin + vae is its Eq. 10, with GAN: genmin-vae-gan here. So its samples are those
    of genmin-vae-best-of-100; those of the CVAE without GAN (Eq. 9), genmin-vae here, are of
    genmin-vae-wo-gan-best-of-100.

    :param method: name of a method with a VAE.
    :return: for example 'genmin-vae-best-of-100', with +relative or the like at its end.
    """
    stem, plus, suffix = method.partition('+')
    stem = stem.removesuffix('-gan') if stem.endswith('-vae-gan') else f'{stem}-wo-gan'
    return f'{stem}-{BEST}{plus}{suffix}'


def variant_of(method):
    """Return which variant of runs.py a method's name has; '' for the method as it is."""
    name = re.sub(r'-r\d+$', '', method)
    return max((variant for variant in (*VARIANTS, *PAST_VARIANTS) if name.endswith(variant)),
               key=len)


def trained_as_long(method):
    """Return whether a method was trained for the usual number of steps."""
    return variant_of(method) not in LONG


def network_of(method):
    """Return OURS for a method with our network, '' for the paper's; both are variants."""
    return OURS if variant_of(method).startswith(OURS) else ''


def short_name(method):
    """Name a method without its network and without -wo-gan, as plots of one network do."""
    name = re.sub(r'-r\d+$', '', method)
    return name.removesuffix(OURS).replace('-wo-gan', '') + method[len(name):]


def method_order(method):
    """
    Give the place of a method in tables and pictures, as a sort key.

    Copying first, then the paper's network, then ours; of each: fix, min, genmin. Forward genmin
    is ordered by beta from large to small, as its match-steps rise.
    """
    if method in COPIES:
        return (0, 0, 0, COPIES.index(method), False, method)
    name = method.replace(f'-wo-gan-{BEST}', '').replace(f'-{BEST}', '')
    name = re.sub(r'-r\d+$', '', name)
    variant = variant_of(name)
    parsed = method_fields(name.removesuffix(variant))
    number = {'fix': parsed['fraction'], 'genmin': -parsed['beta']}.get(parsed['loss'], 0)
    kind = (('fix', 'min', 'genmin').index(parsed['loss']) + 1
            + 3 * (parsed['latent'] == 'vae') + 3 * (BEST in method))
    network = 1 + (network_of(method) == OURS)
    return (network, kind, parsed['selection'] != 'absolute', number, variant, method)
