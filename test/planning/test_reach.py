# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Laws of the control loop, where all objects go where the gripper goes."""

from dataclasses import replace

import numpy as np
import pytest
from tap_ros.base.contract import LIFTED, LOW
from tap_ros.planning.hierarchy import Target
from tap_ros.planning.mpc_config import VisualMPCConfig
from tap_ros.planning.protocols import SearchConfig
from tap_ros.planning.reach import (
    Command,
    End,
    MOST_LATE,
    MOST_REFUSED,
    MOST_UNSURE,
    Observation,
    Reach,
    ReachConfig,
    SelectTargets,
    Wait,
)
from tap_ros.planning.visual_mpc import Memory, Scene, VisualMPC
from toy_world import SIZE, Telekinesis

SECOND = 10**9
START = np.array([[8.0, 8.0], [20.0, 20.0]], np.float32)
GOAL = Target(np.array([[12.0, 8.0], [20.0, 24.0]], np.float32))
SMALL = VisualMPCConfig(search=SearchConfig(8, 1, 2), proposals=4, batch_size=8, threads=1)


@pytest.fixture
def mpc():
    return VisualMPC(Telekinesis(), SMALL)


def look(t, pixels=START, **changes):
    """Return what is seen t seconds after the start; the picture differs from second to second."""
    image = np.random.default_rng(t).integers(0, 256, (SIZE, SIZE, 3), np.uint8)
    seen = Observation(image, np.array([0, 0, 0.1, 0], np.float32), ('a', 'b'), pixels,
                       (t + 1) * SECOND, received=float(t))
    return replace(seen, **changes)


def begun(mpc, config=None, seed=3):
    """Return a loop that knows where to go from what is seen at 0."""
    reach = Reach(mpc, config or ReachConfig(10, max_age=5.0, timeout=5.0), seed)
    assert isinstance(reach.step(look(0)), SelectTargets)
    reach.set_targets([GOAL])
    return reach


def act(reach, t):
    answer = reach.step(look(t), float(t))
    assert isinstance(answer, Command)
    reach.sent(now=float(t))
    return answer.plan.action


def test_one_command_a_picture_until_the_budget_is_spent(mpc):
    reach = begun(mpc, ReachConfig(3))
    for t in range(3):
        act(reach, t)
        assert isinstance(reach.step(look(t)), Wait)  # the same picture again
    end = reach.step(look(3))
    assert isinstance(end, End) and end.outcome == 'spent' and reach.steps == 3
    assert reach.distance == pytest.approx(4) and 'budget of 3 is spent' in end.message


@pytest.mark.parametrize('share, tells', [(0.0, True), (0.3, True), (0.9, False)])
def test_a_spent_goal_tells_of_moves_that_the_arm_did_not_make(mpc, monkeypatch, share, tells):
    plan = mpc.plan
    monkeypatch.setattr(mpc, 'plan', lambda *args: replace(
        plan(*args), action=np.array([0.05, -0.03, 0, 0], np.float32)))
    reach, gripper = begun(mpc, ReachConfig(4)), np.array([0, 0, 0.13, 0], np.float32)
    for t in range(4):
        answer = reach.step(look(t, gripper=gripper))
        reach.sent()
        gripper = gripper + np.float32(share) * answer.plan.action
    message = reach.step(look(4, gripper=gripper)).message
    assert ('4 moves through the air went less than half as far as told' in message) == tells
    assert 'budget of 4 is spent' in message


def test_a_goal_that_is_reached_ends_at_once_and_the_default_budget_is_the_papers(mpc):
    reach = begun(mpc, ReachConfig())
    assert reach._budget == 40
    end = reach.step(look(1, GOAL.pixels))
    assert isinstance(end, End) and end.outcome == 'reached' and reach.steps == 0


def test_a_subgoal_counts_from_farther_off_once_the_hand_has_risen_from_a_push(mpc):
    subgoal, stages = Target(START + [1.3, 0.0]), []
    for low in (False, True):
        reach = Reach(mpc, ReachConfig(10))
        for t, height in enumerate((LOW if low else LIFTED, LIFTED)):
            seen = look(t, gripper=np.array([0, 0, height, 0], np.float32))
            if not t:
                assert isinstance(reach.step(seen), SelectTargets)
                reach.set_targets([subgoal, GOAL])
            stages.append(reach.step(seen).stage)
            reach.sent()
    assert stages == [0, 0, 0, 1]


