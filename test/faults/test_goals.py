# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Goals while inputs fall silent, scenes change, an arm refuses, nodes die."""

from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from dataclasses import dataclass
import signal
import subprocess
import sys
import threading
import time
from typing import Any

from driven import first_pictures, goal_fields, MOVING_S, STOP_S, TOPICS
from fault_report import fault
import numpy as np
from processes import NodeProcess, until
import pytest
from tap_msgs.action import ReachGoal
from tap_ros.base.errors import TapError
from tap_ros.ros.reaching import Reaching

pytestmark = pytest.mark.ros

END_S = 8.0
DISCOVERED_S = 0.5  # that a new publisher takes to be heard
NOTICED_S = 4.0  # of a death
PAUSED_S = 2.5  # less than the lease of its process: nobody has forgotten it
LONG_S = 6.0  # more than it
BUDGET = 3  # commands of a goal that is to be spent
GOAL_OF_ANOTHER = """
import tap_ros
client = tap_ros.Client()
client.reach(mode='direct', step_budget=1000).result()
"""
REFUSED = 10  # commands in a row, at most
AGES_S = (0.5, 1.0, 2.0, 3.0, 5.0, 10.0, 20.0, 60.0)
CHANGED = 'the scene has changed'
ABORTED = f'aborted with the reason; no move after {STOP_S:g} s'
STILL = 'aborted without a move'


@dataclass(frozen=True)
class Injection:
    """
    What is done to a World that shows the same moment again and again, and what the goal does.

    :param do: called with World, trial; returns when it was done; None: now.
    :param during: whether the arm moves by then; else the goal begins after it.
    :param end: how the goal has to end, '' if it need not.
    :param within: what the reason has to say.
    :param budget: most commands of the goal.
    """

    do: Any
    during: bool = True
    end: str = 'aborted: '
    within: str = CHANGED
    budget: int = 1000


def silence(topic):
    """Let a topic fall silent somewhere between two messages."""
    def do(world, trial):
        time.sleep(0.07 * (trial % 6))
        return world.silence(topic)
    return Injection(do, end='')


def die(world, trial):
    """Let the camera, or all inputs, be silent for a while."""
    moment = world.silence(*(('image',), TOPICS)[trial % 2])
    time.sleep(max(0.0, moment + AGES_S[trial % len(AGES_S)] - time.monotonic()))


def repeat_stamps(world, trial):
    """Let all inputs repeat one stamp from before the goal on."""
    world.frozen = dict.fromkeys(TOPICS, time.time_ns())
    time.sleep((0.5, 3.0)[trial % 2])
    return world.renewed()


def jump(*seconds):
    """Let all clocks jump."""
    def do(world, trial):
        world.shift_s = seconds[trial % len(seconds)]
        return world.renewed()
    return do


def change_objects(world, trial):
    """Let an object vanish or appear."""
    seen = first_pictures()[0]
    world.objects = (seen.object_pixels[:1], seen.object_names[:1]) if trial % 2 else (
        np.concatenate([seen.object_pixels, [[5.0, 5.0]]]), (*seen.object_names, 'newcomer'))
    return world.renewed()


OLD = 'a goal 0.5 to 60 s after the camera died, or while all inputs repeat one stamp'
OTHER = 'the clock jumps, or objects appear or vanish'
STRANGE = 'all clocks jump 9 s ahead, or one picture comes under ever new stamps'
SPENT = (f'a goal of {BUDGET} commands ends after {BUDGET} at most', 10, 'moves sent')
# Name, what is injected, what must happen, trials of a whole run, what is measured, how.
TABLE = [
    *((f'silent-{topic}', 'camera, objects or joint states fall silent',
       f'zero within {STOP_S:g} s of the last message, no move after it', 20,
       's until the stop', silence(topic)) for topic in TOPICS),
    ('camera-dead', OLD, STILL, 8, 'moves sent', Injection(die, during=False, within='')),
    ('stamps-repeated', OLD, STILL, 10, 'moves sent',
     Injection(repeat_stamps, during=False, within='')),
    ('scene-clock', OTHER, ABORTED, 8, 's until the goal ended',
     Injection(jump(3600.0, -3600.0, 10.0, -10.0))),
    ('scene-objects', OTHER, ABORTED, 8, 's until the goal ended', Injection(change_objects)),
    ('clocks-ahead', STRANGE, *SPENT, Injection(jump(9.0), end='', budget=BUDGET)),
    ('same-picture', STRANGE, *SPENT, Injection(lambda world, trial: None, end='', budget=BUDGET))]


