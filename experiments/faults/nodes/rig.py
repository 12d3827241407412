# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""All nodes as processes, and a client that attacks them; started when a fault needs them."""

from contextlib import contextmanager
from pathlib import Path
import shutil
import tempfile
import time

from action_msgs.msg import GoalStatus
from experiments.faults.nodes.arm_log import Commands
from experiments.faults.nodes.attacked import Attacked
from experiments.faults.nodes.world import goal_fields, predict_fields, World
from rclpy.action import ActionClient
from rclpy.context import Context
from rclpy.node import Node
from sensor_msgs.msg import Image, JointState
from std_srvs.srv import SetBool
from tap_msgs.action import ReachGoal
from tap_msgs.srv import PredictSubgoal, ResetScene
from tap_ros.contract import NODE_MODULES
from tap_ros.errors import TapError
from tap_ros.nodes.clients import call, cancel_goal, Newest, send_goal, Spinner, wait_for_result
from tap_ros.nodes.heartbeat import Liveness
from tap_ros.nodes.topics import LATCHED, STREAM

CALL_S = 20.0
SIM_MODES = {'lock-step': {'lock_step': True}, 'real': {'lock_step': False}}
ENDS = {GoalStatus.STATUS_SUCCEEDED: 'succeeded', GoalStatus.STATUS_ABORTED: 'aborted',
        GoalStatus.STATUS_CANCELED: 'cancelled'}


class Rig:
    """
    The nodes under attack, and a client of them.

    :param folder: of the logs; by default a new one, kept for whoever wants to know more.
    """

    def __init__(self, folder=None):
        self.folder = Path(folder or tempfile.mkdtemp(prefix='faults-logs-'))
        self.processes = {}
        self._client = None

    def __enter__(self):
        return self

    def __exit__(self, *_):
        for name in list(self.processes):
            self.remove(name)
        for bag in self.folder.glob('bag*'):
            shutil.rmtree(bag)
        if self._client is not None:
            self._spinner.__exit__()
            self._client.destroy_node()
            self._context.try_shutdown()

    @property
    def node(self):
        """The client's own node, spun in the background."""
        if self._client is None:
            self._context = Context()
            self._context.init()
            self._client = Node('attacker', context=self._context)
            self._connect(self._client)
            self._spinner = Spinner(self._client)
            self._spinner.__enter__()
        return self._client

    def _connect(self, node):
        self.reset_client = node.create_client(ResetScene, 'sim/reset')
        self.record_client = node.create_client(SetBool, 'recorder/record')
        self.predict_client = node.create_client(PredictSubgoal, 'predict_subgoal')
        self.reach_client = ActionClient(node, ReachGoal, 'reach_goal')
        self.image = Newest(node, Image, 'camera/image_raw', STREAM)
        self.joints = Newest(node, JointState, 'joint_states', STREAM)
        self.goal_image = Newest(node, Image, 'goal/image', LATCHED)
        self.commands = Commands(node)
        self.alive = {name: Liveness(node, name) for name in NODE_MODULES}

    # Nodes

    def need(self, *names, sim=None, parameters=None):
        """
        Have these nodes running and ready, and no others.

        :param names: names of NODE_MODULES without sim_node.
        :param sim: 'lock-step', 'real' or None for no simulator.
        :param parameters: {node: its parameters}, beside those that it always gets.
        """
        assert self.node
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
            attacked.wait_until_ready()
        if new:
            self._wait_until_connected(wanted)
        self.commands.forget()

    def start(self, name, arguments=(), **parameters):
        """Start a node without waiting; return the Attacked."""
        assert self.node
        self.processes[name] = Attacked(
            name, self.folder / f'{name}.log', parameters, arguments).start()
        return self.processes[name]

    def remove(self, name):
        """End a node, politely first."""
        attacked = self.processes.pop(name)
        if attacked.alive:
            attacked.end()

    def check(self):
        """Raise TapError when a node has ended."""
        for name, attacked in self.processes.items():
            if not attacked.alive:
                raise TapError(f'{name} ended with code {attacked.process.returncode}: '
                               f'{attacked.last_line()}')

    def _wait_until_connected(self, names):
        offered = {'sim_node': self.reset_client.wait_for_service,
                   'predictor_node': self.predict_client.wait_for_service,
                   'visual_mpc_node': self.reach_client.wait_for_server,
                   'recorder_node': self.record_client.wait_for_service}
        for name in names:
            if name in offered and not offered[name](timeout_sec=CALL_S):
                raise TapError(f'{name}: what it offers was not found in {CALL_S:g} s')
        if 'predictor_node' in names:
            self.expect_prediction(CALL_S)
        time.sleep(0.5)  # what has no name to wait for: its subscriptions

    @contextmanager
    def world(self, rate_hz=10.0):
        """Have a World that the planner has heard of."""
        with World(self.node, rate_hz) as world:
            time.sleep(1.0)
            yield world

    # Calls

    def predict(self, timeout_s=CALL_S, **fields):
        """Call predict_subgoal; return the response."""
        return call(self.predict_client, PredictSubgoal.Request(**fields), timeout_s,
                    server=self.alive['predictor_node'])

    def expect_prediction(self, timeout_s):
        """Make a good call; raise TapError when it is not answered well."""
        response = self.predict(timeout_s, **predict_fields())
        if not response.success:
            raise TapError(f'a good request was refused: {response.message}')
        return response

    def reset(self, seed, task='push2'):
        """Start a scene; return the response."""
        return call(self.reset_client, ResetScene.Request(task=task, seed=seed), CALL_S,
                    server=self.alive['sim_node'])

    def begin(self, timeout_s=CALL_S, on_feedback=None, **fields):
        """Send a goal; return its handle."""
        return send_goal(self.reach_client, ReachGoal.Goal(**fields), timeout_s, on_feedback,
                         self.alive['visual_mpc_node'])

    def begin_moving(self, moves=2, **fields):
        """Send a goal that a World never fulfils; return its handle once the arm moves."""
        begin = time.monotonic()
        handle = self.begin(**(goal_fields() | fields))
        if not self.commands.wait_for_moves(begin, moves, CALL_S):
            end = self.finish(handle)
            raise TapError(f'nothing moved within {CALL_S:g} s; the goal {end}')
        return handle

    def finish(self, handle, timeout_s=CALL_S):
        """Cancel a goal, and return its end in words."""
        cancel_goal(handle)
        return self.result(handle, timeout_s)

    def result(self, handle, timeout_s=60.0):
        """Wait for the end of a goal; return it in words, the message behind a colon."""
        status, result = wait_for_result(handle, timeout_s, self.alive['visual_mpc_node'])
        return f'{ENDS.get(status, status)}: {result.message}'


def outcome(function, *args, **options):
    """Return the value of a call and '', or None and what it raised as a TapError."""
    try:
        return function(*args, **options), ''
    except TapError as error:
        return None, str(error)
