# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Inputs that fall silent or tell nonsense: nothing moves by them."""

from functools import partial
import re
import time

from experiments.faults.fault import Fault
from experiments.faults.nodes.rig import outcome
from experiments.faults.nodes.world import (
    first_pictures,
    goal_fields,
    objects_message,
    predict_fields,
)
import numpy as np
from tap_ros.nodes.topics import to_stamp
from tap_ros.planning.mpc_inputs import GRIPPER_PARTS

STOP_S = 0.5
AGES_S = (0.5, 1.0, 2.0, 3.0, 5.0, 10.0, 20.0, 60.0)
ABSURD = (5.4e8, 5000.0, -7000.0, float('inf'), float('-inf'), float('nan'), 1e308, -1e30, 70.0,
          -10.0)
BOUNDS = re.compile(r'expected (finite numbers|(u from )?-?[\d.]+ to -?[\d.]+)')


def judge_stop(job, moment):
    """
    Say what is wrong with how the arm was stopped after a moment.

    :return: what is wrong, or an empty string; and the seconds to the stop.
    """
    commands, limit = job.rig.commands, STOP_S * job.patience
    seconds = commands.seconds_to_stop(moment)
    late = [command.at - moment for command in commands.moves(moment + limit)]
    if late:
        return f'a move was sent after {max(late):.1f} s', seconds
    if seconds > limit:
        return ('no stop was sent' if seconds == float('inf')
                else f'the stop came after {seconds:.2f} s'), seconds
    return '', seconds


def silent(job, topics):
    """Let inputs fall silent while a goal is executed."""
    rig = job.rig
    rig.need('visual_mpc_node')
    with rig.world() as world:
        for _ in job.trials():
            world.restore()
            time.sleep(0.3)
            rig.commands.forget()
            handle = rig.begin_moving()
            time.sleep(job.random.uniform(0, 0.4))
            moment = world.silence(*topics)
            time.sleep(max(0.0, moment + 1.2 - time.monotonic()))
            why, seconds = judge_stop(job, moment)
            world.restore()
            outcome(rig.finish, handle)
            job.record(not why, why, seconds)


def dead_before(job):
    """Begin goals at a time after the camera died."""
    rig = job.rig
    rig.need('visual_mpc_node')
    with rig.world() as world:
        for trial in job.trials():
            world.restore()
            time.sleep(0.5)
            moment = world.silence(*(('image',), ('image', 'objects', 'joints'))[trial % 2])
            age = AGES_S[trial % len(AGES_S)]
            time.sleep(max(0.0, moment + age - time.monotonic()))
            rig.commands.forget()
            begin = time.monotonic()
            handle = rig.begin(**goal_fields())
            end, error = outcome(rig.result, handle, 30.0)
            moves = rig.commands.moves(begin)
            why = error or ('' if end.startswith('aborted') else f'the goal {end}')
            if moves:
                far = 100 * max(float(np.linalg.norm(move.move)) for move in moves)
                why = f'{len(moves)} moves of up to {far:.1f} cm, the camera dead for {age:g} s'
            job.record(not why, why, len(moves))


def absurd_pixels(trial):
    """Return what a World publishes: pixels with one absurd; whose it is, and its value."""
    seen = first_pictures()[0]
    pixels = seen.object_pixels.astype(float)
    value = pixels[1, trial % 2] = ABSURD[trial % len(ABSURD)]
    return {'pixels': pixels}, seen.object_names[1], value


def absurd_joints(trial):
    """Return the same for joints of the gripper."""
    gripper = first_pictures()[0].gripper.astype(float)
    value = gripper[trial % 4] = ABSURD[trial % len(ABSURD)]
    return {'gripper': gripper}, GRIPPER_PARTS[trial % 4], value


