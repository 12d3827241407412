# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""All nodes as processes, over DDS, and how they are compared with one process."""

from contextlib import contextmanager, suppress
from pathlib import Path
import threading

from experiments.planning.episode import run_episode
from experiments.planning.methods import parse_method
from geometry_msgs.msg import TwistStamped
import numpy as np
from processes import Client, Newest, NodeProcess, until
from rclpy.parameter import Parameter
from sensor_msgs.msg import Image
from sim_bridge.simulator import Simulator
from std_msgs.msg import Float64
from tap_msgs.action import ReachGoal
from tap_msgs.msg import ObjectStates, Subgoal
import tap_ros
from tap_ros.base.contract import CONTROL_PERIOD
from tap_ros.messages.stamps import to_nanoseconds
from tap_ros.planning.mpc_config import with_preset
from tap_ros.planning.visual_mpc import VisualMPC
from tap_ros.prediction.predictor import SubgoalPredictor
from tap_ros.ros.calls import CallError
from tap_ros.ros.heartbeat import Liveness
from tap_ros.ros.reaching import Reaching
from tap_ros.ros.topics import LATCHED, STREAM
from tap_ros.weights import FORWARD_MODEL
import torch
import yaml

SEED = 1_000_003
CONFIG = yaml.safe_load((Path(__file__).parents[2] / 'config' / 'tap_ros.yaml').read_text())
USUAL = CONFIG['/**/visual_mpc_node']['ros__parameters'] | {
    'x_min': -0.45, 'x_max': 0.45, 'y_min': -0.45, 'y_max': 0.45}


class Loop:
    """All nodes as processes, and a client that knows their topics, services and actions."""

    def __init__(self, node, folder):
        self.node, self.folder, self.processes = node, folder, {}
        self.client = tap_ros.Client(node=node, timeout_s=60.0)
        self.predictor = Liveness(node, 'predictor_node')
        self.image = Newest(node, Image, 'camera/image_raw', STREAM)
        self.goal_objects = Newest(node, ObjectStates, 'goal/objects', LATCHED)
        self.subgoal = Newest(node, Subgoal, 'subgoal', LATCHED)
        self.overlay = Newest(node, Image, 'subgoal/overlay', LATCHED)
        self.twists, self.distances = [], []
        node.create_subscription(
            TwistStamped, 'arm/delta_twist_cmds', self.twists.append, STREAM)
        node.create_subscription(
            Float64, 'plan/distance', lambda m: self.distances.append(m.data), STREAM)

    def start(self, name, **parameters):
        self.processes[name] = NodeProcess(name, self.folder / f'{name}.log', parameters)

    def reset(self, seed=SEED):
        """Start a scene, and wait until it is seen."""
        self.client.reset('push2', seed)
        self.twists.clear()
        self.distances.clear()

    @contextmanager
    def set(self, **parameters):
        """Change parameters of the planner for a while."""
        def change(values):
            answer = self.client.call('set_planner', parameters=[
                Parameter(name, value=value).to_parameter_msg() for name, value in values.items()])
            assert all(result.successful for result in answer.results), answer

        change(parameters)
        try:
            yield
        finally:
            change({name: USUAL[name] for name in parameters})

    def wait_until_seen(self):
        """
        Wait until the predictor has found the simulator.

        No new image is sent meanwhile; the newest one comes once it is discovered.
        """
        def seen():
            with suppress(CallError):
                return self.client.call('predict').subgoals[0].object_maps

        assert until(seen, pause=0.1)

    def begin(self, on_feedback=None, **fields):
        """Send a goal; return its Reaching."""
        return Reaching(
            self.client.goals, ReachGoal.Goal(**fields), 300, 30, on_feedback)

    def reached(self, on_feedback=None, **fields):
        """Send a goal that is to be pursued to its end; return the result."""
        result = self.begin(on_feedback, **fields).result()
        assert result.end == 'succeeded', result.message
        return result

    def ended(self, reaching, end, words=''):
        """Check that a goal ends so and for this reason, and that the arm then stands."""
        result = reaching.result()
        assert result.end == end and words in result.message, result.message
        assert self.stopped()
        return result

    def begin_moving(self, **fields):
        """Start a scene and a goal; return its Reaching once the arm was moved."""
        self.reset()
        moving = threading.Event()
        reaching = self.begin(lambda feedback: moving.set(), **{'mode': 'direct'} | fields)
        assert moving.wait(120)
        return reaching

    def moves(self):
        """Return the commands (N, 3) so far, m in a control period, without the stops."""
        return CONTROL_PERIOD * np.array([
            [t.twist.linear.x, t.twist.linear.y, t.twist.linear.z]
            for t in list(self.twists) if to_nanoseconds(t.header.stamp)])

    def stopped(self):
        """Tell whether the last command is zero, once it has come."""
        def zero():
            last = self.twists[-1].twist.linear if self.twists else None
            return last and (last.x, last.y, last.z) == (0, 0, 0)

        return until(zero, 5)


@contextmanager
def running_loop(folder):
    """Start all nodes, and kill them in the end."""
    with Client() as node:
        loop = Loop(node, folder)
        try:
            loop.start('recorder_node', folder=folder / 'bag')
            # no larger than networks see them, so that acts_like needs nobody to shrink them
            loop.start('sim_node', lock_step='true', observer='true', image_size=64)
            loop.start('predictor_node')
            loop.start('visual_mpc_node', image_timeout=10.0, preset='quick')
            for process in loop.processes.values():
                process.wait_for('ready', 120)
            assert loop.client.goals.action.wait_for_server(30)
            loop.reset()
            loop.wait_until_seen()
            yield loop
        finally:
            loop.client.close()
            for process in loop.processes.values():
                process.kill()


def acts_like(loop, method, weights, **fields):
    """
    Reach a goal by the nodes and in this process, and compare.

    Where a plan is expected to end shows what it was for, as first actions often do not.

    :return: the PlannedEpisode, what feedback told, and the result.
    """
    feedback = []
    loop.reset()
    result = loop.reached(feedback.append, seed=SEED, **fields)
    sim = Simulator('push2', 64)
    mpc = VisualMPC.load(FORWARD_MODEL, with_preset('quick'))
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    plans, plan = [], mpc.plan
    mpc.plan = lambda *args: plans.append(plan(*args)) or plans[-1]
    try:
        run = run_episode(sim, mpc, parse_method(method), fields['step_budget'], SEED,
                          SubgoalPredictor.load(weights))
    finally:
        torch.set_num_threads(threads)
        sim.close()
    assert np.array_equal(loop.moves().astype(np.float32), run.actions[:, :3])
    made = plans[-len(run.actions):]  # before these come plans to choose by
    assert [f.expected_distance for f in feedback] == [p.expected_distance for p in made]
    return run, feedback, result
