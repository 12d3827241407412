# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Clients that call predict_subgoal as fast as they are answered, in a process of their own.

    python fault_load.py CLIENTS SECONDS CALLS DEPTH

Each client sends its next request when the one before is answered, until so many seconds have
passed or it has made so many calls (0: any number). DEPTH answers wait in its queue. One line of
JSON says what came of them.
"""

from collections import Counter
import json
import sys
import threading
import time

from fault_world import predict_fields
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.qos import QoSProfile
from tap_msgs.srv import PredictSubgoal

PATIENCE_S = 15.0  # after so long a call counts as lost


class Caller:
    """
    One client.

    :param node: rclpy Node.
    :param calls: most calls; 0: any number.
    :param depth: answers that wait in its queue, those to all other clients among them.
    """

    def __init__(self, node, calls, depth):
        self.client = node.create_client(
            PredictSubgoal, 'predict_subgoal', qos_profile=QoSProfile(depth=depth))
        self._request = PredictSubgoal.Request(**predict_fields())
        self._left = calls or float('inf')
        self._future = self._sent = None
        self.until = float('inf')  # time.monotonic() at which it sends no more
        self.ends, self.done = Counter(), False
        self.answered = 0.0  # when the last answer came

    def send(self):
        """Send a request, unless it is time to end."""
        if self._left <= 0 or time.monotonic() >= self.until:
            self.done = True
            return
        self._left -= 1
        self._sent = time.monotonic()
        self._future = self.client.call_async(self._request)
        self._future.add_done_callback(self._on_answer)

    def look(self):
        """Give up a call that was not answered for too long."""
        if not self.done and time.monotonic() > self._sent + PATIENCE_S:
            self.client.remove_pending_request(self._future)
            self.ends['lost'] += 1
            self.send()

    def _on_answer(self, future):
        if future is not self._future:
            return
        response = future.result()
        self.answered = time.monotonic()
        busy = 'busy' in response.message
        self.ends['good' if response.success else 'busy' if busy else 'refused'] += 1
        if response.success:
            self.send()
        else:  # as a client does that is told to come later
            threading.Timer(0.05, self.send).start()


def main(count, seconds, calls, depth):
    """Call, and print what came of it."""
    context = Context()
    context.init()
    node = Node('load', context=context)
    executor = SingleThreadedExecutor(context=context)
    executor.add_node(node)
    callers = [Caller(node, int(calls), int(depth)) for _ in range(int(count))]
    late = time.monotonic() + 20
    while not all(one.client.service_is_ready() for one in callers) and time.monotonic() < late:
        executor.spin_once(timeout_sec=0.1)
    settled = time.monotonic() + 1.0
    while time.monotonic() < settled:
        executor.spin_once(timeout_sec=0.1)
    print('ready', flush=True)
    sys.stdin.readline()
    begin = time.monotonic()
    for caller in callers:
        caller.until = begin + float(seconds)
        caller.send()
    while not all(caller.done for caller in callers):
        executor.spin_once(timeout_sec=0.2)
        for caller in callers:
            caller.look()
    ends = sum((caller.ends for caller in callers), Counter())
    last = max(caller.answered for caller in callers)
    print(json.dumps({**ends, 'seconds': last - begin}), flush=True)
    executor.shutdown()
    node.destroy_node()
    context.try_shutdown()


if __name__ == '__main__':
    main(*sys.argv[1:])