def absurd_to_planner(job, spoil):
    """Publish absurd values: before a goal, or from its middle on."""
    rig = job.rig
    rig.need('visual_mpc_node')
    with rig.world() as world:
        for trial in job.trials():
            spoiled, name, value = spoil(trial)
            world.restore()
            during = trial % 4 == 3
            if during:
                handle = rig.begin_moving()
                world.spoil(**spoiled)
                moment = time.monotonic()
            else:
                world.spoil(**spoiled)
                time.sleep(0.5)
                moment = time.monotonic()
                handle = rig.begin(**goal_fields())
            end, error = outcome(rig.result, handle, 12.0)
            moves = rig.commands.moves(moment + (STOP_S * job.patience if during else 0.0))
            why = error or judge_refusal(end.removeprefix('aborted: '), name)
            if end and not end.startswith('aborted'):
                why = f'{name} {value:g}: the goal {end}'
            if moves:
                why = f'{name} {value:g}: {len(moves)} moves'
            rig.check()
            job.record(not why, why)


def absurd_to_predictor(job):
    """Ask for predictions with pixels outside the picture."""
    rig = job.rig
    rig.need('predictor_node')
    views = dict(zip(('start_objects', 'goal_objects'), first_pictures()))
    for trial in job.trials():
        field = list(views)[trial % 2]
        view = views[field]
        value = ABSURD[trial // 2 % len(ABSURD)]
        pixels = view.object_pixels.astype(float)
        pixels[1, trial // 4 % 2] = value
        objects = objects_message(view, to_stamp(0), pixels)
        response, why = outcome(rig.predict, 10.0, **predict_fields(**{field: objects}))
        if response is not None:
            why = (f'pixel {value:g} was accepted' if response.success
                   else judge_refusal(response.message, view.object_names[1]))
        if not rig.processes['predictor_node'].alive:
            why = f'pixel {value:g} ended the node: {rig.processes["predictor_node"].last_line()}'
            rig.need('predictor_node')
        job.record(not why, why)


def judge_refusal(message, name):
    """Say what a refusal of a number lacks; an empty string if nothing."""
    if not re.search(rf'(?<![^\W_]){re.escape(name)}\b', message):
        return f'the refusal does not name {name}: {message}'
    if not BOUNDS.search(message):
        return f'the refusal does not name the bounds: {message}'
    return ''


STOPPED = f'A zero command within {STOP_S:g} s of the last message, and no move after that.'
FAULTS = [
    Fault('camera-silent', 'the camera falls silent during a goal', 'A cable is pulled while the '
          'arm pushes. It must not go on blind.', STOPPED, 50, 3.0,
          partial(silent, topics=('image',)), 'until the arm was told to stop', 's'),
    Fault('objects-silent', 'the object tracker falls silent during a goal', 'The program that '
          'finds the objects hangs, while pictures keep coming.', STOPPED, 50, 3.0,
          partial(silent, topics=('objects',)), 'until the arm was told to stop', 's'),
    Fault('joints-silent', 'the joint states fall silent during a goal', 'The driver of the arm '
          'no longer says where the arm is.', STOPPED, 50, 3.0,
          partial(silent, topics=('joints',)), 'until the arm was told to stop', 's'),
    Fault('camera-dead', 'a goal begins 0.5 to 60 s after the camera died', 'Nobody noticed that '
          'the camera is dead, and sends a goal. What it saw last is no longer true.',
          'The goal is aborted and not one move is sent.', 24, 19.0, dead_before,
          'moves sent', 'moves'),
    Fault('pixels-planner', 'absurd object pixels, to the planner', 'The object tracker reports a '
          'place outside the picture, infinity or NaN.', 'The goal is aborted with the name of '
          'the object and what is expected; nothing moves by such a pixel.', 40, 2.0,
          partial(absurd_to_planner, spoil=absurd_pixels)),
    Fault('joints-planner', 'absurd joints, to the planner', 'The driver of the arm speaks of '
          'millimetres or of another frame, or says nonsense.', 'The goal is aborted with the '
          'joint and what is expected; nothing moves by such a joint.', 40, 2.0,
          partial(absurd_to_planner, spoil=absurd_joints)),
    Fault('pixels-predictor', 'absurd object pixels, to the predictor', 'The same in a request '
          'for a subgoal.', 'Refused with the name of the object and what is expected; the node '
          'lives.',
          40, 0.5, absurd_to_predictor)]
