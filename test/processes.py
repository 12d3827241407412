# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Nodes as processes or in this process, and a client node of the test's own, all over DDS."""

from contextlib import contextmanager
import os
from pathlib import Path
import re
import signal
import subprocess
import sys
import threading
import time

from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState, GetState
from rcl_interfaces.msg import Parameter as ParameterMessage
from rcl_interfaces.srv import SetParameters
from rclpy.context import Context
from rclpy.executors import MultiThreadedExecutor, SingleThreadedExecutor
from rclpy.node import Node
from rclpy.parameter import Parameter
from tap_ros.apps.node_processes import errors_in
from tap_ros.ros.calls import call, CallError, Spinner
from tap_ros.ros.heartbeat import Heartbeat

ROOT = Path(__file__).parents[1]
PATIENCE = 5.0  # a time-out says that a test has failed, not how fast the machine is
_unread = []  # nodes with a log that was not read to its end


def news():
    """Return what the nodes of this test run have logged since this was called before."""
    living = [process for process in _unread if process.alive]
    text = '\n'.join(process.news() for process in _unread)
    _unread[:] = living
    return text


def ends():
    """Return what the nodes have logged last, as far as news has not told it yet."""
    return '\n'.join(f'{process.name}:\n{process.text[-2000:]}' for process in _unread)


def unexpected(log, expected):
    """Return what is wrong with the logs of nodes, '' if nothing is; see errors_in."""
    lines = errors_in(log, expected)
    return f'{len(lines)} unexpected lines in logs:\n' + '\n'.join(lines[:10]) if lines else ''


def until(accept, seconds=30.0, pause=0.02):
    """
    Ask until the answer is true; return the last answer.

    :param seconds: after which that has failed on an idle machine; a busy one gets more.
    """
    deadline = time.monotonic() + PATIENCE * seconds
    while not (found := accept()) and time.monotonic() < deadline:
        time.sleep(pause)
    return found


@contextmanager
def crowd(count):
    """Keep so many processes busy meanwhile."""
    busy = [subprocess.Popen([sys.executable, '-c', 'while True: pass']) for _ in range(count)]
    try:
        yield
    finally:
        for one in busy:
            one.kill()
            one.wait()


def _hear_signals():
    """Take back what nohup and background jobs of a shell ignore."""
    for number in (signal.SIGINT, signal.SIGHUP):
        signal.signal(number, signal.SIG_DFL)


class NodeProcess:
    """
    One node in a process group of its own.

    :param name: of the node, one of NODE_CLASSES.
    :param log: file for what it prints; a new start adds to it.
    :param parameters: its ROS parameters.
    :param remaps: further arguments after --ros-args.
    """

    def __init__(self, name, log, parameters=None, remaps=()):
        self.name, self.log, self.parameters = name, Path(log), dict(parameters or {})
        values = {key: str(value).lower() if isinstance(value, bool) else value
                  for key, value in self.parameters.items()}
        self._command = [sys.executable, '-m', 'tap_ros.nodes', name, '--ros-args', *' '.join(
            [*(f'-p {key}:={value}' for key, value in values.items()), *remaps]).split()]
        self.start()

    def start(self):
        """Start it, perhaps again, without waiting."""
        with open(self.log, 'ab') as output:
            self._from = output.tell()  # where the log of the present process begins
            self.process = subprocess.Popen(
                self._command, stdin=subprocess.DEVNULL, stdout=output, stderr=subprocess.STDOUT,
                cwd=ROOT, start_new_session=True, preexec_fn=_hear_signals)
        if self not in _unread:
            self._read = self._from
            _unread.append(self)
        return self

    @property
    def alive(self):
        """Whether it runs."""
        return self.process.poll() is None

    @property
    def text(self):
        """Everything that the present process has printed."""
        return self.log.read_bytes()[self._from:].decode(errors='replace')

    def news(self):
        """Return the whole lines that were not read yet."""
        new = self.log.read_bytes()[self._read:] if self.log.exists() else b''
        new = new[:new.rfind(b'\n') + 1] if self.alive else new
        self._read += len(new)
        return new.decode(errors='replace')

    def wait_for(self, words, timeout_s=90):
        """Wait until the node prints something."""
        def printed():
            assert words in self.text or self.alive, self.text
            return words in self.text

        assert until(printed, timeout_s), f'no {words!r} in time:\n{self.text}'
        return self

    def check(self):
        """Raise AssertionError when it has ended."""
        assert self.alive, f'{self.name} ended with {self.process.returncode}: {self.last_line()}'

    def last_line(self):
        """Return the last line that it printed."""
        return (self.text.strip().splitlines() or ['it printed nothing'])[-1]

    def send(self, number):
        """Send a signal, if it runs."""
        if self.alive:
            self.process.send_signal(number)

    def end(self, number=signal.SIGTERM, timeout_s=20):
        """Send a signal; return the exit code, None when it had to be killed after a time."""
        self.send(number)
        try:
            return self.process.wait(PATIENCE * timeout_s)
        except subprocess.TimeoutExpired:
            self.kill()
            return None

    def kill(self):
        """Leave nothing running; return the moment."""
        moment = time.monotonic()
        if self.alive:
            os.killpg(self.process.pid, signal.SIGKILL)
            self.process.wait()
        return moment

    def memory_mb(self):
        """Return the memory that it holds (resident set), in MB."""
        pages = Path(f'/proc/{self.process.pid}/statm').read_text().split()[1]
        return int(pages) * os.sysconf('SC_PAGE_SIZE') / 1e6