def test_what_is_not_sent_leaves_no_trace(mpc):
    straight, hesitant, found = begun(mpc), begun(mpc), []
    expected = [act(straight, t) for t in range(3)]
    for t in range(3):
        hesitant.step(look(40 + t, stamp_ns=1 + t + t * SECOND))  # planned, and never sent
        found.append(act(hesitant, t))
    np.testing.assert_array_equal(found, expected)


def test_a_refused_command_does_not_count_and_the_newer_picture_is_answered(mpc):
    other = begun(mpc)
    act(other, 0)
    reach = begun(mpc)
    act(reach, 0)
    reach.step(look(4))
    reach.sent(after_ns=10 * SECOND)  # a newer picture had come before
    assert isinstance(reach.step(look(5)), Wait)
    assert not reach.refused(3 * SECOND, 'not this one')
    assert reach.refused(5 * SECOND, 'it answers an old image') and reach.steps == 1
    assert not reach.refused(5 * SECOND, 'told twice')
    waiting = reach.step(look(4))  # the refused picture itself is not answered again
    assert isinstance(waiting, Wait) and 'it answers an old image' in waiting.reason
    np.testing.assert_array_equal(act(reach, 5), act(other, 5))
    assert reach.steps == 2


def test_a_picture_of_before_the_move_is_waited_past_but_not_for_ever(mpc):
    reach = begun(mpc)
    move = reach.step(look(0)).plan.action[:3]
    assert np.linalg.norm(move) > 0
    reach.sent(after_ns=2 * SECOND, late_ns=2 * SECOND)

    def gripper(share):
        return look(0).gripper + np.append(share * move, 0)

    for share in (0.6, -2.0):
        waiting = reach.step(look(2, gripper=gripper(share)))
        assert isinstance(waiting, Wait) and 'not seen yet' in waiting.reason
    assert isinstance(reach.step(look(2, gripper=gripper(0.9))), Command)
    assert isinstance(reach.step(look(3, gripper=gripper(0))), Wait), 'stamped at the limit'
    assert isinstance(reach.step(look(4, gripper=gripper(0))), Command), 'the arm may be blocked'
    assert isinstance(reach.step(look(2, gripper=gripper(0)), now=3.0), Command), 'time runs out'
    assert reach.refused(SECOND, 'it came late')
    assert isinstance(reach.step(look(2, gripper=gripper(0))), Command), 'no move is expected'
    reach.sent(after_ns=2 * SECOND)  # as in lock-step
    assert isinstance(reach.step(look(2, gripper=gripper(0))), Command)


def test_pictures_of_before_the_move_do_not_count_as_unsure(mpc):
    reach = begun(mpc)
    act(reach, 0)
    reach.step(look(1))
    reach.sent(after_ns=2 * SECOND, late_ns=40 * SECOND)
    for t in range(2, 2 + 2 * MOST_UNSURE):
        assert isinstance(reach.step(look(t, states=('seen', 'unsure'))), Wait)


def test_old_and_missing_sights_are_waited_for_and_then_end_the_goal(mpc):
    reach = begun(mpc)
    for seen in (None, look(1, received=-9.0)):
        assert isinstance(reach.step(seen, now=1.0, missing='nothing on the table'), Wait)
    end = reach.step(None, now=5.1, missing='nothing on the table')
    assert isinstance(end, End) and end.outcome == 'aborted'
    assert '5.1 s' in end.message and 'nothing on the table' in end.message


def test_pictures_alone_do_not_keep_a_goal_alive(mpc, monkeypatch):
    plan = mpc.plan
    monkeypatch.setattr(mpc, 'plan', lambda *given: replace(plan(*given), planning_ms=250.0))
    reach = begun(mpc)
    act(reach, 0)
    for t in range(1, 100):  # planned from each, and never sent
        answer = reach.step(look(t), float(t))
        if isinstance(answer, End):
            break
    assert answer.outcome == 'aborted' and 5 + 0.25 * (t - 1) < t < 7 + 0.25 * t