@pytest.mark.parametrize('injection', [
    pytest.param(row[-1], id=row[0], marks=fault(*row[1:-1])) for row in TABLE])
def test_(rig, trials, injection):
    rig.need('visual_mpc_node')
    with rig.world() as world:
        for trial in trials:
            world.restore()
            time.sleep(0.5)
            rig.need('visual_mpc_node')
            begin = time.monotonic()
            fields = goal_fields(step_budget=injection.budget)
            with trials.one():
                if injection.during:
                    handle = rig.begin_moving(**fields)
                moment = injection.do(world, trial) or time.monotonic()
                if not injection.during:
                    begin = moment
                    handle = rig.begin(**fields)
                if injection.budget < 1000:
                    rig.expect_end(handle, '', timeout_s=60.0)
                elif injection.end:
                    rig.expect_end(handle, injection.end, injection.within, END_S)
                else:
                    time.sleep(max(0.0, moment + 1.2 - time.monotonic()))
                moves = len(rig.arm.moves(begin))
                trials.measured({
                    'moves sent': moves, 's until the stop': rig.arm.seconds_to_stop(moment)
                }.get(trials.mark['figure'], time.monotonic() - moment))
                if injection.budget < 1000:
                    assert moves <= injection.budget, f'{moves} moves'
                elif not injection.during:
                    assert not moves, f'{moves} moves'
                elif injection.end:
                    rig.arm.assert_still(moment + STOP_S * trials.patience)
                else:
                    rig.arm.assert_stopped(moment, STOP_S * trials.patience)
                rig.check()


@fault('the arm refuses every command', f'aborted after at most {REFUSED} commands with the '
       'reason; zero last; the next goal succeeds', 8, 'moves sent')
def test_arm_refuses(rig, trials):
    rig.need('visual_mpc_node')
    with rig.world():
        for _ in trials:
            rig.need('visual_mpc_node')
            rig.arm.refusing, begin = True, time.monotonic()
            with trials.one():
                rig.expect_end(rig.begin(), 'aborted: ', 'protective stop', 90.0)
                ended, moves = time.monotonic(), len(rig.arm.moves(begin))
                trials.measured(moves)
                assert moves <= REFUSED, f'{moves} moves'
                time.sleep(1.0)
                rig.arm.assert_still(ended)
                assert rig.arm.seconds_to_stop(begin) < float('inf'), 'no zero was sent'
                rig.arm.refusing = False
                rig.expect_end(rig.begin(**goal_fields(step_budget=1)), 'succeeded')


@fault('messages from the future once a second', 'the goal of four steps succeeds', 8,
       's for the goal')
def test_future_stamps(rig, trials):
    rig.need('visual_mpc_node')
    choices = [[topic] for topic in TOPICS] + [list(TOPICS)]
    with rig.world() as world, ThreadPoolExecutor(1) as pool:
        for trial in trials:
            begin, ended = time.monotonic(), []

            def publish(topics, ended):
                while not ended:
                    time.sleep(1.0)
                    messages = world.messages(time.time_ns() + 10**15)
                    world.publish({topic: messages[topic] for topic in topics})

            pool.submit(publish, choices[trial % len(choices)], ended)
            with trials.one():
                rig.expect_end(rig.begin(**goal_fields(step_budget=4)), 'succeeded')
                trials.measured(time.monotonic() - begin)
            ended.append(True)


@pytest.mark.parametrize('other', [
    pytest.param(False, id='reset', marks=fault(
        'the scene is reset', ABORTED, 20, 's until the goal ended')),
    pytest.param(True, id='other-simulator', marks=fault(
        'a second simulator becomes ready', 'aborted with the reason; no move after '
        f'{STOP_S + DISCOVERED_S:g} s', 10, 's until the goal ended'))])
def test_scene(rig, trials, other):
    for trial in trials:
        rig.need('visual_mpc_node', sim='real')
        with trials.one(), ExitStack() as stack:
            rig.reset(2 * trial)
            # A goal that brings its own picture, or one whose picture comes by topic.
            handle = rig.begin_moving(**(goal_fields() if trial % 2 else {
                'mode': 'direct', 'step_budget': 1000}))
            if other:
                process = NodeProcess('sim_node', rig.folder / 'other_sim.log',
                                      {'seed': 99, 'image_size': 64}, ['-r __node:=other_sim'])
                stack.callback(process.end)
                process.wait_for('ready')
            else:
                rig.reset(2 * trial + 1)
            moment = time.monotonic()
            rig.expect_end(handle, 'aborted: ', CHANGED, END_S)
            trials.measured(time.monotonic() - moment)
            rig.arm.assert_still(moment + STOP_S * trials.patience + DISCOVERED_S * other)


