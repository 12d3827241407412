# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The states of visual_mpc_node: whatever ends its work stops the arm."""

import threading

from action_msgs.msg import GoalStatus
from lifecycle import Lifecycle
import pytest
from std_msgs.msg import String
from tap_msgs.action import ReachGoal
from tap_ros.nodes.clients import Newest, send_goal, wait_for_result
from tap_ros.nodes.topics import LATCHED
from tap_ros.training.weights import stored_digest
from tap_ros.weights import FORWARD_MODEL

pytestmark = pytest.mark.slow


def begin_to_move(loop):
    """Send a goal and return its handle once the arm moves."""
    moving = threading.Event()
    handle = send_goal(loop.reach_client, ReachGoal.Goal(mode='direct'), 30,
                       lambda feedback: moving.set())
    assert moving.wait(120)
    return handle


def test_a_planner_that_is_deactivated_stops_the_arm(loop):
    states = Lifecycle(loop.node, 'visual_mpc_node')
    card = Newest(loop.node, String, 'visual_mpc_node/model_card', LATCHED).wait(20).data
    assert card.startswith(FORWARD_MODEL.with_suffix('.md').read_text().rstrip())
    assert stored_digest(FORWARD_MODEL) in card
    loop.reset()
    handle = begin_to_move(loop)
    assert states.to('deactivate')
    status, result = wait_for_result(handle, 30)
    assert status == GoalStatus.STATUS_ABORTED and 'deactivated' in result.message
    assert loop.stopped()
    count = len(loop.moves())
    status, result = loop.reach(mode='direct', step_budget=1)
    assert status == GoalStatus.STATUS_ABORTED and result.steps == 0
    assert 'ros2 lifecycle set /visual_mpc_node activate' in result.message
    assert loop.stopped() and len(loop.moves()) == count
    assert 'cleanup' in states.set('weights', loop.folder / 'none.safetensors')
    assert states.to('cleanup')
    assert states.set('weights', FORWARD_MODEL) == ''
    assert states.to('configure') and states.to('activate')
    loop.reset()
    status, result = loop.reach(mode='direct', step_budget=2)
    assert status == GoalStatus.STATUS_SUCCEEDED and result.steps == 2, result.message
    assert 'Traceback' not in loop.processes['visual_mpc_node'].text


def test_a_planner_that_is_shut_down_stops_the_arm_for_good(loop):
    states = Lifecycle(loop.node, 'visual_mpc_node')
    loop.reset()
    handle = begin_to_move(loop)
    assert states.to('active_shutdown')
    status, result = wait_for_result(handle, 30)
    assert status == GoalStatus.STATUS_ABORTED and 'deactivated' in result.message
    assert loop.stopped()
    count = len(loop.moves())
    status, result = loop.reach(mode='direct', step_budget=1)
    assert status == GoalStatus.STATUS_ABORTED and 'start it again' in result.message
    assert loop.stopped() and len(loop.moves()) == count
    assert loop.processes['visual_mpc_node'].end() == 0
