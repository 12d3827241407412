# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Nodes that are killed while others depend on them, and started again."""

import signal
import time

from experiments.faults.fault import Fault
from experiments.faults.nodes.rig import outcome
from experiments.faults.nodes.silence import judge_stop
from experiments.faults.nodes.world import goal_fields, predict_fields
import numpy as np

NOTICED_S = 1.0
PAUSED_S = 2.5  # less than the lease of its process: nobody has forgotten it


def judge_notice(job, watch, moment):
    """Say what is wrong with how a death was noticed; and the seconds it took."""
    while not watch.dead and time.monotonic() - moment < 3.0:
        time.sleep(0.005)
    seconds = time.monotonic() - moment if watch.dead else float('inf')
    if seconds == float('inf'):
        return 'its heartbeat told nobody that it had died', seconds
    late = seconds > NOTICED_S * job.patience
    return f'its death was noticed after {seconds:.1f} s' if late else '', seconds


def restart(victim, watch):
    """Start a node again, and wait until it is ready and its heartbeat is heard."""
    victim.start().wait_until_ready()
    watch.wait_until_alive(5.0)


def joined(*reasons):
    """Return the reasons that are not empty, in one line."""
    return ' + '.join(reason for reason in reasons if reason)


def predictor(job):
    """Kill the predictor while the planner waits for its answer; then start it again."""
    rig = job.rig
    rig.need('visual_mpc_node', 'predictor_node')
    victim, watch = rig.processes['predictor_node'], rig.alive['predictor_node']
    with rig.world():
        for _ in job.trials():
            rig.commands.forget()
            moment = time.monotonic()  # from here on it is as good as dead
            victim.send(signal.SIGSTOP)  # so that it dies during the call
            handle = rig.begin(**goal_fields('subgoal'))
            time.sleep(job.random.uniform(0.1, 0.3))
            victim.kill()
            noticed, seconds = judge_notice(job, watch, moment)
            end, lost = outcome(rig.result, handle, 30.0)
            took = time.monotonic() - moment
            stopped, _ = judge_stop(job, moment)
            if rig.commands.moves(moment):
                stopped = 'the arm was moved'
            begin = time.monotonic()
            _, refused = outcome(rig.predict, 5.0, **predict_fields())
            late = time.monotonic() - begin > NOTICED_S * job.patience
            silent = (f'a call while it was dead: {refused or "was answered"}'
                      if late or 'predictor_node, has ended' not in refused else '')
            told = '' if end is None or (
                end.startswith('aborted') and 'predict' in end) else f'the goal {end}'
            if not lost and not told and took > max(NOTICED_S * job.patience, seconds):
                told = f'the goal was told after {took:.1f} s'
            restart(victim, watch)
            begin = time.monotonic()
            response, unanswered = outcome(rig.predict, 5.0, **predict_fields())
            if response is not None and not response.success:
                unanswered = f'the first call was refused: {response.message}'
            if unanswered:
                unanswered = f'first call after {time.monotonic() - begin:.1f} s: {unanswered}'
            begin = time.monotonic()
            handle, again = outcome(rig.begin, **goal_fields('subgoal'))
            if handle is not None:
                again = '' if rig.commands.wait_for_moves(begin, 1, 20.0) else 'nothing moved'
                ended, _ = outcome(rig.finish, handle)
                again = again and f'first goal via a subgoal: {again}; it {ended}'
            why = joined(noticed, lost, told, stopped, silent, unanswered, again)
            if unanswered or again:
                rig.need('visual_mpc_node', 'predictor_node')
            job.record(not why, why, None if noticed and seconds == float('inf') else seconds)


def _moving_goals(job):
    """Yield each trial with a goal by which the arm moves, in real time."""
    rig = job.rig
    for trial in job.trials():
        rig.reset(trial % 10)
        rig.commands.forget()
        begin = time.monotonic()
        handle, why = outcome(rig.begin, mode='direct', step_budget=1000)
        if handle is not None and rig.commands.wait_for_moves(begin, 2, 20.0):
            yield trial, handle
        else:
            job.record(False, why or 'the goal before the kill did not move')
            rig.need('visual_mpc_node', sim='real')


def _first_goal(rig):
    """Send the first goal after a restart; say what was wrong with its end."""
    handle, why = outcome(rig.begin, 10.0, mode='direct', step_budget=1)
    if handle is not None:
        end, why = outcome(rig.result, handle, 20.0)
        if end is not None and not end.startswith('succeeded'):
            why = f'it {end}'
    return why and f'first goal after the restart: {why}'