# Nodes that are killed or stand still


def expect_notice(trials, presence, moment):
    """Raise AssertionError unless a death is noticed in time."""
    while not presence.gone and time.monotonic() - moment < 2 * NOTICED_S:
        time.sleep(0.005)
    assert presence.gone, 'it is still in the ROS graph'
    seconds = time.monotonic() - moment
    trials.measured(seconds)
    assert seconds < NOTICED_S * trials.patience, f'its death was noticed after {seconds:.1f} s'


def expect_goal(rig, timeout_s=30.0):
    """Raise AssertionError unless a goal of one step succeeds; return the seconds."""
    begin = time.monotonic()
    rig.expect_end(rig.begin(mode='direct', step_budget=1), 'succeeded', timeout_s=timeout_s)
    return time.monotonic() - begin


@fault('the predictor is killed during a call', f'noticed within {NOTICED_S:g} s; no move; the '
       'goal is aborted; after a restart the next call and goal succeed', 25,
       's until noticed')
def test_predictor_killed(rig, trials):
    random = np.random.default_rng(0)
    rig.need('visual_mpc_node', 'predictor_node')
    limit = NOTICED_S * trials.patience
    with rig.world():
        for _ in trials:
            rig.need('visual_mpc_node', 'predictor_node')
            victim, watch = rig.processes['predictor_node'], rig.presence('predictor_node')
            with trials.one():
                moment = time.monotonic()  # from here on it is as good as dead
                victim.send(signal.SIGSTOP)  # so that it dies during the call
                handle = rig.begin(**goal_fields('subgoal'))
                time.sleep(random.uniform(0.1, 0.3))
                victim.kill()
                expect_notice(trials, watch, moment)
                rig.expect_end(handle, 'aborted', 'predict')
                took = time.monotonic() - moment
                assert took < limit, f'the goal was told after {took:.1f} s'
                rig.arm.assert_stopped(moment, STOP_S * trials.patience)
                rig.arm.assert_still(moment)
                with pytest.raises(TapError, match='start predictor_node'):
                    rig.expect_prediction(0.5)
                rig.restart('predictor_node')
                rig.expect_prediction(5.0)
                rig.begin_moving(**goal_fields('subgoal'))


@fault(f'the predictor stands still for {PAUSED_S:g} s during a call', 'the call is answered', 20,
       's for the call')
def test_predictor_paused(rig, trials):
    for _ in trials:
        rig.need('predictor_node')
        victim = rig.processes['predictor_node']
        with trials.one():
            begin = time.monotonic()
            victim.send(signal.SIGSTOP)
            timer = threading.Timer(PAUSED_S, victim.send, [signal.SIGCONT])
            timer.start()
            try:
                rig.expect_prediction(20.0)
                trials.measured(time.monotonic() - begin)
            finally:
                timer.join()


def kill_during_goal(rig, trials, victim, expect):
    """
    Kill a node while the arm moves in real time, see it noticed, and a goal succeed after it.

    :param expect: called with handle, the moment of the death and the victim's Presence; raises
        AssertionError for what does not happen.
    """
    for trial in trials:
        with trials.one():
            rig.need('visual_mpc_node', sim='real')
            rig.reset(trial % 10)
            rig.arm.forget()
            handle = rig.begin_moving(mode='direct', step_budget=1000)
            presence = rig.presence(victim)
            expect(handle, rig.processes[victim].kill(), presence)
            rig.restart(victim)
            rig.reset(trial % 10)
            expect_goal(rig, 20.0)


@fault('the planner is killed', f'its client is told within {NOTICED_S:g} s; the arm stands '
       'still; the next goal succeeds', 15, 's until noticed')
