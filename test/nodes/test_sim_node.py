# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What the simulator's topics and services promise."""

import time

from geometry_msgs.msg import Twist, TwistStamped, Vector3
from made_bags import decode_gripper
import numpy as np
from processes import Client, Newest, NodeProcess, until
import pytest
from rclpy.duration import Duration
from rclpy.qos import QoSProfile
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import CameraInfo, Image, JointState
from sim_bridge.simulator import Simulator
from std_msgs.msg import Float64
from std_srvs.srv import SetBool
from tap_msgs.msg import CommandRefused, Episode, ObjectStates
from tap_msgs.srv import StepScene
import tap_ros
from tap_ros.base.contract import CONTROL_PERIOD
from tap_ros.messages.images import decode_image
from tap_ros.messages.stamps import to_nanoseconds
from tap_ros.ros.calls import CallError
from tap_ros.ros.topics import LATCHED, STREAM, to_stamp

PERIOD_NS = 250_000_000


class Rig:
    """A simulator process and everything it talks about."""

    def __init__(self, node, process):
        self.node, self.process = node, process
        self.image = Newest(node, Image, 'camera/image_raw', STREAM)
        self.info = Newest(node, CameraInfo, 'camera/camera_info', STREAM)
        self.objects = Newest(node, ObjectStates, 'objects', STREAM)
        self.joints = Newest(node, JointState, 'joint_states', STREAM)
        self.clock = Newest(node, Clock, 'clock', STREAM)
        self.refusals = Newest(node, CommandRefused, 'arm/refused', STREAM)
        self.marks = []
        node.create_subscription(Episode, 'episode', self.marks.append, STREAM)
        self.twist = node.create_publisher(TwistStamped, 'arm/delta_twist_cmds', STREAM)
        self.goal_image = Newest(node, Image, 'goal/image', LATCHED)
        self.goal_mask = Newest(node, Image, 'goal/robot_mask', LATCHED)
        self.goal_objects = Newest(node, ObjectStates, 'goal/objects', LATCHED)
        self.client = tap_ros.Client(node=node)

    def reset(self, **request):
        """Reset, and wait until all that is published then has come."""
        count = len(self.marks)
        before = to_nanoseconds(self.image.wait(20).header.stamp)
        self.client.call('reset', **request)
        image = self.image.wait(10, lambda m: to_nanoseconds(m.header.stamp) > before)
        for topic in (self.info, self.objects, self.joints):
            topic.wait(10, lambda m: m.header.stamp == image.header.stamp)
        assert until(lambda: len(self.marks) >= count + 2)

    def refused(self, words, service, **fields):
        """Check that a call is refused for this reason."""
        with pytest.raises(CallError, match=words):
            self.client.call(service, **fields)

    def goal(self, stamp):
        """Return the goal of a stamp: picture, mask and objects, once they have come."""
        return [topic.wait(10, lambda m: m.header.stamp == stamp)
                for topic in (self.goal_image, self.goal_mask, self.goal_objects)]

    def step(self, periods):
        """Let control periods pass; return the stamp then, in ns."""
        return to_nanoseconds(self.client.call('step', num_periods=periods).stamp)

    def send(self, x=0.0, y=0.0, z=0.0, stamp=None):
        """Send a command that moves so many metres."""
        message = TwistStamped()
        if stamp is not None:
            message.header.stamp = stamp
        message.twist.linear = Vector3(
            x=x / CONTROL_PERIOD, y=y / CONTROL_PERIOD, z=z / CONTROL_PERIOD)
        self.twist.publish(message)

    def act(self, **move):
        """Answer the newest image and wait for the next."""
        stamp = self.image.wait(10).header.stamp
        self.send(stamp=stamp, **move)
        return self.image.wait(
            10, lambda message: to_nanoseconds(message.header.stamp)
            == to_nanoseconds(stamp) + PERIOD_NS)


@pytest.fixture(scope='module')
def rig(tmp_path_factory):
    process = NodeProcess('sim_node', tmp_path_factory.mktemp('sim') / 'log.txt',
                          {'lock_step': 'true', 'seed': 3})
    try:
        with Client() as node:
            rig = Rig(node, process.wait_for('ready'))
            rig.reset(seed=3)
            yield rig
    finally:
        process.end()


def test_everything_about_one_moment_has_the_same_stamp(rig):
    before = len(rig.marks)
    rig.reset(task='push2', seed=5)
    image = rig.image.wait(10)
    for topic in (rig.info, rig.objects, rig.joints):
        assert topic.wait(10).header.stamp == image.header.stamp
    assert rig.clock.wait(10).clock == image.header.stamp
    assert decode_image(image, 'image', (256, 256)).std() > 5
    assert rig.objects.wait(1).source == ObjectStates.SOURCE_GROUND_TRUTH
    end, start = rig.marks[before:]
    assert (end.event, start.event) == (Episode.END, Episode.START)
    assert (start.task, start.seed, start.header.stamp) == ('push2', 5, image.header.stamp)
    assert end.outcome in ('success', 'failure', 'interrupted')
    stamp = rig.act(x=0.01).header.stamp  # who comes late gets the goal and the newest moment
    with Client('late') as node:
        for kind, topic in ((Image, 'camera/image_raw'), (ObjectStates, 'objects'),
                            (JointState, 'joint_states'), (CameraInfo, 'camera/camera_info')):
            assert Newest(node, kind, topic, STREAM).wait(20).header.stamp == stamp
        for kind, topic in ((Image, 'goal/image'), (ObjectStates, 'goal/objects')):
            assert Newest(node, kind, topic, LATCHED).wait(10).header.stamp == start.header.stamp


