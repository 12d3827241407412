# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Names of methods in results: copying, the best of 100, networks and variants."""

import re

from experiments.paper.runs import LONG, OURS, PAST_VARIANTS, VARIANTS

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
