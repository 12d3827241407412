# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What nodes say when nothing comes, when little of it is new, and of parameters nobody knows."""

from processes import Client, LocalNode, until
import pytest
from rclpy.node import Node
from rclpy.parameter import Parameter
from sensor_msgs.msg import CompressedImage, Image, JointState
from std_msgs.msg import String
from std_srvs.srv import SetBool
from tap_msgs.msg import ObjectStates
from tap_ros.nodes import diagnostics
from tap_ros.nodes.calls import call
from tap_ros.nodes.recorder.node import RecorderNode
from tap_ros.nodes.run import warn_of_unknown_parameters
from tap_ros.nodes.subscriptions import why_silent
from tap_ros.nodes.topics import STREAM


def test_what_is_published_instead_and_the_remedy_are_named():
    for kind, published, words in (
            (Image, {}, ['no node publishes it']),
            (Image, {'/eye/image_raw/compressed': CompressedImage},
             ['/eye/image_raw/compressed is', '-p image_transport:=compressed']),
            (CompressedImage, {'/eye/image_raw': Image}, ['/eye/image_raw is', 'transport:=raw']),
            (Image, {'/eye/image_raw': CompressedImage},
             ['published there is sensor_msgs/msg/CompressedImage', 'sensor_msgs/msg/Image']),
            (Image, {'/eye/image_raw': String}, ['std_msgs/msg/String']),
            (Image, {'/front/color': Image, '/goal/image': Image},
             ['published are /front/color:', '-r /eye/image_raw:=/front/color']),
            (JointState, {'/left/joint_states': JointState, '/right/joint_states': JointState},
             ['/left/joint_states, /right/joint_states', ':=/left/joint_states']),
            (ObjectStates, {'/eye/image_ra': String}, ['/eye/image_ra']),
            (None, {'/eye/image_ra': String}, ['/eye/image_ra']),
            (Image, {'/eye/image_raw': Image}, [])):
        topic = '/joint_states' if kind is JointState else (
            '/eye/image_raw' + '/compressed' * (kind is CompressedImage))
        with Client('camera') as camera, Client('looking') as node:
            for name, other in published.items():
                camera.create_publisher(other, name, STREAM)

            def fits(topic=topic, kind=kind, words=words, node=node):
                why = why_silent(node, topic, kind)
                return all(word in why for word in words) and bool(words) == bool(why)

            assert until(fits, 10), (published, why_silent(node, topic, kind))
            assert '/goal/image' not in why_silent(node, topic, kind)


@pytest.fixture
def hurried(monkeypatch):
    """Call inputs silent sooner."""
    monkeypatch.setattr(diagnostics, 'SILENT_SECONDS', 1.0)


def test_a_recorder_that_hears_nothing_says_so_and_does_not_succeed(
        client, hurried, tmp_path, capfd):
    pictures = client.create_publisher(CompressedImage, 'camera/image_raw/compressed', STREAM)
    node = LocalNode(RecorderNode, folder=tmp_path / 'bag',
                     topics=['camera/image_raw', 'wrist/joints'])
    said = []

    def warned(*words):
        said.append(capfd.readouterr().err)
        return any(all(word in line for word in ('WARN', *words))
                   for line in ''.join(said).splitlines())

    assert until(lambda: warned('/camera/image_raw', 'image_transport:=compressed'))
    assert warned('/wrist/joints', 'no node publishes it')
    service = client.create_client(SetBool, 'recorder/record')
    assert service.wait_for_service(20)
    answer = call(service, SetBool.Request(data=False), 20)
    assert not answer.success and 'nothing was recorded' in answer.message
    assert node.end() == 1

    node = LocalNode(RecorderNode, folder=tmp_path / 'bag', topics=['camera/image_raw'],
                     image_transport='compressed')
    try:
        assert until(pictures.get_subscription_count)
        timer = client.create_timer(0.1, lambda: pictures.publish(CompressedImage()))
        assert until(lambda: node.node._bags.count > 10)
        said.clear()
        timer.cancel()
        assert until(lambda: warned('/camera/image_raw/compressed', 'though it is published'))
    finally:
        assert node.end() == 0


def test_parameters_that_a_node_does_not_have_are_named(client, capfd):
    with Client('careful', parameter_overrides=[
            Parameter('max_step_yx', value=0.01), Parameter('max_step_xy', value=0.02),
            Parameter('nonsense', value='x')]) as node:
        node.declare_parameter('max_step_xy', 0.08)
        warn_of_unknown_parameters(node)
    text = capfd.readouterr().err
    assert 'max_step_yx is unknown' in text and 'did you mean max_step_xy?' in text
    assert 'nonsense is unknown' in text and 'parameter max_step_xy is' not in text
    assert isinstance(node, Node)