def test_a_command_is_a_velocity_that_lasts_for_a_control_period(rig):
    assert Newest(rig.node, Float64, 'arm/control_period', LATCHED).wait(10).data == CONTROL_PERIOD
    rig.reset(seed=5)
    sim = Simulator('push2')
    sim.reset(5)
    for command, way in ((Vector3(x=0.2, y=-0.1, z=0.3), [0.05, -0.025, 0.075]),
                         (Vector3(x=-1e300, y=3.0), [-0.08, 0.08, 0])):  # m/s, m
        before = rig.image.wait(10).header
        rig.twist.publish(TwistStamped(header=before, twist=Twist(linear=command)))
        stamp = to_stamp(to_nanoseconds(before.stamp) + PERIOD_NS)
        then = rig.joints.wait(10, lambda m, stamp=stamp: m.header.stamp == stamp)
        assert np.array_equal(decode_gripper(then), sim.step(np.append(way, 0)).gripper)
    rig.process.wait_for('m/s')
    sim.close()


def test_a_goal_that_is_moved_is_published_as_that_of_a_reset(rig):
    rig.reset(seed=5, hide_arm=True)
    stamp = rig.image.wait(10).header.stamp
    *_, before = rig.goal(stamp)
    marks, taken = len(rig.marks), [to_nanoseconds(stamp)]
    sim = Simulator('push2')
    sim.reset(5)
    for pixel in ((201.5, 81.5), (59.5, 178.5)):  # at the same moment, and yet told apart
        rig.client.set_goal({'object_1': pixel})
        image = rig.goal_image.wait(10, lambda m: to_nanoseconds(m.header.stamp) > taken[-1])
        taken.append(to_nanoseconds(image.header.stamp))
        image, mask, objects = rig.goal(image.header.stamp)
        kept, moved = objects.objects
        assert (kept, moved.name) == (before.objects[0], 'object_1')
        assert (moved.u, moved.v) == pytest.approx(pixel, abs=1e-4)
        sim.set_goal([[o.pose.position.x, o.pose.position.y] for o in objects.objects])
        goal = sim.goal(hide_arm=True)
        assert bytes(image.data) == goal.image.tobytes()
        assert bytes(mask.data) == goal.robot_mask.tobytes()
    # No time has passed, and what follows does so as without it.
    assert rig.step(1) == to_nanoseconds(stamp) + PERIOD_NS
    picture = rig.image.wait(
        10, lambda m: to_nanoseconds(m.header.stamp) > to_nanoseconds(stamp))
    sim.step(np.zeros(4))
    assert bytes(picture.data) == sim.observe(hide_arm=True).image.tobytes()
    sim.close()
    assert len(rig.marks) == marks


def test_a_goal_that_cannot_be_is_refused_and_the_old_one_stays(rig):
    rig.reset(seed=5)
    *_, goal = rig.goal(rig.image.wait(10).header.stamp)
    second, count = goal.objects[1], rig.goal_image.count
    for pixels, words in (({'object_1': (256, 120)}, 'object_1.*256.*255.5'),
                          ({'object_1': (253, 41)}, 'object_1.* out of reach.* 35 cm')):
        with pytest.raises(CallError, match=words):
            rig.client.set_goal(pixels)
    # Poses do not count: it stays where its pixel is.
    second.pose.position.x = float('nan')
    rig.client.call('set_goal', objects=ObjectStates(objects=[second]))
    rig.goal_image.wait(10, lambda m: m.header.stamp != goal.header.stamp)
    assert rig.goal_image.count == count + 1, 'nothing was published for what was refused'
    rig.reset(task='push3', seed=1)
    rig.objects.wait(10, lambda m: len(m.objects) == 3)


def test_what_answers_no_picture_lets_no_time_pass(rig):
    rig.reset(seed=5)
    first = to_nanoseconds(rig.image.wait(10).header.stamp)
    second = rig.act(x=0.01).header.stamp
    rig.send()  # a stop
    rig.send(y=float('nan'), stamp=second)
    rig.process.wait_for('twist.linear.y is nan')
    for ns in (first, first - PERIOD_NS, first + 5 * PERIOD_NS):
        rig.send(x=0.05, stamp=to_stamp(ns))
    for ns in (first, first - PERIOD_NS):
        rig.process.wait_for(f'{ns} ns was answered before')
    rig.process.wait_for('newer than the newest image')
    rig.refused('juggle.*push2', 'reset', task='juggle')
    rig.refused('101; expected 1 to 100', 'step', num_periods=101)
    assert rig.step(1) == to_nanoseconds(second) + PERIOD_NS


