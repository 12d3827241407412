# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Nodes under attack as processes, a client of them, and what the arm would have been told."""

from contextlib import contextmanager, suppress
from dataclasses import dataclass
import os
from pathlib import Path
import signal
import subprocess
import sys
import threading
import time

from fault_files import end_group
from fault_world import goal_fields, predict_fields, World
from geometry_msgs.msg import TwistStamped
from sensor_msgs.msg import JointState
from tap_ros.contract import NODE_MODULES
from tap_ros.errors import TapError
from tap_ros.nodes.client import Client, PLANNER, READY
from tap_ros.nodes.clients import Newest
from tap_ros.nodes.heartbeat import Liveness
from tap_ros.nodes.topics import STREAM

CALL_S = 20.0
START_S = 90.0
MOVING_S = 60.0  # a plan takes seconds where other programs run
STOP_S = 0.5
SIM_MODES = {'lock-step': {'lock_step': True}, 'real': {'lock_step': False}}


def _hear_signals():
    """Take back what nohup and background jobs of a shell ignore."""
    for number in (signal.SIGINT, signal.SIGHUP):
        signal.signal(number, signal.SIG_DFL)


class Attacked:
    """
    One node in a process group of its own, that is killed, stopped and started again.

    :param name: a name of NODE_MODULES.
    :param log: file for what it prints; a new start adds to it.
    :param parameters: {name: value} of its ROS parameters.
    :param arguments: more arguments after --ros-args.
    """

    def __init__(self, name, log, parameters=None, arguments=()):
        self.name, self.log = name, Path(log)
        self.parameters, self._arguments = dict(parameters or {}), tuple(arguments)
        self._from = 0  # where the log of the present process begins
        self.process = None

    def start(self):
        """Start it, without waiting."""
        command = [sys.executable, '-m', NODE_MODULES[self.name], '--ros-args', *self._arguments]
        for key, value in self.parameters.items():
            text = str(value).lower() if isinstance(value, bool) else str(value)
            command += ['-p', f'{key}:={text}']
        self._from = self.log.stat().st_size if self.log.exists() else 0
        with self.log.open('ab') as log:
            self.process = subprocess.Popen(
                command, stdout=log, stderr=subprocess.STDOUT, stdin=subprocess.DEVNULL,
                start_new_session=True, preexec_fn=_hear_signals)
        return self

    @property
    def alive(self):
        """Whether it runs."""
        return self.process is not None and self.process.poll() is None

    @property
    def text(self):
        """What the present process has printed."""
        with self.log.open('rb') as log:
            log.seek(self._from)
            return log.read().decode(errors='replace')

    def wait_for(self, words, timeout_s=START_S):
        """Wait until it prints something; raise TapError when it does not."""
        deadline = time.monotonic() + timeout_s
        while words not in self.text:
            self.check()
            if time.monotonic() > deadline:
                raise TapError(f'{self.name} did not print {words!r} in {timeout_s:g} s: '
                               f'{self.last_line()}')
            time.sleep(0.02)
        return self

    def check(self):
        """Raise TapError when it has ended."""
        if not self.alive:
            raise TapError(f'{self.name} ended with code {self.process.returncode}: '
                           f'{self.last_line()}')

    def last_line(self):
        """Return the last line that it printed."""
        return (self.text.strip().splitlines() or ['it printed nothing'])[-1]

    def send(self, number):
        """Send a signal, if it runs."""
        if self.alive:
            self.process.send_signal(number)

    def kill(self):
        """Kill it, as the kernel does when memory is short; return the moment."""
        moment = time.monotonic()
        if self.process is not None:
            end_group(self.process)
        return moment

    def end(self, number=signal.SIGINT, timeout_s=10.0):
        """End it politely; return its exit code, None when it had to be killed after a time."""
        self.send(number)
        try:
            return self.process.wait(timeout_s)
        except subprocess.TimeoutExpired:
            self.kill()
            return None

    def memory_mb(self):
        """Return the memory that it holds (resident set), in MB."""
        pages = Path(f'/proc/{self.process.pid}/statm').read_text().split()[1]
        return int(pages) * os.sysconf('SC_PAGE_SIZE') / 1e6


@dataclass(frozen=True)
class Command:
    """A twist command that came; metres."""

    at: float  # time.monotonic() of its arrival
    move: tuple

    @property
    def is_stop(self):
        """Whether it says to stand still."""
        return not any(self.move)


class Commands:
    """
    Keep every twist command, as a driver of the arm would get it.

    :param node: rclpy Node that another thread spins.
    """

    def __init__(self, node):
        self._kept, self._changed = [], threading.Condition()
        node.create_subscription(TwistStamped, 'arm/delta_twist_cmds', self._put, STREAM)

    def moves(self, moment):
        """Return the commands after a moment of time.monotonic() that are no stops."""
        with self._changed:
            return [one for one in self._kept if one.at > moment and not one.is_stop]

    def forget(self):
        """Drop all."""
        with self._changed:
            self._kept.clear()

    def wait_for_moves(self, moment, count, timeout_s=MOVING_S):
        """Wait until so many moves have come after a moment; tell whether they have."""
        with self._changed:
            return self._changed.wait_for(
                lambda: sum(c.at > moment and not c.is_stop for c in self._kept) >= count,
                timeout_s)

    def seconds_to_stop(self, moment):
        """
        Return the seconds from a moment to the stop after which nothing moved; inf without one.

        A stop that was sent before counts as 0 s where no move came after the moment.
        """
        with self._changed:
            kept = list(self._kept)
        moves = [index for index, command in enumerate(kept) if not command.is_stop]
        rest = kept[moves[-1] + 1 if moves else 0:]
        return max(0.0, rest[0].at - moment) if rest else float('inf')

    def assert_stopped(self, moment, limit_s=STOP_S):
        """Raise AssertionError unless a stop came within a limit, and no move after that."""
        late = [command.at - moment for command in self.moves(moment + limit_s)]
        assert not late, f'a move was sent after {max(late):.1f} s'
        seconds = self.seconds_to_stop(moment)
        assert seconds <= limit_s, f'the stop came after {seconds:.2f} s'
        return seconds

    def _put(self, message):
        linear = message.twist.linear
        with self._changed:
            self._kept.append(Command(time.monotonic(), (linear.x, linear.y, linear.z)))
            self._changed.notify_all()


