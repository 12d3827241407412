# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Settings of the planner, and presets of them."""

from dataclasses import dataclass, replace
from typing import Any

from tap_ros.contract import CLIMB_LIMIT, MOVE_LIMIT
from tap_ros.errors import ConfigError
from tap_ros.planning.action_sequences import HORIZON, Limits, SequenceShape
from tap_ros.planning.cem import CEMConfig

SWITCHES = ('reached', 'stalled', 'half')  # when to go on from a subgoal, see hierarchy.py
STALL = 10  # control periods; most ways between two pushes take fewer


@dataclass(frozen=True)
class VisualMPCConfig:
    """
    Settings of the planner. The default does as well as larger ones; PAPER is the paper's.

    :param search: settings of the search.
    :param free_phase: search, too, for how many periods, 1..REPEAT, the first displacement lasts:
        a way need not take whole segments.
    :param push_limit: m per control period while the gripper is low, so that pushes are like the
        recorded ones; upright: go up and down without moving sideways, like them.
    :param clearance: m from any object's pixel to where the gripper may come down.
    :param unfinished: px, extra cost of an object that is not yet within 3 px of its goal, so
        that one is brought home before the next is begun: each change costs a long way.
    :param warm_start: begin with the last plan, carried on by one control period, and near it.
    :param proposals: how many first samples are pushes aimed at the objects, see proposals.py.
    :param recheck: from how many places, where the gripper is and others about 1 cm beside it,
        the elites are judged once more: a push that succeeds from one place only would slip. 0:
        they are not.
    :param arm_hidden: the arm is not in the pictures.
    :param cost_every: the cost looks at every so many steps; 1: at all of them.
    :param replan_every: search anew at every so many actions, or when the goal changes; between
        these the last plan is carried out.
    :param batch_size: samples predicted at once, at most; threads: on the CPU. Both change the
        speed only.
    """

    search: CEMConfig = CEMConfig(num_samples=64, num_iterations=2, num_elites=8)
    free_phase: bool = True
    push_limit: float = SequenceShape.push_limit
    upright: bool = SequenceShape.upright
    clearance: float = 0.1
    unfinished: float = 4.0
    warm_start: bool = True
    proposals: int = 32
    recheck: int = 6
    arm_hidden: bool = False
    cost_every: int = 3
    replan_every: int = 1
    batch_size: int = 32
    threads: int = 0  # 0: as many as there are cores

    def __post_init__(self) -> None:
        if self.batch_size < 1:
            raise ConfigError(f'batch_size: expected at least 1, got {self.batch_size}')
        if self.cost_every < 1 or HORIZON % self.cost_every:
            raise ConfigError(f'cost_every: expected a divisor of the horizon {HORIZON}, '
                              f'got {self.cost_every}')
        if not 1 <= self.replan_every <= HORIZON:
            raise ConfigError(f'replan_every: expected 1..{HORIZON} (the horizon), '
                              f'got {self.replan_every}')
        if self.recheck < 0:
            raise ConfigError(f'recheck: expected at least 0, got {self.recheck}')
        if not 0 <= self.proposals <= self.search.num_samples:
            raise ConfigError(f'proposals: expected 0..{self.search.num_samples} '
                              f'(num_samples), got {self.proposals}')

    def shape(self, limits: Limits, phase: int | None) -> SequenceShape:
        """
        Return the SequenceShape that is searched.

        :param limits: Limits; phase: periods that the first segment is shorter, unless searched.
        """
        move = min(limits.move, MOVE_LIMIT)
        return SequenceShape(None if self.free_phase else phase, move, min(move, self.push_limit),
                             self.upright, min(limits.climb, CLIMB_LIMIT))


# The paper's numbers of samples: more than twice as slow, without a clear gain.
LARGE = VisualMPCConfig(search=CEMConfig(), proposals=80, batch_size=50)
# 0.08 m std and 0.16 m clip in the paper are for actions of 1 s; ours last 0.25 s.
PAPER = VisualMPCConfig(
    search=CEMConfig(), warm_start=False, proposals=0, cost_every=1, push_limit=MOVE_LIMIT,
    upright=False, clearance=0.0, unfinished=0.0, free_phase=False, recheck=0, batch_size=50)
PRESETS = {'default': VisualMPCConfig(), 'large': LARGE, 'paper': PAPER}


def with_preset(name: str, **changes: Any) -> VisualMPCConfig:
    """
    Return a preset with changes.

    :raises ConfigError: for an unknown preset.
    """
    if name not in PRESETS:
        raise ConfigError(f'preset {name!r} is unknown; valid presets: {", ".join(PRESETS)}')
    return replace(PRESETS[name], **changes)
