# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
The control loop: from what is seen to the next command, without ROS and without an own clock.

visual_mpc_node and the evaluation both drive it, so that they act alike:

    reach = Reach(mpc, ReachConfig(step_budget=40), seed)
    while not isinstance(answer := reach.step(seen), End):
        if isinstance(answer, SelectTargets):
            reach.set_targets(targets)          # decided from answer.seen
        elif isinstance(answer, Command):
            seen = carry_out(answer.plan.action)
            reach.sent()
        else:                                # Wait
            seen = look_again()
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from tap_ros.base.contract import GOAL_TOLERANCE, HIDDEN, LOST, step_budget, UNSURE
from tap_ros.base.text import listing
from tap_ros.planning.action_sequences import DOWN, FULL, Limits, UP
from tap_ros.planning.hierarchy import Itinerary, Target
from tap_ros.planning.visual_mpc import Goal, Memory, Plan, Scene, VisualMPC

MOST_REFUSED = 5  # commands refused in a row, after which the goal ends
MOST_UNSURE = 10  # pictures in a row in which an object is not known for sure; likewise
MOST_LATE = 3  # plans in a row that took too long to be acted upon; likewise
MOST_HELD, HELD = 3, 0.02  # moves, of which the message tells; m, shorter ones do not count
SENDING = 0.1  # share of max_age that is left for sending a command
MOVED = 0.8  # share of a move from which on a picture shows its effect


@dataclass(frozen=True)
class Observation:
    """What is seen at one moment."""

    image: np.ndarray  # (H, W, 3) uint8
    gripper: np.ndarray  # (4,) metres and opening
    names: tuple[str, ...]  # K object names
    pixels: np.ndarray  # (K, 2) (u, v), in the order of the names; the last ones of the hidden
    stamp_ns: int  # of the picture
    # s, on the clock of `now`: when the oldest part of it was received; inf: it does not age, as
    # where time stands until the next command
    received: float = 0.0
    scene_ns: int = 0  # stamp at which the newest scene known of began; 0: nothing is known
    jumps: int = 0  # how often the clock of the stamps has jumped so far
    states: tuple[str, ...] = ()  # K of base.contract.STATES; none: all are seen


@dataclass(frozen=True)
class ReachConfig:
    """
    Settings of one goal.

    :param step_budget: commands at most; 0: contract.step_budget.
    :param switch: when to go on from a subgoal, see hierarchy.Itinerary.
    :param reached: px, mean distance of the objects; nearer than this is there. 0: never.
    :param limits: action_sequences.Limits of the actions.
    :param max_age: s; nothing is planned from what was received longer ago. Plans end in time
        for their command to be younger.
    :param timeout: s without a command, planning apart, after which the goal ends.
    :param rounds: how often to ask where to go, at least 1: again when the subgoals of a round are
        passed and a command was sent since it began, and not after the last round.
    :param passed: px, as reached, of subgoals: objects that are pushed slide on, and where they
        come to rest the next leg begins. 0: as `reached`.
    """

    step_budget: int = 0
    switch: str = 'reached'
    reached: float = GOAL_TOLERANCE
    limits: Limits = FULL
    max_age: float = float('inf')
    timeout: float = float('inf')
    rounds: int = 1
    passed: float = 0.0


@dataclass(frozen=True)
class SelectTargets:
    """Decide from `seen` what to go to, and say so by Reach.set_targets."""

    seen: Observation


@dataclass(frozen=True)
class Command:
    """Carry out plan.action, and say so by Reach.sent; what is not carried out is planned anew."""

    plan: Plan
    stage: int  # index into Reach.targets
    seen: Observation  # what it answers


@dataclass(frozen=True)
class Wait:
    """Stand still and look again."""

    reason: str


@dataclass(frozen=True)
class End:
    """The goal has ended: 'reached', 'spent' (the step budget) or 'aborted'; and that in words."""

    outcome: str
    message: str


@dataclass(frozen=True)
class _State:
    """What a plan changes; it counts once the command is sent."""

    memory: Memory
    itinerary: Itinerary  # of this round, that is, of the last answer to SelectTargets
    round: int = 1
    first_step: int = 0  # of this round
    earlier: tuple[Target, ...] = ()  # subgoals passed in the rounds before
    switches: tuple[int, ...] = ()  # steps at which the targets after the first one began