class Rig:
    """
    The nodes under attack, started when a fault needs them, and a client of them.

    :param folder: of the logs.
    """

    def __init__(self, folder):
        self.folder, self.processes = Path(folder), {}
        self.client = Client(timeout_s=CALL_S)
        self.node = self.client.node
        self._reaching = None
        self.joints = Newest(self.node, JointState, 'joint_states', STREAM)
        self.commands = Commands(self.node)
        self.alive = {name: Liveness(self.node, name) for name in NODE_MODULES}

    def __enter__(self):
        return self

    def __exit__(self, *_):
        for name in list(self.processes):
            self.remove(name)
        self.client.close()

    # Nodes

    def need(self, *names, sim=None, parameters=None):
        """
        Have these nodes running and ready, no others, and none with a goal.

        :param names: names of NODE_MODULES without sim_node.
        :param sim: 'lock-step', 'real' or None for no simulator.
        :param parameters: {node: its parameters}, beside those that it always gets.
        """
        wanted = {name: {} for name in names}
        if 'recorder_node' in wanted:
            wanted['recorder_node'] = {'folder': self.folder / 'bag'}
        if sim is not None:
            wanted['sim_node'] = SIM_MODES[sim]
        wanted = {name: own | (parameters or {}).get(name, {}) for name, own in wanted.items()}
        for name, attacked in list(self.processes.items()):
            if name not in wanted or attacked.parameters != wanted[name] or not attacked.alive:
                self.remove(name)
        new = [self.start(name, **parameters) for name, parameters in wanted.items()
               if name not in self.processes]
        for attacked in new:
            attacked.wait_for('ready')
        if new:
            for name in wanted.keys() & {*READY, PLANNER}:
                self.client.wait_until_ready(name, timeout_s=CALL_S)
            if 'predictor_node' in wanted:
                self.expect_prediction(CALL_S)
            time.sleep(0.5)  # what has no name to wait for: its subscriptions
        elif self._reaching is not None and 'visual_mpc_node' in wanted:
            with suppress(TapError):  # it may have ended, or looked dead on a busy machine
                self.finish(self._reaching)
            time.sleep(1.0)
        self._reaching = None
        self.commands.forget()

    def start(self, name, arguments=(), **parameters):
        """Start a node without waiting; return the Attacked."""
        self.processes[name] = Attacked(
            name, self.folder / f'{name}.log', parameters, arguments).start()
        return self.processes[name]

    def restart(self, name):
        """Start a killed node again, and wait until it is ready and its heartbeat is heard."""
        self.processes[name].start().wait_for('ready')
        self.alive[name].wait_until_alive(5.0)

    def remove(self, name):
        """End a node, politely first."""
        attacked = self.processes.pop(name)
        if attacked.alive:
            attacked.end()

    def check(self):
        """Raise TapError when a node has ended."""
        for attacked in self.processes.values():
            attacked.check()

    @contextmanager
    def world(self, rate_hz=10.0):
        """Have a World that the planner has heard of."""
        with World(self.node, rate_hz) as world:
            time.sleep(1.0)
            yield world

    # Calls

    def expect_prediction(self, timeout_s):
        """Make a good call; raise TapError when it is not answered well."""
        self.client.call('predict', timeout_s, **predict_fields())

    def reset(self, seed, task='push2'):
        """Start a scene."""
        self.client.call('reset', task=task, seed=seed)

    def begin(self, **fields):
        """Send a goal, by default one that a World never fulfils; return its Reaching."""
        self._reaching = self.client.reach(**{'timeout_s': 90.0, **(fields or goal_fields())})
        return self._reaching

    def begin_moving(self, moves=2, **fields):
        """Send a goal, and wait until the arm moves."""
        begin = time.monotonic()
        reaching = self.begin(**fields)
        if not self.commands.wait_for_moves(begin, moves):
            end = self.finish(reaching)
            raise TapError(f'nothing moved within {MOVING_S:g} s; the goal {end}')
        return reaching

    def finish(self, reaching):
        """Cancel a goal, and return its end in words."""
        reaching.cancel()
        return self.result(reaching)

    def result(self, reaching):
        """Wait for the end of a goal; return it in words, the message behind a colon."""
        result = reaching.result()
        self._reaching = None
        return f'{result.end}: {result.message}'

    def expect_end(self, reaching, words, within='', timeout_s=30.0):
        """Raise AssertionError unless a goal ends in time with these words and those within."""
        begin = time.monotonic()
        end = self.result(reaching)
        assert end.startswith(words) and within in end, f'the goal {end}'
        took = time.monotonic() - begin
        assert took < timeout_s, f'the goal ended after {took:.0f} s'
        return end
