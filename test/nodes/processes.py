# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Nodes as processes or in this process, and a client node of the test's own, all over DDS."""

import os
from pathlib import Path
import re
import signal
import subprocess
import sys
import threading
import time

from rclpy.context import Context
from rclpy.executors import MultiThreadedExecutor, SingleThreadedExecutor
from rclpy.node import Node
from rclpy.parameter import Parameter
from tap_ros.contract import NODE_MODULES
from tap_ros.nodes.clients import Spinner
from tap_ros.nodes.heartbeat import Heartbeat

ROOT = Path(__file__).parents[2]


def until(accept, seconds=30.0, pause=0.02):
    """Ask until the answer is true; return the last answer."""
    deadline = time.monotonic() + seconds
    while not (found := accept()) and time.monotonic() < deadline:
        time.sleep(pause)
    return found


class NodeProcess:
    """
    One node in a process group of its own.

    :param name: of the node, one of NODE_MODULES.
    :param log: file for what it prints.
    :param parameters: its ROS parameters.
    :param remaps: further arguments after --ros-args.
    """

    def __init__(self, name, log, parameters=None, remaps=()):
        self.log = Path(log)
        arguments = [f'-p {name}:={value}' for name, value in (parameters or {}).items()]
        command = [sys.executable, '-m', NODE_MODULES[name], '--ros-args',
                   *' '.join([*arguments, *remaps]).split()]
        with open(self.log, 'wb') as output:
            self.process = subprocess.Popen(
                command, stdout=output, stderr=subprocess.STDOUT, cwd=ROOT,
                start_new_session=True)

    @property
    def text(self):
        """Everything printed so far."""
        return self.log.read_text(errors='replace')

    def wait_for(self, words, timeout_s=60):
        """Wait until the node prints something."""
        def printed():
            assert words in self.text or self.process.poll() is None, self.text
            return words in self.text

        assert until(printed, timeout_s), f'no {words!r} in time:\n{self.text}'
        return self

    def end(self, number=signal.SIGTERM, timeout_s=20):
        """Send a signal and return the exit code."""
        if self.process.poll() is None:
            self.process.send_signal(number)
        return self.process.wait(timeout_s)

    def kill(self):
        """Leave nothing running."""
        if self.process.poll() is None:
            os.killpg(self.process.pid, signal.SIGKILL)
            self.process.wait()


class Client:
    """A node of the test's own with a thread that spins it; several may live side by side."""

    def __init__(self, name='test_client', **options):
        self.context = Context()
        self.context.init()
        self.node = Node(name, context=self.context, **options)
        self.spinner = Spinner(self.node)

    def __enter__(self):
        self.spinner.__enter__()
        return self.node

    def __exit__(self, *_):
        self.spinner.__exit__()
        self.node.destroy_node()
        self.context.try_shutdown()


class LocalNode:
    """
    A node in a thread of this process: it starts in a fraction of the time of a process.

    :param make: class of the node.
    :param num_threads: of its executor.
    :param remaps: {name: new name} of topics and services.
    :param parameters: its ROS parameters.
    """

    def __init__(self, make, namespace='', num_threads=1, remaps=None, **parameters):
        self.context = Context()
        self.context.init(args=[])
        self.running = True
        try:
            rules = [word for pair in (remaps or {}).items() for word in ('-r', ':='.join(pair))]
            self.node = make(
                context=self.context, namespace=namespace,
                cli_args=['--ros-args', *rules] if rules else None, parameter_overrides=[
                    Parameter(name, value=str(value) if isinstance(value, Path) else value)
                    for name, value in parameters.items()])
        except BaseException:
            self.context.try_shutdown()
            raise
        self.executor = (
            SingleThreadedExecutor(context=self.context) if num_threads == 1
            else MultiThreadedExecutor(num_threads, context=self.context))
        self.executor.add_node(self.node)
        self.heartbeat = Heartbeat(self.node)
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._spin, daemon=True)
        self._thread.start()

    def _spin(self):
        while not self._stop.is_set():
            self.executor.spin_once(timeout_sec=0.1)

    def end(self):
        """End the node as run_node does; return what its close() returns."""
        self.running = False
        self._stop.set()
        self._thread.join(20)
        code = self.node.close()
        self.heartbeat.end()
        self.executor.shutdown(timeout_sec=2.0)
        self.node.destroy_node()
        self.context.try_shutdown()
        return code or 0


def page_address(process):
    """Return where the page of an explorer_node is."""
    return re.search(r'ready: open (http://\S+)', process.wait_for('ready').text)[1]
