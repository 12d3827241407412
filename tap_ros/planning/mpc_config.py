# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Settings of the planner, and presets of them; without torch, for command lines."""

from dataclasses import dataclass, replace
import math
from typing import Any

from tap_ros.base.errors import check_fields, ConfigError
from tap_ros.planning.action_sequences import HORIZON
from tap_ros.planning.protocols import SearchConfig, Solver

SWITCHES = ('reached', 'half')  # when to go on from a subgoal, see hierarchy.py


@dataclass(frozen=True)
class VisualMPCConfig:
    """
    Settings of the planner. The default does as well as larger ones.

    :param search: how much is searched.
    :param solver: name of a solver, see plugins.py, or a Solver.
    :param clearance: m from any object's pixel to where the gripper may come down.
    :param unfinished: px, extra cost of an object that is not yet within 3 px of its goal, so
        that one is brought home before the next is begun: each change costs a long way.
    :param warm_start: begin with the last plan, carried on by one control period, and near it.
    :param proposals: how many first samples are pushes aimed at the objects, see push_proposals.
    :param recheck: from how many places, where the gripper is and others about 1 cm beside it,
        the elites are judged once more: a push that succeeds from one place only would slip. 0:
        they are not.
    :param arm_hidden: the arm is not in the pictures.
    :param cost_every: the cost looks at every so many steps; 1: at all of them.
    :param batch_size: samples predicted at once, at most; threads: on the CPU. Both change the
        speed only.
    """

    search: SearchConfig = SearchConfig(num_samples=64, num_iterations=2, num_elites=8)
    solver: str | Solver = 'cem'
    clearance: float = 0.1
    unfinished: float = 4.0
    warm_start: bool = True
    proposals: int = 32
    recheck: int = 6
    arm_hidden: bool = False
    cost_every: int = 3
    batch_size: int = 32
    threads: int = 0  # 0: as many as there are cores

    def __post_init__(self) -> None:
        check_fields(self, {'batch_size': (1, math.inf), 'recheck': (0, math.inf),
                            'proposals': (0, self.search.num_samples),
                            'cost_every': (1, HORIZON)})
        if HORIZON % self.cost_every:
            raise ConfigError(f'cost_every: expected a divisor of the horizon {HORIZON}, '
                              f'got {self.cost_every}')


PRESETS = {
    'default': VisualMPCConfig(),
    # Half of the samples, none judged twice: less than half the time of a plan.
    'quick': VisualMPCConfig(SearchConfig(32, 2, 4), proposals=16, recheck=0),
    # The paper's number of samples: more than twice as slow, without a clear gain.
    'large': VisualMPCConfig(search=SearchConfig(), proposals=80, batch_size=50),
    # The paper's search and cost; what sequences can be is ours, see action_sequences.py.
    'paper': VisualMPCConfig(search=SearchConfig(), warm_start=False, proposals=0, cost_every=1,
                             clearance=0.0, unfinished=0.0, recheck=0, batch_size=50)}


def with_preset(name: str, **changes: Any) -> VisualMPCConfig:
    """
    Return a preset with changes.

    :raises ConfigError: for an unknown preset.
    """
    if name not in PRESETS:
        raise ConfigError(f'preset {name!r} is unknown; valid presets: {", ".join(PRESETS)}')
    return replace(PRESETS[name], **changes)
