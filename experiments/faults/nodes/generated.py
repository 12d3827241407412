# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Generated messages to every input of every node; what ends or blocks one is shrunk."""

import time

from experiments.faults.fault import Fault
from experiments.faults.nodes import strategies
from experiments.faults.nodes.rig import outcome
import hypothesis
from rcl_interfaces.srv import GetParameters
from rclpy.qos import DurabilityPolicy, QoSProfile
from std_srvs.srv import SetBool
from tap_ros.contract import NODE_MODULES
from tap_ros.errors import TapError
from tap_ros.nodes import heartbeat
from tap_ros.nodes.clients import call, cancel_goal, in_executor, wait_for_future
from tap_ros.nodes.topics import LATCHED

BATCH = 25  # messages between two looks at the nodes
ROUND = 200  # batches between two good calls to everything
MOST_FAILURES = 5  # of which each is shrunk, with nodes that start anew each time
SHRINK_S = 240.0
ANSWER_S = 10.0
# So that masks and descriptions are used.
PARAMETERS = {'sim_node': {'look': 'ur10e'}, 'predictor_node': {'robot_mask': 'arm'},
              'visual_mpc_node': {'robot_mask': 'arm'}}
TEST = """\
To see it again, and for the tests:

from experiments.faults.nodes.generated import Target
from experiments.faults.nodes.rig import Rig
from numpy import inf, nan

CASES = {cases!r}


def test_these_messages_end_no_node():
    with Rig() as rig:
        Target(rig).send(CASES)
"""


def _qos(name):
    if name in strategies.LATCHED_TOPICS:
        return LATCHED
    if name.endswith('/heartbeat'):
        return heartbeat.QOS
    return QoSProfile(depth=200, durability=DurabilityPolicy.VOLATILE)


class Failed(AssertionError):
    """A node ended, or did not answer, after a batch."""


class Target:
    """
    All nodes, and ways to send a case to them.

    :param rig: Rig.
    """

    def __init__(self, rig):
        self._rig = rig
        self.sent = 0
        rig.need()
        node = rig.node
        self._publishers = {
            name: node.create_publisher(strategies.message_type(kind), name, _qos(name))
            for name, kind in strategies.TOPICS.items()}
        self._clients = {name: node.create_client(strategies.message_type(kind), name)
                         for name, kind in strategies.SERVICES.items()}
        self._parameters = {
            name: node.create_client(GetParameters, f'{name}/get_parameters')
            for name in NODE_MODULES}
        self.restore()

    def restore(self):
        """Have all nodes running, after something ended one."""
        rig = self._rig
        for name, attacked in list(rig.processes.items()):
            if not attacked.alive or self._blocked(name):
                attacked.kill()
        if len(rig.processes) < len(NODE_MODULES) or not all(
                attacked.alive for attacked in rig.processes.values()):
            rig.need(*NODE_MODULES.keys() - {'sim_node'}, sim='real', parameters=PARAMETERS)
            for name in NODE_MODULES:
                if not self._parameters[name].wait_for_service(20):
                    raise TapError(f'{name}: its parameters were not found')
        time.sleep(0.5)

    def send(self, cases):
        """Send cases, wait for the answers, and raise Failed if a node is none the better."""
        calls = []
        for where, fields in cases:
            self.sent += 1
            if where in self._publishers:
                kind = strategies.message_type(strategies.TOPICS[where])
                self._publishers[where].publish(strategies.fill(kind(), fields))
            else:
                calls.append((where, fields))
        for where, fields in calls:
            self._call(where, fields)
        for name in NODE_MODULES:
            attacked = self._rig.processes[name]
            if self._blocked(name):
                time.sleep(0.5)
                raise Failed(f'{name} does not answer any more' if attacked.alive else
                             f'{name} ended: {attacked.last_line()}')

    def good_calls(self):
        """Make a good call to everything; raise Failed when one is not answered well."""
        rig = self._rig
        _, why = outcome(rig.expect_prediction, ANSWER_S)
        answer, lost = outcome(call, self._clients['sim/pause'], SetBool.Request(), ANSWER_S)
        _, reset = outcome(rig.reset, 1)
        why = why or lost or reset or ('' if answer.success else answer.message)
        if why:
            raise Failed(why)

    def _blocked(self, name):
        return not self._rig.processes[name].alive or bool(outcome(
            call, self._parameters[name], GetParameters.Request(), ANSWER_S)[1])

    def _call(self, where, fields):
        if where in self._clients:
            kind = strategies.message_type(strategies.SERVICES[where])
            request = strategies.fill(kind.Request(), fields)
            _, why = outcome(call, self._clients[where], request, ANSWER_S)
        else:
            why = self._goal(strategies.fill(
                strategies.message_type(where).Goal(), fields))
        if why:
            raise Failed(f'{where}: {why}')

    def _goal(self, goal):
        """Send a goal, let it begin, and cancel it; say what went wrong."""
        node, client = self._rig.node, self._rig.reach_client
        future = in_executor(node, lambda: client.send_goal_async(goal), ANSWER_S)
        if not wait_for_future(future, ANSWER_S):
            return 'no answer to a goal'
        handle = future.result()
        if handle.accepted:
            ends = in_executor(node, handle.get_result_async, ANSWER_S)
            if not wait_for_future(ends, 0.2):
                cancel_goal(handle, ANSWER_S)
                if not wait_for_future(ends, ANSWER_S):
                    return 'a cancelled goal did not end'
        return ''


def generated(job):
    """Send generated messages until all are sent or too many have done harm."""
    target = Target(job.rig)
    failures, seed = [], 0
    while target.sent < job.count and len(failures) < MOST_FAILURES:
        seed += 1
        before = target.sent
        left = job.count - target.sent
        examples = max(1, min(ROUND, -(-left // BATCH)))
        try:
            _send_round(target, examples, seed)
            target.good_calls()
            job.record(True, times=target.sent - before)
        except Failed as error:
            failures.append(str(error))
            target.restore()
            job.record(True, times=max(0, min(target.sent - before, left) - 1))
            job.record(False, str(error))


def _send_round(target, examples, seed):
    """Send so many batches; a batch that does harm is made small, and printed as a test."""
    shrinking = {}

    @hypothesis.seed(seed)
    @hypothesis.settings(
        max_examples=examples, deadline=None, database=None, print_blob=False,
        suppress_health_check=list(hypothesis.HealthCheck),
        phases=(hypothesis.Phase.generate, hypothesis.Phase.shrink))
    @hypothesis.given(hypothesis.strategies.lists(
        strategies.cases(), min_size=1 if examples == 1 else BATCH // 2, max_size=BATCH * 3 // 2))
    def send(cases):
        if shrinking and time.monotonic() > shrinking['until']:
            return  # long enough: what is smallest now stays
        try:
            target.send(cases)
        except Failed as error:
            shrinking.setdefault('until', time.monotonic() + SHRINK_S)
            shrinking['smallest'] = (cases, error)
            target.restore()
            raise

    try:
        send()
    except (Failed, hypothesis.errors.Flaky, BaseExceptionGroup) as error:
        if not shrinking:
            raise
        cases, found = shrinking['smallest']
        print(TEST.format(cases=cases), flush=True)
        raise Failed(f'{found}, after {len(cases)} messages, the last to {cases[-1][0]}: '
                     f'{cases[-1][1]}') from error


FAULTS = [
    Fault('generated-messages', 'messages that are made up', 'Another program publishes messages '
          'with wrong sizes, extreme numbers or control characters on the same topics, or calls '
          'services with them.', 'No node ends, every call is answered, and good calls are '
          'answered well in between.', 100_000, 0.006, generated)]