class Reach:
    """
    Reach one goal.

    The same things seen and the same seed give the same answers: what step changes counts only
    once `sent` has been called, so it may be called any number of times in between. A picture is
    planned from once.

    :param seed: of the planner.
    :param now: s, on any clock that does not go back; 0.0 throughout if time does not matter.
    :ivar steps: commands carried out.
    :ivar distance: px, from the objects to the goal when last seen; NaN before.
    :ivar pixels: (K, 2), where the objects were then.
    :ivar switches: steps at which the second, third ... target began.
    """

    def __init__(self, mpc: VisualMPC, config: ReachConfig, seed: int = 0,
                 now: float = 0.0) -> None:
        self._mpc, self._config, self._seed = mpc, config, seed
        self._tabulated: tuple[Target, Goal] | None = None
        self._first: Observation | None = None
        self._unsure: dict[str, set[int]] = {}  # object -> stamps of pictures in a row
        self._planned: Command | None = None
        self._answered: Command | None = None
        self._after_ns = -1  # pictures count that are stamped later than this
        self._surely_ns = -1  # and those that do not show the last move yet, later than this
        self._from = self._stood = np.zeros(4)  # gripper at its beginning; when last seen
        # After the last command; before it, with what was answered and sent then; after the next.
        self._state: _State | None = None
        self._before: tuple[_State, Command | None, float] | None = None
        self._next: _State | None = None
        self._refusal, self._refused = '', 0  # why the last command was refused; how many in a row
        self._late = 0  # plans in a row
        self._held = 0  # moves through the air that the arm did not make
        self._sent_at = now  # of the last command, or when there was reason to wait
        self.steps, self.distance = 0, float('nan')
        self.pixels = np.empty((0, 2), np.float32)

    @property
    def targets(self) -> list[Target]:
        """Return the subgoals of all rounds so far, then the goal; empty before set_targets."""
        return [*self._next.earlier, *self._next.itinerary.targets] if self._next else []

    @property
    def switches(self) -> list[int]:
        """Return the steps at which the targets after the first one began."""
        return list(self._next.switches) if self._next else []

    def step(self, seen: Observation | None, now: float = 0.0,
             missing: str = '') -> SelectTargets | Command | Wait | End:
        """
        Answer what is seen.

        :param seen: Observation, or None when nothing is.
        :param now: s, on the clock of Observation.received.
        :param missing: why nothing is seen, or nothing new, for the message.
        :return: SelectTargets, Command, Wait or End.
        :raises PlanningError: for what cannot be planned with.
        """
        if self._refused >= MOST_REFUSED:
            return End('aborted', f'{self._refused} commands in a row were refused, the last one '
                                  f'as: {self._refusal}')
        answer = self.interrupted(seen) or self._answer(seen, now, missing)
        silence = now - self._sent_at
        if isinstance(answer, (Wait, Command)) and silence > self._config.timeout:
            why = answer.reason if isinstance(answer, Wait) else (
                missing or 'what is seen is always too old when its command is planned')
            return End('aborted', f'no command could be sent for {silence:.1f} s: {why}')
        if isinstance(answer, Command) and answer is not self._planned:
            self._planned = answer
            took = answer.plan.planning_ms / 1e3
            self._sent_at += took  # planning is no silence
            age = now - seen.received if seen is not None else 0.0
            self._late = self._late + 1 if age + took > self._config.max_age else 0
            if self._late >= MOST_LATE:
                return End('aborted', (
                    f'{self._late} plans in a row came too late: the last took {took:.2f} s, with '
                    f'{answer.plan.num_samples} samples, from what was {age:.2f} s old then, and '
                    f'max_age is {self._config.max_age:g} s; raise max_age, take the preset quick '
                    'or let this machine do less'))
        return answer

    def _answer(self, seen: Observation | None, now: float,
                missing: str) -> SelectTargets | Command | Wait | End:
        """Answer what is seen, whatever the time that has passed without a command."""
        if seen is None:
            return Wait(missing or 'nothing is seen')
        if seen.stamp_ns <= self._after_ns:
            return Wait(f'the last command was refused: {self._refusal}' if self._before is None
                        and self._refusal else missing or 'no new picture since the last command')
        if seen.stamp_ns < seen.scene_ns:
            return Wait('the picture is of an old scene')
        age = now - seen.received
        if age > self._config.max_age:
            return Wait(f'what was seen is {age:.1f} s old' + (f': {missing}' if missing else ''))
        if now - self._sent_at < self._config.timeout / 2 and self._is_early(seen):
            return Wait(missing or 'the last move is not seen yet')
        if self._planned is not None and self._planned.seen.stamp_ns == seen.stamp_ns:
            return self._planned
        self._first = self._first or seen
        if self._state is None:
            return Wait('an object is unsure') if UNSURE in seen.states else SelectTargets(seen)
        return self._plan(seen, self._state, (1 - SENDING) * self._config.max_age - age)

    def _is_early(self, seen: Observation) -> bool:
        """Return whether a picture may be of before the end of the last move."""
        if self._answered is None or seen.stamp_ns > self._surely_ns:
            return False
        told = self._answered.plan.action[:3]
        return bool((seen.gripper - self._from)[:3] @ told < MOVED * (told @ told))

    def _is_held(self) -> bool:
        """Return whether the last move, lifted, went less than half as far as told."""
        if self._answered is None:
            return False
        told, way = self._answered.plan.action[:2], (self._stood - self._from)[:2]
        least = min(HELD, self._config.limits.move / 2)
        return bool(told @ told > least ** 2 and min(self._from[2], self._stood[2]) > UP
                    and way @ told < 0.5 * told @ told)

    def interrupted(self, seen: Observation | None) -> End | None:
        """
        Return the End if another scene is seen, or an object cannot be found, else None.

        To be asked again before a command is carried out, as planning takes time: from where the
        gripper stands then the move begins.
        """
        if seen is None:
            return None
        self._stood = seen.gripper
        if self._first is not None and (change := scene_change(self._first, seen)):
            return End('aborted', f'the scene has changed: {change}')
        doubt = self._doubt(seen) if seen.stamp_ns >= seen.scene_ns else ''
        return End('aborted', doubt) if doubt else None

    def _doubt(self, seen: Observation) -> str:
        """Say which objects can no longer be followed; an empty string if all can."""
        if lost := [name for name, state in zip(seen.names, seen.states) if state == LOST]:
            return f'{listing(lost)} lost; see where it is, and select the objects again'
        for name, state in zip(seen.names, seen.states):
            stamps = self._unsure.setdefault(name, set())
            if not self._is_early(seen):
                stamps.add(seen.stamp_ns)
            if state != UNSURE:
                stamps.clear()
            if len(stamps) >= MOST_UNSURE:
                return (f'{name} is unsure in {len(stamps)} pictures in a row, the arm lifted; '
                        'see where it is, and select the objects again')
        return ''

    def set_targets(self, targets: Sequence[Target], now: float = 0.0) -> None:
        """
        Say what to go to; what is left of the step budget is for these targets.

        :param targets: list of hierarchy.Target, the last one is the goal.
        :param now: deciding may have taken time, which does not count as silence.
        """
        config, passed = self._config, self._next
        self._budget = config.step_budget or step_budget(len(targets[-1].pixels))
        state = _State(Memory(self._seed), Itinerary(
            targets, self._budget - self.steps, config.switch,
            config.passed or config.reached))
        if passed is not None and self._state is not None:
            met = self._state.memory
            state = replace(
                state, memory=Memory(self._seed, heights=met.heights, blocked=met.blocked),
                round=passed.round + 1, first_step=self.steps, switches=passed.switches,
                earlier=(*passed.earlier, *passed.itinerary.targets[:-1]))
        self._state = self._next = state
        self._sent_at = now

    def sent(self, after_ns: int | None = None, now: float = 0.0, late_ns: int = 0) -> None:
        """
        Say that the last Command is carried out.

        :param after_ns: pictures show its effect that are stamped later than this; None: than the
            picture that it answers.
        :param now: s.
        :param late_ns: the move may be seen so much later; until then only pictures count that
            show most of it. It is never waited for longer than half the timeout.
        """
        command, self._planned = self._planned, None
        assert command is not None and self._state is not None, 'a Command comes first'
        if self._before is not None:  # the command before this one was carried out
            self._refused = 0
            self._held += self._is_held()
        self._before = self._state, self._answered, self._sent_at
        self._sent_at = now
        self._state, self._answered = self._next, command
        self._after_ns = command.seen.stamp_ns if after_ns is None else after_ns
        self._surely_ns, self._from = self._after_ns + late_ns, self._stood
        self.steps += 1

    def refused(self, stamp_ns: int, reason: str) -> bool:
        """
        Say that a command was not carried out after all: a newer picture is to be answered.

        :param stamp_ns: of the picture that it answered.
        :param reason: why; told when no newer picture comes.
        :return: whether it was the last one of this goal.
        """
        refused = self._answered
        if self._before is None or refused is None or refused.seen.stamp_ns != stamp_ns:
            return False
        (self._state, self._answered, self._sent_at), self._before = self._before, None
        self._next = self._state
        self._after_ns = self._surely_ns = refused.seen.stamp_ns
        self._planned = None
        self.steps -= 1
        self._refusal, self._refused = reason, self._refused + 1
        return True

    def _plan(self, seen: Observation, state: _State,
              seconds: float) -> SelectTargets | Command | End:
        """Plan the next command from a new picture within so many seconds."""
        config, itinerary = self._config, state.itinerary
        self._next = state
        self.pixels = pixels = seen.pixels
        self.distance = itinerary.targets[-1].distance(pixels)
        hidden = [name for name, known in zip(seen.names, seen.states) if known == HIDDEN]
        guess = f'; the place of {listing(hidden)}, hidden, is a guess' if hidden else ''
        close = self.distance <= config.reached and UNSURE not in seen.states
        if close and not (hidden and seen.gripper[2] < UP):
            return End('reached', f'reached{guess}')
        if self.steps >= self._budget:
            held = self._held + self._is_held()
            short = (f'; {held} moves through the air went less than half as far as told: the arm '
                     'may not reach that far, limit its workspace') if held >= MOST_HELD else ''
            return End(
                'spent', f'stopped, as the step budget of {self._budget} is spent{guess}{short}')
        # Nothing is pushed by a place that is not believed, nothing ends by one that is not seen.
        if close or UNSURE in seen.states:
            plan = self._mpc.aside(seen.gripper, self.distance, state.memory, config.limits)
            self._next = replace(state, memory=plan.memory)
            return Command(plan, len(state.switches), seen)
        before = len(state.switches) - len(state.earlier)
        lifted = 0 < state.memory.heights[0] <= DOWN < seen.gripper[2]
        stage = itinerary.stage(self.steps - state.first_step, pixels, before, lifted)
        self._next = state = replace(
            state, switches=state.switches + (self.steps,) * (stage - before))
        if (0 < stage == len(itinerary.targets) - 1 and state.round < config.rounds
                and self.steps > state.first_step):
            return SelectTargets(seen)
        # tabulate the goal, once unless objects are free
        target, known = itinerary.targets[stage], self._tabulated
        if known is None or known[0] is not target or target.free is not None:
            inside = np.clip(pixels, 0, np.array(seen.image.shape[1::-1]) - 1)
            known = self._tabulated = target, self._mpc.goal(**target.goal(inside))
        plan = self._mpc.plan(Scene(seen.image, seen.gripper, pixels), known[1], state.memory,
                              config.limits, seconds)
        self._next = replace(state, memory=plan.memory)
        return Command(plan, len(state.switches), seen)


def scene_change(first: Observation, seen: Observation) -> str:
    """Say in what way a scene is another than at the start of a goal; '' if it is the same."""
    if seen.jumps != first.jumps:
        return 'the clock of its stamps has jumped: another simulator, or a recording that loops'
    if seen.scene_ns > first.stamp_ns:
        return 'a new episode has begun'
    if set(seen.names) != set(first.names):
        gone = [name for name in first.names if name not in seen.names]
        come = [name for name in seen.names if name not in first.names]
        return '; '.join(f'{listing(names)} {what}' for names, what in (
            (come, 'appeared'), (gone, 'vanished')) if names)
    return ''