def test_plans_that_come_too_late_end_the_goal_naming_both_times(mpc, monkeypatch):
    plan, limits = mpc.plan, []

    def slow(*given):
        limits.append(given[-1])
        late = len(limits) != 2  # one in time begins the count anew
        return replace(plan(*given), planning_ms=4500.0 if late else 100.0, num_samples=7)

    monkeypatch.setattr(mpc, 'plan', slow)
    reach = begun(mpc)
    for t in range(1, 4 + MOST_LATE):
        answer = reach.step(look(t), t + 1.0)  # what is seen is 1 s old
        if isinstance(answer, End):
            break
    assert answer.outcome == 'aborted' and t == 2 + MOST_LATE and limits == [3.5] * t
    assert all(word in answer.message for word in ('4.50 s', '1.00 s', '7 samples', 'is 5 s'))
    reach = begun(mpc)
    for t in range(1, 4 + MOST_LATE):  # what does not age may be planned from for ever
        assert isinstance(reach.step(look(t, received=np.inf), t + 1.0), Command)
    assert limits[-1] == np.inf


def test_an_arm_that_refuses_all_ends_the_goal_and_one_that_carries_out_some_does_not(mpc):
    for carries_out, ends in ((lambda t: False, True), (lambda t: t % MOST_REFUSED == 0, False)):
        reach = begun(mpc, ReachConfig(20))
        for t in range(3 * MOST_REFUSED):
            answer = reach.step(look(t), 0.1 * t)
            if isinstance(answer, End):
                break
            reach.sent(now=0.1 * t)
            if not carries_out(t):
                reach.refused((t + 1) * SECOND, 'protective stop')
        assert isinstance(answer, End) == ends
        if ends:
            assert (t, answer.outcome, reach.steps) == (MOST_REFUSED, 'aborted', 0)
            assert 'protective stop' in answer.message


def test_pictures_of_an_old_scene_are_not_used(mpc):
    reach = Reach(mpc, ReachConfig(10))
    answer = reach.step(look(0, scene_ns=2 * SECOND))
    assert isinstance(answer, Wait) and 'old scene' in answer.reason
    assert isinstance(reach.step(look(1, scene_ns=2 * SECOND)), SelectTargets)


@pytest.mark.parametrize('changes, words', [
    ({'scene_ns': 3 * SECOND}, 'a new episode'), ({'jumps': 1}, 'clock'),
    ({'names': ('a', 'c\n')}, 'c\\n appeared; b vanished')])
def test_another_scene_ends_the_goal_even_if_nothing_else_is_new(mpc, changes, words):
    reach = begun(mpc)
    act(reach, 0)
    end = reach.step(look(0, **changes))
    assert isinstance(end, End) and end.outcome == 'aborted' and words in end.message
    assert isinstance(reach.step(look(1)), Command)


@pytest.mark.parametrize('states, steps, word', [
    (['hidden'] * 6, 6, ''), (['unsure', 'unsure', 'seen'] * 3, 9, ''),
    (['seen', *['unsure'] * 10], 10, 'b is unsure'), (['seen', 'lost'], 1, 'b lost')])
def test_hidden_objects_stay_where_they_were_and_those_in_doubt_move_nothing_and_end_the_goal(
        mpc, states, steps, word):
    reach, usual = begun(mpc), begun(mpc)
    for t, state in enumerate(states):
        for _ in range(4):  # the same picture again is no other one
            answer = reach.step(look(t, states=('seen', state)))
        if isinstance(answer, End):
            break
        reach.sent()
        x, y, up, opening = answer.plan.action
        if state == 'unsure':  # straight up, as high as it travels
            assert (x, y, opening) == (0, 0, 0) and up == pytest.approx(LIFTED - 0.1)
            usual = None
        elif usual is not None:
            np.testing.assert_array_equal(answer.plan.action, act(usual, t))
    assert reach.steps == steps and isinstance(answer, End) == bool(word)
    assert not word or (answer.outcome, word in answer.message) == ('aborted', True)