def planner(job):
    """Kill the planner while it moves an arm in real time; then start it again."""
    rig = job.rig
    rig.need('visual_mpc_node', sim='real')
    victim, watch = rig.processes['visual_mpc_node'], rig.alive['visual_mpc_node']
    for _, handle in _moving_goals(job):
        moment = victim.kill()
        _, told = outcome(rig.result, handle, 4.0)
        took = time.monotonic() - moment
        late = took > NOTICED_S * job.patience
        told = f'its client was told after {took:.1f} s: {told}' if late else ''
        noticed, seconds = judge_notice(job, watch, moment)
        time.sleep(max(0.0, moment + 1.0 - time.monotonic()))
        before = np.array(rig.joints.wait(5.0).position[:3])
        time.sleep(1.0)
        drift = float(np.abs(np.array(rig.joints.wait(5.0).position[:3]) - before).max())
        moved = f'the arm still moved {1000 * drift:.0f} mm' if drift > 2e-3 else ''
        restart(victim, watch)
        lost = _first_goal(rig)
        why = joined(noticed, moved, told, lost)
        job.record(not why, why, None if seconds == float('inf') else seconds)


def simulator(job):
    """Kill the simulator, which is camera and arm, during a goal; then start it again."""
    rig = job.rig
    rig.need('visual_mpc_node', sim='real')
    victim, watch = rig.processes['sim_node'], rig.alive['sim_node']
    for trial, handle in _moving_goals(job):
        moment = victim.kill()
        noticed, seconds = judge_notice(job, watch, moment)
        time.sleep(max(0.0, moment + 1.0 - time.monotonic()))
        stopped, _ = judge_stop(job, moment)
        end, lost = outcome(rig.result, handle, 30.0)
        told = f'the goal {end}' if end is not None and not end.startswith('aborted') else ''
        restart(victim, watch)
        answer, unanswered = outcome(rig.reset, trial % 10)
        again = _first_goal(rig)
        why = joined(noticed, stopped, lost, told, unanswered, again)
        job.record(not why, why, None if seconds == float('inf') else seconds)


def paused(job):
    """Stop the planner for some seconds while it moves an arm, and let it go on."""
    rig = job.rig
    rig.need('visual_mpc_node')
    victim = rig.processes['visual_mpc_node']
    with rig.world():
        for _ in job.trials():
            handle = rig.begin_moving()
            victim.send(signal.SIGSTOP)
            time.sleep(PAUSED_S)
            moment = time.monotonic()
            victim.send(signal.SIGCONT)
            end, lost = outcome(rig.result, handle, 20.0)
            if end is not None and not (end.startswith('aborted') and 'stood still' in end):
                lost = f'the goal {end}'
            time.sleep(2.0)  # it is found again, and would move by now
            moves = rig.commands.moves(moment)
            moved = f'{len(moves)} moves after it went on' if moves else ''
            job.record(not (lost or moved), joined(lost, moved))


FAULTS = [
    Fault('predictor-killed', 'the predictor is killed during a call', 'It ran out of memory, or '
          'its machine went down, while the planner waits for a subgoal.', 'Its death is noticed '
          'within 1 s, a zero command is sent, nothing moves, the goal is aborted naming the '
          'predictor, and a call meanwhile fails within 1 s with its name; after the restart '
          'the first call is answered, and the first goal via a subgoal moves the arm.', 100,
          8.0, predictor,
          'until its death was noticed, where it was', 's'),
    Fault('planner-killed', 'the planner is killed during a goal', 'Nobody is left who could send '
          'a command to stop.', 'Its death is noticed and its client told within 1 s, the arm of '
          'the simulator stands still, and the first goal after the restart succeeds.', 50, 12.0,
          planner, 'until its death was noticed, where it was', 's'),
    Fault('simulator-killed', 'the simulator is killed during a goal', 'Camera and arm are gone '
          'at once.', 'Its death is noticed within 1 s, a zero command is sent within 0.5 s, the '
          'goal is aborted, and the first reset and goal after the restart succeed.', 50, 15.0,
          simulator, 'until its death was noticed, where it was', 's'),
    Fault('planner-paused', f'the planner stands still for {PAUSED_S:g} s during a goal', 'Its '
          'machine sleeps or swaps. What waited for it meanwhile looks new and is old.', 'The '
          'goal is aborted with that reason, and nothing moves before the next one.', 20, 9.0,
          paused)]
