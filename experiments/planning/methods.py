# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
What is compared: methods, written as a base and options, such as 'genmin:recursion2:half'.

Of pushing: 'nothing'; 'direct', to the goal; the name of a predictor ('shipped', 'fix', 'genmin'),
by its subgoals; and bounds that know more than a robot would: 'oracle_order', one object after
another in the right order, and 'true_subgoal', the true places with the right object moved.

Of stacking: which pictures are brought about, and in which order. 'nothing'; 'direct', the goal
picture alone; 'lowest_first', likewise, what is lowest in it first; a predictor: its subgoals,
then the goal. Bounds: 'true_subgoals' are frames of the expert, 'oracle_order' knows which object
has to be moved first, and 'true_places' also where to, from no picture.
"""

from dataclasses import dataclass, fields, replace
import re

from tap_ros.base.errors import ConfigError
from tap_ros.base.plugins import names
from tap_ros.weights import PLANNING_TASKS

FIRST_SCENE = 1_000_000  # seed of the scenes that are planned in, far from the recordings'
STACKING_TASKS = ('stack3', 'stack2', 'pick_place')
TASKS = (*PLANNING_TASKS, *STACKING_TASKS)
FIRST_SCENES = {**dict.fromkeys(PLANNING_TASKS, FIRST_SCENE),
                **dict.fromkeys(STACKING_TASKS, 1_200_000)}  # how to read was tried in others
BOUNDS = ('oracle_order', 'true_subgoal', 'true_subgoals', 'true_places')
BASES = ('nothing', 'direct', 'lowest_first', *BOUNDS)
USUAL = {
    **dict.fromkeys(PLANNING_TASKS, (
        'nothing', 'direct', 'direct:twice', 'fix', 'genmin', 'genmin+progress',
        'genmin+relative', 'shipped', 'oracle_order', 'true_subgoal', 'true_model')),
    **dict.fromkeys(STACKING_TASKS, (
        'nothing', 'direct', 'lowest_first', 'fix', 'genmin', 'genmin+progress', 'shipped',
        'shipped:recursion2', 'genmin+progress-r2:recursion2', 'true_subgoals', 'oracle_order',
        'true_places'))}
OPTIONS = {  # option: (field, value; None: the number behind it)
    'half': ('switch', 'half'), 'stalled': ('switch', 'stalled'),  # results have it, plans not
    'recursion': ('recursion', None), 'rounds': ('rounds', None), 'samples': ('samples', None),
    'tracked': ('tracking', 'rigid'),
    'twice': ('search', 'twice'), 'steps': ('step_budget', None),
    **{f'{name}_model': ('model', name) for name in names('tap_ros.forward_models')}}
SUBGOALS_ONLY = ('switch', 'recursion', 'rounds', 'samples')
USED = {'true_subgoal': ('switch', 'recursion'), 'oracle_order': ('switch',)}  # of these


@dataclass(frozen=True)
class Method:
    """
    A way to plan or to stack.

    :param base: one of BASES, or the name of a predictor.
    :param switch: 'reached' or 'half', see planning.hierarchy.Itinerary.
    :param recursion: subgoals in a row.
    :param rounds: how often subgoals are predicted, see planning.reach.ReachConfig.
    :param samples: subgoals to choose from by the planner's own cost.
    :param tracking: 'ground_truth': object pixels from the simulator at every step; 'rigid':
        clicks in the first picture, then followed, and found in the goal picture.
    :param model: name of a forward model, such as 'true', the simulator itself.
    :param search: 'preset'; 'twice': twice the samples, elites and proposals.
    :param step_budget: control periods at most; 0: the task's, see contract.step_budget.
    """

    base: str
    switch: str = 'reached'
    recursion: int = 1
    rounds: int = 1
    samples: int = 1
    tracking: str = 'ground_truth'
    model: str = 'learned'
    search: str = 'preset'
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
        if self.search == 'twice':
            config = with_samples(config, 2 * config.search.num_samples)
        if self.model == 'true':  # the simulator rolls out all samples by itself
            config = replace(config, batch_size=config.search.num_samples, threads=1)
        return config


DEFAULTS = {field.name: field.default for field in fields(Method)}


def parse_method(text):
    """Read a Method, for example 'fix', 'genmin:recursion2:half', 'true_model'; ConfigError."""
    base, *options = text.split(':')
    if base == 'true_model':
        base, options = 'direct', ['true_model', *options]
    if not re.fullmatch(r'[A-Za-z0-9_.+-]+', base):
        raise ConfigError(f'method {text!r}: expected a base and options, such as genmin:half')
    values = {'base': base}
    for option in options:
        word, number = re.fullmatch(r'(.*?)(\d*)', option).groups()
        field, value = OPTIONS.get(word, (None, None))
        if field is None or (value is None) != bool(number):
            raise ConfigError(f'method {text!r}: option {option!r} is unknown; valid options: '
                              + ', '.join(w + ('' if v else '<n>')
                                          for w, (_, v) in OPTIONS.items()))
        values[field] = value or int(number)
    unused = set(SUBGOALS_ONLY) - set(USED.get(base, ())) if base in BASES else ()
    if base == 'nothing':
        unused = set(DEFAULTS) - {'base'}
    method = Method(**(values | {field: DEFAULTS[field] for field in unused}))
    if min(method.recursion, method.rounds, method.samples) < 1:
        raise ConfigError(f'method {text!r}: recursion, rounds and samples are at least 1')
    if method.model != 'learned' and method.samples > 1:
        raise ConfigError(f'method {text!r}: samples are chosen by the learned model alone; leave '
                          'out one of the options')
    return method


def with_samples(config, num_samples):
    """Return a config with so many samples, and elites and proposals in proportion."""
    share = num_samples / config.search.num_samples
    search = replace(config.search, num_samples=num_samples,
                     num_elites=max(2, round(share * config.search.num_elites)))
    return replace(config, search=search, proposals=int(share * config.proposals))