def test_a_paused_simulation_takes_no_commands_but_steps(rig):
    rig.reset(seed=5)
    first = rig.image.wait(10)
    rig.client.pause()
    rig.send(x=0.05, stamp=first.header.stamp)
    rig.process.wait_for('the simulation is paused')
    refused = rig.refusals.wait(10, lambda m: m.header.stamp == first.header.stamp)
    assert 'paused' in refused.message
    after = rig.step(1)
    assert after == to_nanoseconds(first.header.stamp) + PERIOD_NS
    # The command comes while one of several requests is carried out, and time passes after all.
    published = {}  # stamp -> when the simulator sent its picture
    rig.node.create_subscription(
        Image, 'camera/image_raw', lambda message, info: published.update(
            {to_nanoseconds(message.header.stamp): info['source_timestamp']}), STREAM)
    step = rig.node.create_client(StepScene, 'sim/step')
    play = rig.node.create_client(SetBool, 'sim/pause')
    assert step.wait_for_service(10) and play.wait_for_service(10)
    waiting = [step.call_async(StepScene.Request(num_periods=100))]
    rig.image.wait(30, lambda m: to_nanoseconds(m.header.stamp) > after + PERIOD_NS)
    waiting += [*(step.call_async(StepScene.Request(num_periods=100)) for _ in range(3)),
                play.call_async(SetBool.Request(data=False))]
    newest = rig.image.wait(
        30, lambda m: to_nanoseconds(m.header.stamp) > after + 105 * PERIOD_NS)
    rig.send(x=0.08, stamp=newest.header.stamp)
    assert rig.twist.wait_for_all_acked(Duration(seconds=60))
    came = time.time_ns()  # at the latest
    assert all(until(future.done, 60) for future in waiting)
    rig.image.wait(10, lambda m: to_nanoseconds(m.header.stamp) >= after + 400 * PERIOD_NS)
    # Playing is not sooner than the end of the second request; a busy machine may be later.
    if came < published.get(after + 200 * PERIOD_NS, 0):
        assert 'paused' in rig.refusals.wait(
            20, lambda m: m.header.stamp == newest.header.stamp).message
    rig.act(x=0.01)


def test_in_real_time_the_clock_runs_unless_paused_and_old_commands_move_nothing(tmp_path):
    process = NodeProcess('sim_node', tmp_path / 'log.txt', {}, ['-r __ns:=/second'])
    try:
        with Client() as node:
            process.wait_for('ready')
            images = Newest(node, Image, '/second/camera/image_raw', STREAM)
            joints = Newest(node, JointState, '/second/joint_states', STREAM)
            twists = node.create_publisher(TwistStamped, '/second/arm/delta_twist_cmds', STREAM)
            timeouts = node.create_publisher(Float64, '/second/arm/command_timeout', LATCHED)

            def later(topic, message, periods):
                return topic.wait(20, lambda m: to_nanoseconds(m.header.stamp)
                                  >= to_nanoseconds(message.header.stamp) + periods * PERIOD_NS)

            images.wait(20)
            for timeout in (0.001, 5.0):  # s
                timeouts.publish(Float64(data=timeout))
                later(images, images.wait(20), 2)  # so the node has the time-out first
                before = joints.wait(10)
                command = TwistStamped(header=images.wait(1).header)
                command.twist.linear.x = 0.2 if before.position[0] < 0 else -0.2
                twists.publish(command)
                begin = before.position[0]
                if timeout < 1:
                    assert abs(later(joints, before, 4).position[0] - begin) < 0.002
            joints.wait(20, lambda m: abs(m.position[0] - begin) > 0.03)
            with tap_ros.Client('/second') as client:
                with pytest.raises(CallError, match='sim/pause'):
                    client.call('step')
                client.pause()
                first, then = (to_nanoseconds(client.call('step', num_periods=periods).stamp)
                               for periods in (3, 1))
            assert then == first + PERIOD_NS
            assert process.end() == 0, process.text
            assert 'Traceback' not in process.text
    finally:
        process.end()


def test_tf_has_the_camera_and_the_arm(rig):
    TFMessage = pytest.importorskip('tf2_msgs.msg').TFMessage
    moving = Newest(rig.node, TFMessage, '/tf', QoSProfile(depth=100))
    fixed = Newest(rig.node, TFMessage, '/tf_static', LATCHED).wait(10).transforms
    assert {(one.header.frame_id, one.child_frame_id) for one in fixed} == {
        ('world', 'camera_optical_frame'), ('world', 'base'), ('wrist_3_link', 'gripper_tip')}
    rig.reset(seed=5)
    image = rig.act(x=0.01)
    assert image.header.frame_id == 'camera_optical_frame'
    arm = moving.wait(10, lambda m: m.transforms[0].header.stamp == image.header.stamp)
    assert len(arm.transforms) == 6