def test_planner_killed(rig, trials):
    def expect(handle, moment, presence):
        with pytest.raises(TapError):
            rig.result(handle)
        took = time.monotonic() - moment
        assert took < NOTICED_S * trials.patience, f'its client was told after {took:.1f} s'
        expect_notice(trials, presence, moment)
        time.sleep(max(0.0, moment + 1.0 - time.monotonic()))
        before = np.array(rig.joints.wait(5.0).position[:3])
        time.sleep(1.0)
        drift = float(np.abs(np.array(rig.joints.wait(5.0).position[:3]) - before).max())
        assert drift < 2e-3, f'the arm still moved {1000 * drift:.0f} mm'

    kill_during_goal(rig, trials, 'visual_mpc_node', expect)


@fault('the simulator is killed', f'noticed within {NOTICED_S:g} s; stop within '
       '0.5 s; aborted; the next reset and goal succeed', 15, 's until noticed')
def test_simulator_killed(rig, trials):
    def expect(handle, moment, presence):
        expect_notice(trials, presence, moment)
        rig.arm.assert_stopped(moment, STOP_S * trials.patience)
        rig.expect_end(handle, 'aborted')

    kill_during_goal(rig, trials, 'sim_node', expect)


@fault(f'the planner stands still for {PAUSED_S:g} s', 'aborted with that reason; '
       'nothing moves before the next goal', 10)
def test_planner_paused(rig, trials):
    rig.need('visual_mpc_node')
    with rig.world():
        for _ in trials:
            rig.need('visual_mpc_node')
            victim = rig.processes['visual_mpc_node']
            with trials.one():
                handle = rig.begin_moving()
                victim.send(signal.SIGSTOP)
                time.sleep(PAUSED_S)
                moment = time.monotonic()
                victim.send(signal.SIGCONT)
                rig.expect_end(handle, 'aborted', 'stood still')
                victim.wait_for('stood still', 20.0)
                time.sleep(2.0)  # it is found again, and would move by now
                rig.arm.assert_still(moment)


@fault(f'the planner stands still for 1.5 or {LONG_S:g} s while a goal is sent, and the client '
       'gives up', 'nothing moves; the next goal succeeds', 20)
def test_goal_given_up(rig, trials):
    for trial in trials:
        rig.need('visual_mpc_node', sim='lock-step')
        victim = rig.processes['visual_mpc_node']
        with trials.one():
            rig.reset(trial)
            moment = time.monotonic()
            victim.send(signal.SIGSTOP)
            try:
                with pytest.raises(TapError, match='silent|left the ROS graph'):
                    Reaching(rig.client.goals, ReachGoal.Goal(mode='direct'), 90.0, 1.2)
                time.sleep(max(0.0, moment + (1.5, LONG_S)[trial % 2] - time.monotonic()))
            finally:
                victim.send(signal.SIGCONT)
            time.sleep(5.0)
            rig.arm.assert_still(moment)
            expect_goal(rig)


@fault('the client is killed', f'nothing moves after {NOTICED_S:g} s; aborted; the next goal '
       'succeeds', 20, 's until the goal ended')
def test_client_killed(rig, trials):
    def deserted():
        return rig.processes['visual_mpc_node'].text.count('the client that sent')

    for trial in trials:
        rig.need('visual_mpc_node', sim='real')
        with trials.one():
            rig.reset(trial)
            rig.arm.forget()
            count = deserted()
            client = subprocess.Popen([sys.executable, '-c', GOAL_OF_ANOTHER])
            try:
                assert until(lambda: len(rig.arm.moves(0.0)) > 1, MOVING_S), 'nothing moved'
            finally:
                client.kill()
                client.wait()
            moment = time.monotonic()
            assert until(lambda count=count: deserted() > count, 20.0)
            trials.measured(time.monotonic() - moment)
            rig.arm.assert_still(moment + NOTICED_S * trials.patience)
            expect_goal(rig)


@pytest.mark.parametrize('cancel', [
    pytest.param(cancel, id=f'after-{what}', marks=fault(
        'a goal of one step right after a cancel or a reset, in lock-step', 'it succeeds', 100,
        's for the goal')) for cancel, what in ((True, 'cancel'), (False, 'reset'))])
def test_goals(rig, trials, cancel):
    random = np.random.default_rng(0)
    rig.need('visual_mpc_node', sim='lock-step')
    rig.reset(0)
    for trial in trials:
        with trials.one():
            if cancel:
                handle = rig.begin(mode='direct', step_budget=200)
                assert next(iter(handle), None), 'the first goal did not move'
                time.sleep(random.uniform(0, 0.3))
                rig.finish(handle)
            else:
                rig.reset(trial % 20)
            trials.measured(expect_goal(rig))