@contextmanager
def Client(name='test_client', **options):
    """Give a node of the test's own that a thread spins; several may live side by side."""
    context = Context()
    context.init()
    node = Node(name, context=context, **options)
    try:
        with Spinner(node):
            yield node
    finally:
        node.destroy_node()
        context.try_shutdown()


class Newest:
    """
    Keep the newest message of a topic.

    :param node: rclpy Node that another thread spins.
    :ivar count: messages received so far.
    """

    def __init__(self, node, message_type, topic, qos):
        self._topic, self._message, self.count = topic, None, 0
        node.create_subscription(message_type, topic, self._put, qos)

    def wait(self, timeout_s, accept=lambda message: True):
        """Return the newest message once `accept` says so of it; CallError if none comes."""
        def acceptable():
            message = self._message
            return message if message is not None and accept(message) else None

        found = until(acceptable, timeout_s, 0.005)
        if found is None:
            raise CallError(f'topic {self._topic}: of {self.count} messages none was as wanted '
                            f'within {timeout_s:g} s')
        return found

    def _put(self, message):
        self._message = message
        self.count += 1


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
        """End the node as run.main does; return what its close() returns."""
        self.running = False
        self._stop.set()
        self._thread.join(20)
        code = self.node.close()
        self.heartbeat.end()
        self.executor.shutdown(timeout_sec=2.0)
        self.node.destroy_node()
        vars(self.node).pop('_state_machine', None)  # rclpy's: it keeps the node in the ROS graph
        self.context.try_shutdown()
        return code or 0


class Lifecycle:
    """States and parameters of a node, asked by another one."""

    def __init__(self, client, name):
        self._change = client.create_client(ChangeState, f'{name}/change_state')
        self._get = client.create_client(GetState, f'{name}/get_state')
        self._set = client.create_client(SetParameters, f'{name}/set_parameters')
        for each in (self._change, self._get, self._set):
            assert each.wait_for_service(60)

    def now(self):
        """Return the id of the state."""
        return call(self._get, GetState.Request(), 30).current_state.id

    def to(self, transition):
        """Ask for a transition, by name or id, and tell whether it was done."""
        if isinstance(transition, str):
            transition = getattr(Transition, f'TRANSITION_{transition.upper()}')
        request = ChangeState.Request(transition=Transition(id=transition))
        return call(self._change, request, 60).success

    def set(self, name, value):
        """Set a parameter; return why it was not set, '' if it was."""
        message = ParameterMessage(
            name=name, value=Parameter(name, value=str(value)).get_parameter_value())
        result, = call(self._set, SetParameters.Request(parameters=[message]), 60).results
        assert result.successful == (not result.reason)
        return result.reason


def page_address(process):
    """Return where the page of an explorer_node is."""
    return re.search(r'ready: open (http://\S+)', process.wait_for('ready').text)[1]
