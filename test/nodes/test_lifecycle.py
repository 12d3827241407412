# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Predictor and planner as managed nodes: what each state does, and weights that change."""

import threading

from action_msgs.msg import GoalStatus
from lifecycle_msgs.msg import State, Transition
from lifecycle_msgs.srv import ChangeState, GetState
import numpy as np
from processes import Client
import pytest
from rcl_interfaces.msg import Parameter as ParameterMessage
from rcl_interfaces.srv import SetParameters
from rclpy.parameter import Parameter
from std_msgs.msg import String
from tap_msgs.action import ReachGoal
from tap_msgs.srv import PredictSubgoal
from tap_ros.nodes.clients import (
    call,
    Newest,
    send_goal,
    wait_for_future,
    wait_for_result,
)
from tap_ros.nodes.topics import LATCHED, SERVICE_QOS
from tap_ros.training.weights import stored_digest
from tap_ros.weights import FORWARD_MODEL
from test_predictor_node import pictures, Service, weights_file, WITH_GOAL

pytestmark = pytest.mark.slow
CONFIGURE, ACTIVATE = Transition.TRANSITION_CONFIGURE, Transition.TRANSITION_ACTIVATE
DEACTIVATE, CLEANUP = Transition.TRANSITION_DEACTIVATE, Transition.TRANSITION_CLEANUP


class Managed:
    """The services that manage a node."""

    def __init__(self, node, name):
        self.change = node.create_client(ChangeState, f'{name}/change_state')
        self.get = node.create_client(GetState, f'{name}/get_state')
        self.set = node.create_client(SetParameters, f'{name}/set_parameters')
        for client in (self.change, self.get, self.set):
            assert client.wait_for_service(60)

    def state(self):
        return call(self.get, GetState.Request(), 30).current_state.id

    def to(self, transition):
        """Ask for a transition, and tell whether it was done."""
        request = ChangeState.Request(transition=Transition(id=transition))
        return call(self.change, request, 60).success

    def weights(self, value, name='weights'):
        """Change weights; return why they were not, '' if they were."""
        message = ParameterMessage(
            name=name, value=Parameter(name, value=str(value)).get_parameter_value())
        result, = call(self.set, SetParameters.Request(parameters=[message]), 60).results
        assert result.successful == (not result.reason)
        return result.reason


@pytest.fixture
def predictor(tmp_path):
    """Start a predictor_node with weights of its own."""
    started = []
    with Client() as node:
        def start(**parameters):
            plain = weights_file(tmp_path / 'plain.safetensors')
            started.append(Service(node, 'managed', tmp_path, weights=plain, **parameters))
            return started[-1], Managed(node, '/managed/predictor_node')

        yield start
        for service in started:
            service.process.kill()


def test_a_predictor_answers_while_it_is_active_alone(predictor, tmp_path):
    service, managed = predictor(autostart='false')
    service.process.wait_for('waiting', 120)
    assert managed.state() == State.PRIMARY_STATE_UNCONFIGURED
    assert 'configure, then activate' in service.refusal(**WITH_GOAL)
    assert not managed.to(ACTIVATE), 'a transition that the state does not have is answered'
    assert managed.weights(tmp_path / 'none.safetensors') == '', 'tried when it is configured'
    assert not managed.to(CONFIGURE)
    assert 'none.safetensors' in service.process.text
    assert managed.state() == State.PRIMARY_STATE_UNCONFIGURED
    assert managed.weights(tmp_path / 'plain.safetensors') == ''
    assert managed.to(CONFIGURE)
    assert managed.state() == State.PRIMARY_STATE_INACTIVE
    assert 'ros2 lifecycle set /managed/predictor_node activate' in service.refusal(**WITH_GOAL)
    assert managed.to(ACTIVATE)
    before = pictures(service.answer(**WITH_GOAL))
    assert managed.to(DEACTIVATE)
    assert 'inactive' in service.refusal(**WITH_GOAL)
    assert managed.to(ACTIVATE)
    assert np.array_equal(before, pictures(service.answer(**WITH_GOAL)))
    assert managed.to(DEACTIVATE) and managed.to(CLEANUP)
    assert 'no weights' in service.refusal(**WITH_GOAL)
    assert managed.to(CONFIGURE) and managed.to(ACTIVATE)
    assert np.array_equal(before, pictures(service.answer(**WITH_GOAL)))
    assert managed.to(Transition.TRANSITION_ACTIVE_SHUTDOWN)
    assert managed.state() == State.PRIMARY_STATE_FINALIZED
    assert 'start it again' in service.refusal(**WITH_GOAL)
    assert service.process.end() == 0
    assert 'Traceback' not in service.process.text


