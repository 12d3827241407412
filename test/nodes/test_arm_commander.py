# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What an action becomes on arm/delta_twist_cmds: metres per second, within limits."""

from geometry_msgs.msg import TwistStamped
import numpy as np
from processes import Client, Newest, until
import pytest
from rclpy.parameter import Parameter
from std_msgs.msg import Float64
from tap_ros.base.contract import ACTION_LIMIT, SPEED_LIMIT
from tap_ros.base.errors import ConfigError
from tap_ros.nodes.planner.arm import ArmCommander
from tap_ros.nodes.planner.settings import declare_parameters, step_limits
from tap_ros.planning.action_sequences import FULL, SequenceShape, SIZE
from tap_ros.ros.observations import Observations
from tap_ros.ros.topics import STREAM, to_stamp

HERE = np.array([0.1, -0.2, 0.05, 0], np.float32)  # the gripper, m
ACTION = np.array([0.03, -0.01, 0.02, 1], np.float32)  # m in a control period, gripper


@pytest.fixture(params=[None, 0.05, 10.0])
def commanded(request):
    """Return (control period, params, function that sends an action and returns what came)."""
    period = request.param
    given = [] if period is None else [Parameter('control_period', value=period)]
    with Client(parameter_overrides=given) as node:
        params = declare_parameters(node)
        arm, goal = ArmCommander(node, params, Observations('image')), object()
        twists = Newest(node, TwistStamped, 'arm/delta_twist_cmds', STREAM)
        arm.begin(goal)
        stamps = iter(range(1, 100))

        def send(action):
            stamp = to_stamp(next(stamps))
            assert arm.send(goal, action, HERE, stamp, ())
            linear = twists.wait(10, lambda m: m.header.stamp == stamp).twist.linear
            return np.array([linear.x, linear.y, linear.z])

        yield params['control_period'], params, send
        arm.close(1.0)


def test_a_driver_that_follows_the_velocity_moves_what_was_planned(commanded):
    period, params, send = commanded
    move, climb = (getattr(step_limits(params), name) for name in ('move', 'climb'))
    planned = np.clip(ACTION[:3], [-move, -move, -climb], [move, move, climb])
    assert np.array_equal(planned, ACTION[:3]) == (period >= 0.25)
    # As MoveIt Servo in speed units: each of its cycles adds velocity times its time.
    cycles = 50
    moved = sum(send(ACTION) * (period / cycles) for _ in range(cycles))
    np.testing.assert_allclose(moved, planned, atol=1e-9)


def test_no_action_is_faster_than_the_limits_whatever_the_control_period(commanded):
    period, params, send = commanded
    for action in (np.full(4, -1e30), np.full(4, 1e30)):
        sent = send(action)
        assert (np.abs(sent) <= np.array(SPEED_LIMIT) + 1e-9).all() and sent.all()
        assert (np.abs(sent) * period <= np.array(ACTION_LIMIT) + 1e-9).all()
    planned = SequenceShape(step_limits(params)).clip(np.full((1, SIZE), 1e30))
    np.testing.assert_allclose(planned[0, 0] / period, sent[0], err_msg='the planner knows it')


def test_no_command_leads_out_of_the_workspace_as_it_is_now(commanded):
    period, params, send = commanded
    params._node.set_parameters([Parameter('x_max', value=float(HERE[0]) + 0.004),
                                 Parameter('y_max', value=-0.3)])  # it stands outside
    moved = period * send(ACTION * (1, -1, 1, 1))
    out = period * send(ACTION * (-1, 1, 1, 1))
    limit = step_limits(params).move
    np.testing.assert_allclose(moved[:2], [0.004, 0], atol=1e-6)
    np.testing.assert_allclose(out[:2], [-min(0.03, limit), -min(0.01, limit)], atol=1e-6)


def test_the_workspace_is_by_default_the_reach_of_the_arm_and_within_the_contracts():
    given = [Parameter('arm', value='panda'), Parameter('x_max', value=0.1)]
    with Client(parameter_overrides=given) as node:
        limits = step_limits(declare_parameters(node))
    assert (limits.low, limits.high) == ((-0.4, -0.16), (0.1, 0.16))
    with Client() as node:
        assert step_limits(declare_parameters(node)) == FULL
    with (Client(parameter_overrides=[Parameter('y_min', value=-0.5)]) as node,
          pytest.raises(ConfigError, match='y_min.*-0.45')):
        declare_parameters(node)


def test_what_the_planner_says_itself_hides_no_other_time_that_the_arm_has_told():
    with Client() as node:
        params = declare_parameters(node)
        arm = ArmCommander(node, params, Observations('image'))
        assert until(lambda: arm._echoed)
        for first, later in ((0.5, 0.25), (0.25, 0.5)):  # they may come in any order
            arm._period, arm._echoed = 0.25, False
            arm._on_period(Float64(data=first))
            arm._on_period(Float64(data=later))
            with pytest.raises(ConfigError, match=r'the arm takes 0\.5 s'):
                arm.begin(object())
        arm._on_period(Float64(data=0.25))  # the arm was started anew
        arm.begin(object())
        arm.close(1.0)
