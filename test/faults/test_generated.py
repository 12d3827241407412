# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Generated messages to every input of every node; what ends or blocks one is shrunk."""

import time

from fault_report import fault
import hypothesis
import message_strategies as strategies
import pytest
from rcl_interfaces.srv import GetParameters
from rclpy.action import ActionClient
from rclpy.qos import DurabilityPolicy, QoSProfile
from tap_msgs.action import ReachGoal
from tap_ros.contract import NODE_MODULES
from tap_ros.errors import TapError
from tap_ros.nodes import heartbeat
from tap_ros.nodes.calls import call, cancel_goal, in_executor, wait_for_future
from tap_ros.nodes.topics import LATCHED

pytestmark = pytest.mark.ros

BATCH = 25  # messages between two looks at the nodes
ROUND = 200  # batches between two good calls to everything
ANSWER_S = 10.0
# So that masks and descriptions are used.
PARAMETERS = {'sim_node': {'look': 'arm'}, 'predictor_node': {'robot_mask': 'arm'},
              'visual_mpc_node': {'robot_mask': 'arm'}}


class Target:
    """
    All nodes, and ways to send a case to them.

    :param rig: Rig.
    """

    def __init__(self, rig):
        self._rig, self.sent = rig, 0
        self._publishers = {
            name: rig.node.create_publisher(strategies.message_type(kind), name, self._qos(name))
            for name, kind in strategies.TOPICS.items()}
        self._clients = {name: rig.node.create_client(self._service(kind), name)
                         for name, kind in strategies.SERVICES.items()}
        self._parameters = {name: rig.node.create_client(GetParameters, f'{name}/get_parameters')
                            for name in NODE_MODULES}
        self._reach = ActionClient(rig.node, ReachGoal, 'reach_goal')
        self.restore()

    def close(self):
        """Take back what was published."""
        for publisher in self._publishers.values():
            self._rig.node.destroy_publisher(publisher)

    def restore(self):
        """Have all nodes running, after something ended or blocked one."""
        for name, attacked in self._rig.processes.items():
            try:
                self._look(name)
            except TapError:
                attacked.kill()
        self._rig.need(*NODE_MODULES.keys() - {'sim_node'}, sim='real', parameters=PARAMETERS)
        for name, client in self._parameters.items():
            assert client.wait_for_service(20), f'{name}: its parameters were not found'

    def send(self, cases):
        """Send cases and wait for the answers; raise TapError if a node is none the better."""
        self.sent += len(cases)
        for where, message in cases:
            if where in self._publishers:
                self._publishers[where].publish(message)
        for where, request in cases:
            if where in self._clients:
                call(self._clients[where], request, ANSWER_S)
            elif where not in self._publishers:
                self._pursue(request)
        for name in NODE_MODULES:
            self._look(name)

    def good_calls(self):
        """Make a good call to everything; raise TapError when one is not answered well."""
        self._rig.expect_prediction(ANSWER_S)
        self._rig.client.pause(False)
        self._rig.reset(1)

    def _look(self, name):
        """Raise TapError when a node has ended or does not answer."""
        self._rig.processes[name].check()
        call(self._parameters[name], GetParameters.Request(), ANSWER_S)

    def _pursue(self, goal):
        """Send a goal, let it begin, and cancel it; raise AssertionError if it does not end."""
        node, client = self._rig.node, self._reach
        future = in_executor(node, lambda: client.send_goal_async(goal), ANSWER_S)
        assert wait_for_future(future, ANSWER_S), 'no answer to a goal'
        handle = future.result()
        if handle.accepted:
            ends = in_executor(node, handle.get_result_async, ANSWER_S)
            if not wait_for_future(ends, 0.2):
                cancel_goal(handle, ANSWER_S)
                assert wait_for_future(ends, ANSWER_S), 'a cancelled goal did not end'

    @staticmethod
    def _qos(name):
        if name in strategies.LATCHED_TOPICS:
            return LATCHED
        return heartbeat.QOS if name.endswith('/heartbeat') else QoSProfile(
            depth=200, durability=DurabilityPolicy.VOLATILE)

    @staticmethod
    def _service(name):
        package, kind, last = name.split('/')
        return getattr(__import__(f'{package}.{kind}', fromlist=[last]), last)


@fault('generated messages: wrong sizes, extreme numbers, control characters', 'no node ends, '
       'each call is answered, good calls are answered well in between', 100_000)
def test_generated_messages(rig, trials):
    target = Target(rig)
    try:
        attack(target, trials)
    finally:
        target.close()


def attack(target, trials):
    """Send rounds of generated messages until all are sent or some have done harm."""
    seed = 0
    while target.sent < trials.count:
        seed, before = seed + 1, target.sent
        examples = max(1, min(ROUND, -(-(trials.count - before) // BATCH)))

        @hypothesis.seed(seed)
        @hypothesis.settings(
            max_examples=examples, deadline=None, database=None, print_blob=False,
            suppress_health_check=list(hypothesis.HealthCheck),
            phases=(hypothesis.Phase.generate, hypothesis.Phase.shrink))
        @hypothesis.given(hypothesis.strategies.lists(
            strategies.cases(), min_size=BATCH // 2, max_size=BATCH * 3 // 2))
        def send(cases):
            try:
                target.send(cases)
            except (AssertionError, TapError):
                time.sleep(0.5)
                target.restore()
                raise
        with trials.one():
            try:
                send()  # what does harm is made small, and printed
                target.good_calls()
            finally:
                trials.record(times=target.sent - before - 1)
        if trials.tried > trials.held:
            break
