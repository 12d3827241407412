# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Inputs that fall silent or tell nonsense: nothing moves by them."""

import re
import time

from fault_report import fault
from fault_rig import STOP_S
from fault_world import first_pictures, objects_message, predict_fields
import numpy as np
import pytest
from tap_ros.errors import TapError
from tap_ros.nodes.topics import to_stamp
from tap_ros.planning.mpc_inputs import GRIPPER_PARTS

pytestmark = pytest.mark.ros

AGES_S = (0.5, 1.0, 2.0, 3.0, 5.0, 10.0, 20.0, 60.0)
ABSURD = (5.4e8, 5000.0, -7000.0, float('inf'), float('-inf'), float('nan'), 1e308, -1e30, 70.0,
          -10.0)
BOUNDS = re.compile(r'expected (finite numbers|(u from )?-?[\d.]+ to |[\w ]+, at most )-?[\d.]*')


@pytest.mark.parametrize('topic', ['image', 'objects', 'joints'])
@fault('camera, object tracker or joint states fall silent during a goal',
       f'zero command within {STOP_S:g} s of the last message, no move after that', 50,
       's until the stop')
def test_silent(rig, trials, topic):
    rig.need('visual_mpc_node')
    random = np.random.default_rng(0)
    with rig.world() as world:
        for _ in trials:
            world.restore()
            time.sleep(0.3)
            rig.need('visual_mpc_node')
            with trials.one():
                rig.begin_moving()
                time.sleep(random.uniform(0, 0.4))
                moment = world.silence(topic)
                time.sleep(max(0.0, moment + 1.2 - time.monotonic()))
                trials.measured(rig.commands.seconds_to_stop(moment))
                rig.commands.assert_stopped(moment, STOP_S * trials.patience)


@fault('a goal begins 0.5 to 60 s after the camera died', 'aborted, not one move is sent', 24,
       'moves sent')
def test_camera_dead(rig, trials):
    rig.need('visual_mpc_node')
    with rig.world() as world:
        for trial in trials:
            world.restore()
            time.sleep(0.5)
            moment = world.silence(*(('image',), ('image', 'objects', 'joints'))[trial % 2])
            age = AGES_S[trial % len(AGES_S)]
            time.sleep(max(0.0, moment + age - time.monotonic()))
            rig.need('visual_mpc_node')
            begin = time.monotonic()
            with trials.one():
                rig.expect_end(rig.begin(), 'aborted')
                moves = rig.commands.moves(begin)
                trials.measured(len(moves))
                assert not moves, f'{len(moves)} moves, the camera dead for {age:g} s'


def absurd_pixels(trial):
    """Return what a World publishes: pixels with one absurd; and whose it is."""
    seen = first_pictures()[0]
    pixels = seen.object_pixels.astype(float)
    pixels[1, trial % 2] = ABSURD[trial % len(ABSURD)]
    return {'pixels': pixels}, seen.object_names[1]


def absurd_joints(trial):
    """Return the same for joints of the gripper."""
    gripper = first_pictures()[0].gripper.astype(float)
    gripper[trial % 4] = ABSURD[trial % len(ABSURD)]
    return {'gripper': gripper}, GRIPPER_PARTS[trial % 4]


@pytest.mark.parametrize('spoil', [absurd_pixels, absurd_joints], ids=['pixels', 'joints'])
@fault('absurd object pixels or joints, to the planner',
       'aborted naming the object or joint and what is expected; nothing moves by it', 40)
def test_absurd_to_planner(rig, trials, spoil):
    rig.need('visual_mpc_node')
    with rig.world() as world:
        for trial in trials:
            spoiled, name = spoil(trial)
            world.restore()
            rig.need('visual_mpc_node')
            during = trial % 4 == 3
            with trials.one():
                if during:
                    handle = rig.begin_moving()
                world.spoil(**spoiled)
                time.sleep(0.0 if during else 0.5)
                moment = time.monotonic()
                if not during:
                    handle = rig.begin()
                end = rig.expect_end(handle, 'aborted: ', timeout_s=12.0)
                moves = rig.commands.moves(moment + (STOP_S * trials.patience if during else 0.0))
                assert not moves, f'{spoiled}: {len(moves)} moves'
                assert_refuses(end.removeprefix('aborted: '), name)
                rig.check()


@fault('absurd object pixels, to the predictor',
       'refused naming the object and what is expected; the node lives', 40)
def test_absurd_to_predictor(rig, trials):
    views = dict(zip(('start_objects', 'goal_objects'), first_pictures()))
    for trial in trials:
        rig.need('predictor_node')
        field = list(views)[trial % 2]
        view = views[field]
        pixels = view.object_pixels.astype(float)
        pixels[1, trial // 4 % 2] = ABSURD[trial // 2 % len(ABSURD)]
        objects = objects_message(view, to_stamp(0), pixels)
        with trials.one():
            with pytest.raises(TapError) as refused:
                rig.client.call('predict', 10.0, **predict_fields(**{field: objects}))
            assert_refuses(str(refused.value), view.object_names[1])
            rig.check()


def assert_refuses(message, name):
    """Raise AssertionError unless a refusal of a number says whose it is and the bounds."""
    assert re.search(rf'(?<![^\W_]){re.escape(name)}\b', message), (
        f'the refusal does not name {name}: {message}')
    assert BOUNDS.search(message), f'the refusal does not name the bounds: {message}'
