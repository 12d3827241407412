# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Nodes that are killed while others depend on them, and started again."""

from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
import signal
import time

from fault_files import describe_exit
from fault_report import fault
from fault_rig import Attacked, STOP_S
from fault_world import goal_fields
import numpy as np
import pytest
from tap_ros.errors import TapError

pytestmark = pytest.mark.ros

NOTICED_S = 1.0
PAUSED_S = 2.5  # less than the lease of its process: nobody has forgotten it
END_S = 10.0
SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
NODES = ('sim_node', 'predictor_node', 'visual_mpc_node', 'recorder_node')


def expect_notice(trials, watch, moment):
    """Raise AssertionError unless a death is noticed in time; take the seconds down."""
    while not watch.dead and time.monotonic() - moment < 3.0:
        time.sleep(0.005)
    assert watch.dead, 'its heartbeat told nobody that it had died'
    seconds = time.monotonic() - moment
    trials.measured(seconds)
    assert seconds < NOTICED_S * trials.patience, f'its death was noticed after {seconds:.1f} s'
    return seconds


def expect_first_goal(rig):
    """Raise AssertionError unless the first goal after a restart succeeds."""
    rig.expect_end(rig.begin(mode='direct', step_budget=1), 'succeeded', timeout_s=20.0)


@fault('the predictor is killed during a call', 'noticed within 1 s; no move; goal and calls '
       'fail within 1 s; the next call and goal after the restart succeed', 100,
       's until noticed')
def test_predictor_killed(rig, trials):
    random = np.random.default_rng(0)
    rig.need('visual_mpc_node', 'predictor_node')
    limit = NOTICED_S * trials.patience
    with rig.world():
        for _ in trials:
            rig.need('visual_mpc_node', 'predictor_node')
            victim, watch = rig.processes['predictor_node'], rig.alive['predictor_node']
            with trials.one():
                moment = time.monotonic()  # from here on it is as good as dead
                victim.send(signal.SIGSTOP)  # so that it dies during the call
                handle = rig.begin(**goal_fields('subgoal'))
                time.sleep(random.uniform(0.1, 0.3))
                victim.kill()
                seconds = expect_notice(trials, watch, moment)
                rig.expect_end(handle, 'aborted', 'predict')
                took = time.monotonic() - moment
                assert took < max(limit, seconds + 0.1), f'the goal was told after {took:.1f} s'
                rig.commands.assert_stopped(moment, STOP_S * trials.patience)
                assert not rig.commands.moves(moment), 'the arm was moved'
                begin = time.monotonic()
                with pytest.raises(TapError, match='predictor_node, has ended'):
                    rig.expect_prediction(5.0)
                assert time.monotonic() - begin < limit, 'a call while it was dead took long'
                rig.restart('predictor_node')
                rig.expect_prediction(5.0)
                rig.begin_moving(1, **goal_fields('subgoal'))


def moving_goal(rig, trial):
    """Begin a goal by which the arm moves, in real time; return its handle."""
    rig.need('visual_mpc_node', sim='real')
    rig.reset(trial % 10)
    rig.commands.forget()
    return rig.begin_moving(mode='direct', step_budget=1000)


@fault('the planner is killed during a goal', 'noticed and its client told within 1 s; the arm '
       'stands still; the next goal succeeds', 50, 's until noticed')
def test_planner_killed(rig, trials):
    for trial in trials:
        with trials.one():
            handle = moving_goal(rig, trial)
            victim, watch = rig.processes['visual_mpc_node'], rig.alive['visual_mpc_node']
            moment = victim.kill()
            with pytest.raises(TapError):
                rig.result(handle)
            took = time.monotonic() - moment
            assert took < NOTICED_S * trials.patience, f'its client was told after {took:.1f} s'
            expect_notice(trials, watch, moment)
            time.sleep(max(0.0, moment + 1.0 - time.monotonic()))
            before = np.array(rig.joints.wait(5.0).position[:3])
            time.sleep(1.0)
            drift = float(np.abs(np.array(rig.joints.wait(5.0).position[:3]) - before).max())
            assert drift < 2e-3, f'the arm still moved {1000 * drift:.0f} mm'
            rig.restart('visual_mpc_node')
            expect_first_goal(rig)


@fault('the simulator is killed during a goal', 'noticed within 1 s; stop within 0.5 s; aborted; '
       'the next reset and goal succeed', 50, 's until noticed')
def test_simulator_killed(rig, trials):
    for trial in trials:
        with trials.one():
            handle = moving_goal(rig, trial)
            victim, watch = rig.processes['sim_node'], rig.alive['sim_node']
            moment = victim.kill()
            expect_notice(trials, watch, moment)
            time.sleep(max(0.0, moment + 1.0 - time.monotonic()))
            rig.commands.assert_stopped(moment, STOP_S * trials.patience)
            rig.expect_end(handle, 'aborted')
            rig.restart('sim_node')
            rig.reset(trial % 10)
            expect_first_goal(rig)


@fault(f'the planner stands still for {PAUSED_S:g} s during a goal', 'aborted with that reason; '
       'nothing moves before the next goal', 20)
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
                with suppress(TapError):  # to its client it may have looked dead
                    rig.result(handle)
                victim.wait_for('stood still', 20.0)
                time.sleep(2.0)  # it is found again, and would move by now
                moves = rig.commands.moves(moment)
                assert not moves, f'{len(moves)} moves after it went on'


@pytest.mark.parametrize('name', NODES)
@fault('a node is started and ended at any moment', f'ends within {END_S:g} s, exit code 0 (or '
       'by the signal, while Python imports), no traceback', 200,
       's until it had ended')
def test_start_stop(trials, tmp_path, name):
    random = np.random.default_rng(0)

    def node(number):
        parameters = ({'folder': tmp_path / f'bag{number}'} if name == 'recorder_node' else {})
        return Attacked(name, tmp_path / f'{number}.log', parameters).start()

    def once(trial, early_s, late_s):
        """Start and end a node; return it, the signal, and the seconds and code of its end."""
        attacked = node(trial)
        if trial % 2:
            time.sleep(early_s)
        else:
            attacked.wait_for('ready')
            time.sleep(late_s)
        began = '[INFO]' in attacked.text
        number = SIGNALS[trial // 2 % len(SIGNALS)]
        asked = time.monotonic()
        code = attacked.end(number, END_S)
        return attacked, began, number, time.monotonic() - asked, code

    with ThreadPoolExecutor(2) as pool:
        begin = time.monotonic()
        for first in list(pool.map(node, ('usual0', 'usual1'))):
            first.wait_for('ready').kill()
        usual_s = time.monotonic() - begin
        early = 0
        for attacked, began, number, seconds, code in pool.map(
                once, *zip(*[(trial, random.uniform(0, 1.2 * usual_s), random.uniform(0, 0.5))
                             for trial in trials])):
            trials.measured(seconds)
            text = attacked.text
            if not began and ', in run_node' not in text and (
                    code == -number or 'KeyboardInterrupt' in text):
                early += 1  # before Python has run the first line of the node
                trials.record()
                continue
            with trials.one():
                assert code is not None, f'did not end within {END_S:g} s of {number.name}'
                assert 'Traceback' not in text, f'a traceback after {number.name}'
                assert code == 0, (
                    f'{describe_exit(code)} after {number.name}: {attacked.last_line()}')
    trials.note = f'{early} by the signal'
