# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
What is compared: methods of planning, written as a base and options, 'genmin:true_model'.

Bases: 'nothing', 'direct', the name of a predictor ('genmin', 'fix', 'shipped'), and bounds that
know more than a robot would: 'one_object', 'oracle_order', 'true_subgoal'. Options replace one
part of the chain by another, or by its true counterpart; see OPTIONS.
"""

from dataclasses import dataclass, fields, replace
import re

from tap_ros.errors import ConfigError
from tap_ros.planning.mpc_config import LARGE, PAPER

BASES = ('nothing', 'direct', 'one_object', 'oracle_order', 'true_subgoal')
BOUNDS = ('one_object', 'oracle_order', 'true_subgoal', 'true_model')
OPTIONS = {  # option: (field, value; None: the number behind it)
    'half': ('switch', 'half'), 'stalled': ('switch', 'stalled'),
    'reached': ('switch', 'reached'),
    'recursion': ('recursion', None), 'rounds': ('rounds', None), 'samples': ('samples', None),
    'carried': ('tracking', 'carried'), 'true_maps': ('maps', 'true'),
    'true_model': ('model', 'true'), 'more_search': ('search', 'more'),
    'twice': ('search', 'twice'), 'paper': ('search', 'paper'), 'plain_cost': ('cost', 'plain'),
    'every': ('replan_every', None), 'steps': ('step_budget', None)}
SUBGOALS_ONLY = ('switch', 'recursion', 'rounds', 'samples', 'maps')


@dataclass(frozen=True)
class Method:
    """
    A way to plan.

    :param base: one of BASES, or the name of a predictor.
    :param switch: 'reached', 'stalled' or 'half', see planning.hierarchy.Itinerary.
    :param recursion: subgoals in a row.
    :param rounds: how often subgoals are predicted, see planning.reach.ReachConfig.
    :param samples: subgoals to choose from by the planner's own cost.
    :param maps: 'predicted'; 'true': where the objects are in that true configuration (some at
        their goals, the others at their starts) whose picture is nearest to the predicted one.
    :param tracking: 'ground_truth': object pixels from the simulator at every step; 'carried':
        only in the first picture, then followed by planning.tracking.
    :param model: 'learned' or 'true', the simulator itself.
    :param search: 'preset'; 'twice': twice the samples, elites and proposals; 'more': samples,
        iterations and proposals of LARGE; 'paper': the paper's planner, mpc_config.PAPER, whatever
        else is set.
    :param cost: 'preset'; 'plain': the sum of distances alone, as in the paper, nothing that
        prefers to bring one object home before the next (VisualMPCConfig.unfinished).
    :param replan_every: see VisualMPCConfig; 0: as the preset has it.
    :param step_budget: control periods at most; 0: the task's, see contract.step_budget.
    """

    base: str
    switch: str = 'reached'
    recursion: int = 1
    rounds: int = 1
    samples: int = 1
    maps: str = 'predicted'
    tracking: str = 'ground_truth'
    model: str = 'learned'
    search: str = 'preset'
    cost: str = 'preset'
    replan_every: int = 0
    step_budget: int = 0

    @property
    def predicted(self):
        """Whether a predictor is needed."""
        return self.base not in BASES

    @property
    def name(self):
        """Return the canonical text, which parse_method reads."""
        parts = []
        for word, (field, value) in OPTIONS.items():
            mine = getattr(self, field)
            if mine != DEFAULTS[field] and value in (None, mine):
                parts.append(word if value else f'{word}{mine}')
        if self.base == 'direct' and parts == ['true_model']:
            return 'true_model'
        return ':'.join([self.base, *parts])

    @property
    def file_name(self):
        """Return the name without signs that file systems dislike."""
        return self.name.replace(':', '--')

    def planner(self, config):
        """Return a VisualMPCConfig changed as this method wants it."""
        if self.search == 'paper':
            config = PAPER
        if self.search == 'twice':
            config = with_samples(config, 2 * config.search.num_samples)
        if self.search == 'more':
            config = replace(config, search=LARGE.search, proposals=LARGE.proposals,
                             batch_size=LARGE.batch_size)
        if self.cost == 'plain':
            config = replace(config, unfinished=0.0)
        if self.replan_every:
            config = replace(config, replan_every=self.replan_every)
        if self.model == 'true':  # the simulator rolls out all samples by itself
            config = replace(config, batch_size=config.search.num_samples, threads=1)
        return config


def with_samples(config, num_samples):
    """Return a VisualMPCConfig with so many samples, elites and proposals in proportion."""
    share = num_samples / config.search.num_samples
    search = replace(config.search, num_samples=num_samples,
                     num_elites=max(2, round(share * config.search.num_elites)))
    return replace(config, search=search, proposals=int(share * config.proposals))


DEFAULTS = {field.name: field.default for field in fields(Method)}


def parse_method(text, **defaults):
    """
    Read a method.

    :param text: base and options, for example 'fix', 'genmin:recursion2:half', 'true_model'.
    :param defaults: fields of Method that options may change.
    :return: Method; fields that the base has no use for are at their defaults.
    :raises ConfigError: for an unknown option or an impossible combination.
    """
    base, *options = text.split(':')
    if base == 'true_model':
        base, options = 'direct', ['true_model', *options]
    if not re.fullmatch(r'[A-Za-z0-9_.+-]+', base):
        raise ConfigError(f'method {text!r}: expected a base and options, such as genmin:half')
    values = {'base': base, **defaults}
    for option in options:
        word, number = re.fullmatch(r'(.*?)(\d*)', option).groups()
        field, value = OPTIONS.get(word, (None, None))
        if field is None or (value is None) != bool(number):
            raise ConfigError(f'method {text!r}: option {option!r} is unknown; valid options: '
                              + ', '.join(w + ('' if v else '<n>')
                                          for w, (_, v) in OPTIONS.items()))
        values[field] = value or int(number)
    unused = []
    if base in BASES:
        unused = [f for f in SUBGOALS_ONLY if base != 'true_subgoal' or f in (
            'rounds', 'samples', 'maps')]
    if base in ('oracle_order',):
        unused.remove('switch')
    if base == 'nothing':
        unused = [f for f in DEFAULTS if f != 'base']
    method = Method(**(values | {field: DEFAULTS[field] for field in unused}))
    if min(method.recursion, method.rounds, method.samples) < 1:
        raise ConfigError(f'method {text!r}: recursion, rounds and samples are at least 1')
    if method.samples > 1 and method.model == 'true':
        raise ConfigError(f'method {text!r}: the simulator cannot start from a predicted picture, '
                          'so samples cannot be chosen by it; leave out one of the two')
    return method
