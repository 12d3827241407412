# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Nodes under attack, and a client of them."""

from contextlib import contextmanager, suppress
from pathlib import Path
import signal
import time

from driven import Arm, goal_fields, MOVING_S, predict_fields, World
from processes import Newest, NodeProcess, until
from sensor_msgs.msg import JointState
from tap_ros.base.errors import TapError
from tap_ros.ros.client import Client, PLANNER, READY
from tap_ros.ros.heartbeat import publishers_present
from tap_ros.ros.subscriptions import publishers_of
from tap_ros.ros.topics import STREAM

CALL_S = 20.0
SIM_MODES = {name: {'lock_step': waits, 'image_size': 64}
             for name, waits in (('lock-step', True), ('real', False))}


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
        self.arm = Arm(self.node)

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

        :param names: names of NODE_CLASSES without sim_node.
        :param sim: 'lock-step', 'real' or None for no simulator.
        :param parameters: {node: its parameters}, beside those that it always gets.
        """
        wanted = {name: {} for name in names}
        if 'recorder_node' in wanted:
            wanted['recorder_node'] = {'folder': self.folder / 'bag'}
        if sim is not None:
            wanted['sim_node'] = SIM_MODES[sim]
        wanted = {name: own | (parameters or {}).get(name, {}) for name, own in wanted.items()}
        for name, process in list(self.processes.items()):
            if name not in wanted or process.parameters != wanted[name] or not process.alive:
                self.remove(name)
        if self._reaching is not None and PLANNER in self.processes:
            with suppress(TapError):  # it may have ended
                self.finish(self._reaching)
            time.sleep(1.0)
        new = [self.start(name, **parameters) for name, parameters in wanted.items()
               if name not in self.processes]
        for process in new:
            process.wait_for('ready')
        if new:
            for name in wanted.keys() & {*READY, PLANNER}:
                self.client.wait_until_ready(name, timeout_s=CALL_S)
            if 'predictor_node' in wanted:
                self.expect_prediction(CALL_S)
            time.sleep(0.5)  # what has no name to wait for: its subscriptions
        self._reaching, self.arm.refusing = None, False
        self.arm.forget()

    def start(self, name, **parameters):
        """Start a node without waiting; return the NodeProcess."""
        self.processes[name] = NodeProcess(name, self.folder / f'{name}.log', parameters)
        return self.processes[name]

    def restart(self, name):
        """Start a killed node again, and wait until it is ready and known."""
        before = self._there(name)
        self.processes[name].start().wait_for('ready')
        assert until(lambda: self._there(name) - before and self.client.is_ready(name), 20.0)

    def presence(self, name):
        """Return the Presence of a node."""
        return publishers_present(self.node, f'{name}/heartbeat')

    def _there(self, name):
        return set(*publishers_of(self.node, f'{name}/heartbeat').values())

    def remove(self, name):
        """End a node, politely first."""
        self.processes.pop(name).end(signal.SIGINT, 10.0)

    def check(self):
        """Raise AssertionError when a node has ended."""
        for process in self.processes.values():
            process.check()

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

    def begin_moving(self, **fields):
        """Send a goal, and wait until the arm moves; once more on a machine too busy for it."""
        for _ in range(2):
            begin = time.monotonic()
            reaching = self.begin(**fields)
            if until(lambda begin=begin: self.arm.moves(begin), MOVING_S):
                return reaching
            end = self.finish(reaching)
        raise TapError(f'nothing moved within {MOVING_S:g} s; the goal {end}')

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
