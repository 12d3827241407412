# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Requests and answers that threads of their own take, whatever the executors do."""

from threading import Event

from processes import LocalNode, until
from rclpy.node import Node
from std_srvs.srv import SetBool
import tap_ros
from tap_ros.ros.polling import DeferredService
from tap_ros.ros.topics import SERVICE_QOS


class Deferring(Node):
    """Its service keeps the requests, and a timer its executor busy."""

    def __init__(self, free, **options):
        super().__init__('deferring_node', **options)
        self.waiting = []
        self.service = DeferredService(
            self, SetBool, 'deferred', lambda request, send: self.waiting.append((request, send)))
        self.create_timer(0.01, lambda: free.wait(60))

    def close(self):
        self.service.close()


def test_what_was_taken_is_worked_on_though_another_request_cannot_be(capfd):
    calls = []

    class Failing(Deferring):
        def __init__(self, **options):
            super().__init__(Event(), **options)
            self.service._work = lambda: calls.append('work')
            self.service._take_one = self.take

        def take(self):
            calls.append('take')
            if calls == ['take', 'take']:
                raise RuntimeError('cannot be taken')
            return len(calls) == 1

    server = LocalNode(Failing)
    with tap_ros.Client() as client:
        asked = client.node.create_client(
            SetBool, 'deferred', qos_profile=SERVICE_QOS, callback_group=client.answers)
        assert asked.wait_for_service(30)
        asked.call_async(SetBool.Request())
        server.node.service.start()
        assert until(lambda: len(calls) > 2, 30) and calls[:3] == ['take', 'take', 'work']
    assert server.end() == 0
    assert 'cannot be taken' in capfd.readouterr().err


def test_requests_and_answers_are_taken_while_executors_are_busy():
    free = Event()
    server = LocalNode(lambda **options: Deferring(free, **options))
    waiting = server.node.waiting
    with tap_ros.Client() as client:
        asked = client.node.create_client(
            SetBool, 'deferred', qos_profile=SERVICE_QOS, callback_group=client.answers)
        client.node.create_timer(0.01, lambda: free.wait(60))
        assert asked.wait_for_service(30)
        futures = [asked.call_async(SetBool.Request(data=True)) for _ in range(3)]
        assert not waiting  # the service has not begun
        server.node.service.start()
        assert until(lambda: len(waiting) == 3, 30)
        for request, send in reversed(waiting):
            assert request.data
            send(SetBool.Response(success=True, message='later'))
        assert until(lambda: all(future.done() for future in futures), 30)
        assert futures[0].result().message == 'later'
        assert not free.is_set()
        free.set()
    assert server.end() == 0