def test_weights_change_while_a_predictor_is_inactive_alone(predictor, tmp_path):
    service, managed = predictor()
    service.process.wait_for('ready', 120)
    assert managed.state() == State.PRIMARY_STATE_ACTIVE
    before = pictures(service.answer(**WITH_GOAL))
    other = weights_file(tmp_path / 'other.safetensors', latent_size=8)
    reason = managed.weights(other)
    assert 'deactivate' in reason and 'weights' in reason
    assert managed.to(DEACTIVATE)
    broken = tmp_path / 'broken.safetensors'
    broken.write_bytes(b'no weights')
    assert 'broken.safetensors' in managed.weights(broken)
    assert 'forward_weights' in managed.weights(other, 'forward_weights'), 'not of that mode'
    assert managed.to(ACTIVATE)
    assert np.array_equal(before, pictures(service.answer(**WITH_GOAL))), 'still the first ones'
    assert managed.to(DEACTIVATE)
    assert managed.weights(other) == ''
    assert managed.to(ACTIVATE)
    answer = service.answer(num_samples=3, **WITH_GOAL)
    assert len(answer.subgoals) == 3, 'these weights have more than one sample'
    assert str(other) in service.process.text.splitlines()[-1]
    assert service.process.end() == 0
    assert 'Traceback' not in service.process.text


def test_who_waits_for_a_subgoal_is_answered_when_the_predictor_is_deactivated(predictor):
    service, managed = predictor()
    service.process.wait_for('ready', 120)
    assert service.client.wait_for_service(30)
    client = service.node.create_client(
        PredictSubgoal, '/managed/predict_subgoal', qos_profile=SERVICE_QOS)
    assert client.wait_for_service(30)
    request = PredictSubgoal.Request(recursion_depth=8, **WITH_GOAL)
    waiting = [client.call_async(request) for _ in range(40)]
    assert wait_for_future(waiting[0], 60)
    assert managed.to(DEACTIVATE)
    assert all(wait_for_future(future, 60) for future in waiting)
    refused = [future.result().message for future in waiting if not future.result().success]
    assert waiting[0].result().success
    assert all('activate it' in message for message in refused)
    assert managed.to(ACTIVATE)
    service.answer(**WITH_GOAL)
    assert managed.to(DEACTIVATE)
    assert service.process.end() == 0, 'it ends well while it is inactive'
    assert 'Traceback' not in service.process.text


def test_the_card_is_that_of_the_weights_in_use_and_not_of_a_newer_file(predictor, tmp_path):
    service, managed = predictor(autostart='false')
    service.process.wait_for('waiting', 120)
    assert managed.to(CONFIGURE)
    plain = tmp_path / 'plain.safetensors'
    digest = stored_digest(plain)
    weights_file(plain, latent_size=8)
    assert stored_digest(plain) != digest
    assert managed.to(ACTIVATE)
    card = Newest(service.node, String, '/managed/predictor_node/model_card', LATCHED)
    assert digest in card.wait(20).data
    assert service.process.end() == 0, 'it ends well while it is active'


def begin_to_move(loop):
    """Send a goal and return its handle once the arm moves."""
    moving = threading.Event()
    handle = send_goal(loop.reach_client, ReachGoal.Goal(mode='direct'), 30,
                       lambda feedback: moving.set())
    assert moving.wait(120)
    return handle


def test_a_planner_that_is_deactivated_stops_the_arm(loop):
    managed = Managed(loop.node, 'visual_mpc_node')
    loop.reset()
    handle = begin_to_move(loop)
    assert managed.to(DEACTIVATE)
    status, result = wait_for_result(handle, 30)
    assert status == GoalStatus.STATUS_ABORTED and 'deactivated' in result.message
    assert loop.stopped()
    count = len(loop.moves())
    status, result = loop.reach(mode='direct', step_budget=1)
    assert status == GoalStatus.STATUS_ABORTED and result.steps == 0
    assert 'ros2 lifecycle set /visual_mpc_node activate' in result.message
    assert loop.stopped() and len(loop.moves()) == count
    assert 'none.safetensors' in managed.weights(loop.folder / 'none.safetensors')
    assert managed.weights(FORWARD_MODEL) == ''
    assert managed.to(CLEANUP) and managed.to(CONFIGURE) and managed.to(ACTIVATE)
    loop.reset()
    status, result = loop.reach(mode='direct', step_budget=2)
    assert status == GoalStatus.STATUS_SUCCEEDED and result.steps == 2, result.message
    assert 'Traceback' not in loop.processes['visual_mpc_node'].text


def test_a_planner_that_is_shut_down_stops_the_arm_for_good(loop):
    managed = Managed(loop.node, 'visual_mpc_node')
    loop.reset()
    handle = begin_to_move(loop)
    assert managed.to(Transition.TRANSITION_ACTIVE_SHUTDOWN)
    status, result = wait_for_result(handle, 30)
    assert status == GoalStatus.STATUS_ABORTED and 'deactivated' in result.message
    assert loop.stopped()
    count = len(loop.moves())
    status, result = loop.reach(mode='direct', step_budget=1)
    assert status == GoalStatus.STATUS_ABORTED and 'start it again' in result.message
    assert loop.stopped() and len(loop.moves()) == count
    assert loop.processes['visual_mpc_node'].end() == 0
