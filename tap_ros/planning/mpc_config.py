# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Settings of the planner, and presets of them."""

from dataclasses import dataclass, replace

from tap_ros.contract import MOVE_LIMIT
from tap_ros.errors import ConfigError
from tap_ros.planning.action_sequences import SequenceShape
from tap_ros.planning.cem import CEMConfig


@dataclass(frozen=True)
class VisualMPCConfig:
    """
    Settings of the planner. The default does as well as larger ones; PAPER is the paper's.

    :param search: settings of the search.
    :param segments: displacements of a sequence; repeat: control periods of each.
    :param free_phase: search, too, for how many periods, 1..repeat, the first displacement lasts:
        a way need not take whole segments.
    :param std_move: m per control period, of x and y in the first Gaussian; move_limit their clip.
    :param push_limit: m per control period while the gripper is low, so that pushes are like the
        recorded ones; upright: go up and down without moving sideways, like them.
    :param climb_limit: m per control period, up and down.
    :param clearance: m from any object's pixel to where the gripper may come down.
    :param max_lift: segments, at most, that the gripper travels lifted before it goes down.
    :param last_weight: weight of the horizon's last step in the cost; the others have 1.
    :param unfinished: px, extra cost of an object that is not yet within 3 px of its goal, so
        that one is brought home before the next is begun: each change costs a long way.
    :param warm_start: begin with the last plan, carried on by one control period.
    :param warm_std: share of std_move that the warm-started search begins with.
    :param proposals: how many first samples are pushes aimed at the objects, see proposals.py.
    :param recheck: from how many places, where the gripper is and others about recheck_std, m,
        beside it, the elites are judged once more: a push that succeeds from one place only would
        slip. 0: they are not.
    :param arm_hidden: the arm is not in the pictures.
    :param cost_every: the cost looks at every so many steps; 1: at all of them.
    :param replan_every: search anew at every so many actions, or when the goal changes; between
        these the last plan is carried out.
    :param batch_size: samples predicted at once, at most; threads: on the CPU. Both change the
        speed only.
    """

    search: CEMConfig = CEMConfig(num_samples=64, num_iterations=2, num_elites=8)
    segments: int = SequenceShape.segments
    repeat: int = SequenceShape.repeat
    free_phase: bool = True
    std_move: float = 0.04
    move_limit: float = SequenceShape.move_limit
    push_limit: float = SequenceShape.push_limit
    upright: bool = SequenceShape.upright
    climb_limit: float = SequenceShape.climb_limit
    clearance: float = 0.1
    max_lift: int = SequenceShape.max_lift
    last_weight: float = 10.0
    unfinished: float = 4.0
    warm_start: bool = True
    warm_std: float = 0.5
    proposals: int = 32
    recheck: int = 6
    recheck_std: float = 0.01
    arm_hidden: bool = False
    cost_every: int = 3
    replan_every: int = 1
    batch_size: int = 32
    threads: int = 0  # 0: as many as there are cores

    def __post_init__(self):
        for name in ('segments', 'repeat', 'batch_size', 'replan_every'):
            if getattr(self, name) < 1:
                raise ConfigError(f'{name}: expected at least 1, got {getattr(self, name)}')
        if self.cost_every < 1 or self.segments * self.repeat % self.cost_every:
            raise ConfigError(f'cost_every: expected a divisor of the horizon '
                              f'{self.segments * self.repeat}, got {self.cost_every}')
        if self.replan_every > self.segments * self.repeat:
            raise ConfigError(f'replan_every: expected at most the horizon '
                              f'{self.segments * self.repeat}, got {self.replan_every}')
        if self.recheck < 0 or self.recheck_std < 0:
            raise ConfigError(f'recheck, recheck_std: expected at least 0, got {self.recheck}, '
                              f'{self.recheck_std}')
        if not 0 <= self.max_lift < self.segments:
            raise ConfigError(
                f'max_lift: expected 0..{self.segments - 1} (segments - 1), got {self.max_lift}')
        if not 0 <= self.proposals <= self.search.num_samples:
            raise ConfigError(f'proposals: expected 0..{self.search.num_samples} '
                              f'(num_samples), got {self.proposals}')


# The paper's numbers of samples: more than twice as slow, without a clear gain.
LARGE = VisualMPCConfig(search=CEMConfig(), proposals=80, batch_size=50)
# 0.08 m std and 0.16 m clip in the paper are for actions of 1 s; ours last 0.25 s.
PAPER = VisualMPCConfig(
    search=CEMConfig(), warm_start=False, proposals=0, cost_every=1, push_limit=MOVE_LIMIT,
    upright=False, clearance=0.0, unfinished=0.0, free_phase=False, recheck=0, batch_size=50)
PRESETS = {'default': VisualMPCConfig(), 'large': LARGE, 'paper': PAPER}


def with_preset(name, **changes):
    """
    Return a preset with changes.

    :raises ConfigError: for an unknown preset.
    """
    if name not in PRESETS:
        raise ConfigError(f'preset {name!r} is unknown; valid presets: {", ".join(PRESETS)}')
    return replace(PRESETS[name], **changes)