def test_what_is_unsure_is_not_there_and_begins_no_goal(mpc):
    reach = begun(mpc)
    there = GOAL.pixels
    assert isinstance(reach.step(look(0, there, states=('seen', 'unsure'))), Command)
    reach.sent()
    assert reach.step(look(1, there)).outcome == 'reached'
    assert isinstance(Reach(mpc, ReachConfig(10)).step(look(0, states=('unsure', 'seen'))), Wait)


def test_what_is_hidden_at_its_goal_is_looked_at_from_above_before_the_end(mpc):
    low, lifted = (np.array([0, 0, z, 0], np.float32) for z in (LOW, LIFTED))
    guessed = {'pixels': GOAL.pixels, 'states': ('seen', 'hidden')}
    for after, outcome, words in (({'pixels': GOAL.pixels}, 'reached', 'reached'), (
            guessed, 'reached', 'reached; the place of b, hidden, is a guess'), ({}, None, None)):
        reach = begun(mpc)
        answer = reach.step(look(0, gripper=low, **guessed))
        np.testing.assert_allclose(answer.plan.action, [0, 0, LIFTED - LOW, 0], atol=1e-6)
        reach.sent()
        end = reach.step(look(1, gripper=lifted, **after))
        assert (getattr(end, 'outcome', None), getattr(end, 'message', None)) == (outcome, words)


def test_each_command_is_planned_from_what_the_one_before_left(mpc):
    reach, goal, memory = begun(mpc, seed=5), mpc.goal(GOAL.pixels), Memory(5)
    for t in range(3):
        seen = look(t)
        plan = mpc.plan(Scene(seen.image, seen.gripper, seen.pixels), goal, memory)
        memory = plan.memory
        np.testing.assert_array_equal(reach.step(seen).plan.actions, plan.actions)
        reach.sent()


def test_rounds_ask_again_when_the_subgoals_are_passed(mpc):
    first, second = Target(START + 2), Target(START + 4)
    reach = Reach(mpc, ReachConfig(10, rounds=2), 3)
    reach.step(look(0))
    reach.set_targets([first, GOAL])
    act(reach, 0)
    aim = reach.step(look(1, first.pixels))
    assert isinstance(aim, SelectTargets) and aim.seen.pixels is first.pixels and reach.steps == 1
    assert isinstance(reach.step(look(1, first.pixels)), SelectTargets)  # until it is told
    reach.set_targets([second, GOAL])
    for t, pixels, stage in ((1, first.pixels, 1), (2, second.pixels, 2), (3, START, 2)):
        command = reach.step(look(t, pixels))
        assert isinstance(command, Command) and command.stage == stage  # no third round
        reach.sent()
    assert reach.targets == [first, second, GOAL] and reach.switches == [1, 2]


@pytest.mark.parametrize('passed', [0.0, 3.0])
def test_a_subgoal_may_be_passed_farther_off_than_the_goal_is_reached(mpc, passed):
    reach = Reach(mpc, ReachConfig(10, reached=1.0, passed=passed), 3)
    reach.step(look(0))
    reach.set_targets([Target(START + 4), GOAL])
    for pixels, stage in ((START, 0), (START + 2, int(passed > 0)), (START + 4, 1), (
            GOAL.pixels + 2, 1)):
        command = reach.step(look(reach.steps, pixels))
        assert isinstance(command, Command) and command.stage == stage
        reach.sent()
    assert isinstance(reach.step(look(4, GOAL.pixels)), End)


def test_a_later_round_knows_where_the_gripper_met_something(mpc, monkeypatch):
    plan, known = mpc.plan, []

    def plan_down(scene, goal, memory, limits, seconds):
        known.append(memory.blocked)
        made = plan(scene, goal, memory, limits, seconds)
        return replace(made, memory=replace(made.memory, heights=(0.13, 0.012)))

    monkeypatch.setattr(mpc, 'plan', plan_down)
    reach = Reach(mpc, ReachConfig(10, rounds=9), 3)
    for t in range(3):  # a round each; each time it stands at 0.1 m
        assert isinstance(reach.step(look(t)), SelectTargets)
        reach.set_targets([Target(START), GOAL])
        act(reach, t)
    assert [len(blocked) for blocked in known] == [0, 0, 1]
