# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What the recorder promises: whole bags, no overwriting, and staying up when the disk fails."""

from pathlib import Path
import time

from mcap.reader import make_reader
import numpy as np
from processes import LocalNode, until
import pytest
from rclpy.duration import Duration
from rclpy.qos import qos_profile_sensor_data, ReliabilityPolicy
from sensor_msgs.msg import Image, JointState
from std_msgs.msg import Float64, String
from std_srvs.srv import SetBool
from tap_ros.nodes.recorder.node import RecorderNode
from tap_ros.recording.messages import decode
from tap_ros.recording.metadata import ArmMount, read_mount
from tap_ros.robots.arm import Mount
from tap_ros.robots.ur10e import UR10E
from tap_ros.ros.calls import call
from tap_ros.ros.topics import encode_image, LATCHED, STREAM, to_stamp


def read(folder):
    """Return [(topic, type, decoded message)] of the only file in a bag, CRCs checked."""
    path, = Path(folder).glob('*.mcap')
    with path.open('rb') as stream:
        reader = make_reader(stream, validate_crcs=True)
        return [(channel.topic, schema.name, decode(schema.name, message.data))
                for schema, channel, message in reader.iter_messages()]


@pytest.fixture
def record(tmp_path):
    """Start a recorder in this process; none is left running."""
    started = []

    def start(**parameters):
        started.append(LocalNode(RecorderNode, **{'folder': tmp_path / 'bag'} | parameters))
        return started[-1]

    yield start
    for node in started:
        if node.running:
            node.end()


def arrived(*publishers):
    """Wait until the recorder has all that was published reliably."""
    for publisher in publishers:
        assert until(publisher.get_subscription_count)
        assert publisher.wait_for_all_acked(Duration(seconds=20))


def ask(client, data, success=True):
    """Begin or end a bag; what has arrived before the end is written first."""
    service = client.create_client(SetBool, 'recorder/record')
    assert service.wait_for_service(20)
    answer = call(service, SetBool.Request(data=data), 20)
    assert answer.success == success, answer.message
    return answer.message


def random_image(stamp):
    rng = np.random.default_rng(stamp)
    return encode_image(rng.integers(0, 256, (32, 32, 3), np.uint8), to_stamp(stamp), 'camera')


def test_messages_come_back_as_they_were_sent(client, record, tmp_path):
    goal = client.create_publisher(Image, 'goal/image', LATCHED)
    goal.publish(random_image(1))  # before the recorder is there
    images = client.create_publisher(Image, 'camera/image_raw', qos_profile_sensor_data)
    gripper = client.create_publisher(Float64, 'gripper/command', STREAM)
    node = record()
    arrived(goal, gripper)
    recorded = node.node._recorded['/camera/image_raw']
    assert until(lambda: recorded.qos.reliability == ReliabilityPolicy.BEST_EFFORT)
    # A best-effort publisher cannot tell when its new subscriber is ready.
    assert until(lambda: images.publish(random_image(2)) or node.node._bags.count > 1, pause=0.1)
    sent = [random_image(stamp) for stamp in range(3, 12)]
    for index, image in enumerate(sent):
        images.publish(image)
        gripper.publish(Float64(data=index / 10))
        time.sleep(0.02)
    arrived(gripper)
    ask(client, False)
    assert node.end() == 0
    found = read(tmp_path / 'bag')
    assert (tmp_path / 'bag' / 'metadata.yaml').is_file()
    pictures = [m.data.tobytes() for topic, _, m in found if topic == '/camera/image_raw']
    assert [picture for picture in pictures if picture != bytes(random_image(2).data)] == [
        bytes(image.data) for image in sent]
    assert [m.data for topic, _, m in found if topic == '/gripper/command'] \
        == [index / 10 for index in range(9)]
    assert [m.data.tobytes() for topic, _, m in found if topic == '/goal/image'] \
        == [bytes(random_image(1).data)]


def test_no_bag_is_overwritten_and_each_has_the_goal_and_the_cards(client, record, tmp_path):
    goal = client.create_publisher(Image, 'goal/image', LATCHED)
    cards = client.create_publisher(String, 'predictor_node/model_card', LATCHED)
    goal.publish(random_image(1))  # before the recorder is there
    cards.publish(String(data='# mine.safetensors'))
    (tmp_path / 'bag').mkdir()
    (tmp_path / 'bag' / 'precious.txt').write_text('mine')
    node = record()
    arrived(goal, cards)
    for stamp in (2, 2):
        assert until(lambda: node.node._bags.count >= 2)
        goal.publish(random_image(stamp))
        arrived(goal)
    assert until(lambda: node.node._bags.count == 4)
    assert 'bag-2' in ask(client, False)
    assert 'bag-3' in ask(client, True)  # with what holds by now
    assert node.end() == 0
    assert [path.name for path in (tmp_path / 'bag').iterdir()] == ['precious.txt']
    assert {topic for topic, _, _ in read(tmp_path / 'bag-3')} == {
        '/arm/control_period', '/goal/image', '/predictor_node/model_card'}
    for name, pictures in (('bag-2', [1, 2]), ('bag-3', [2])):
        found = {}
        for topic, _, message in read(tmp_path / name):
            found.setdefault(topic, []).append(message)
        assert found['/predictor_node/model_card'][0].data == '# mine.safetensors'
        goals = [bytes(message.data) for message in found['/goal/image']]
        assert list(dict.fromkeys(goals)) == [
            bytes(random_image(stamp).data) for stamp in pictures]


def test_the_time_that_the_arm_tells_is_recorded_beside_whatever_is_asked_for(
        client, record, tmp_path):
    joints = client.create_publisher(JointState, 'elsewhere/joints', STREAM)
    period = client.create_publisher(Float64, 'arm/control_period', LATCHED)
    period.publish(Float64(data=0.5))
    node = record(topics=['elsewhere/joints'])
    assert until(joints.get_subscription_count)
    arrived(period)
    joints.publish(JointState(name=['a'], position=[1.5]))
    arrived(joints)
    assert until(lambda: node.node._bags.count == 2)
    assert node.end() == 0
    told = [message.data for topic, _, message in read(tmp_path / 'bag')
            if topic == '/arm/control_period']
    assert told == [0.25, 0.5]  # the newest holds


def test_topics_of_any_type_can_be_recorded_beside_where_the_arm_stands_and_its_time(
        client, record, tmp_path):
    joints = client.create_publisher(JointState, 'elsewhere/joints', STREAM)
    robot = client.create_publisher(String, 'robot_description', LATCHED)
    robot.publish(String(data='<robot/>'))  # before the recorder is there
    node = record(topics=['elsewhere/joints', 'robot_description'], compression='none',
                  mount_x=0.25, mount_y=0.7, mount_z=-0.1, mount_turn=UR10E.mount.yaw,
                  fixed_opening=0.5, control_period=0.5)
    assert until(joints.get_subscription_count)
    joints.publish(JointState(name=['a'], position=[1.5]))
    arrived(joints, robot)
    assert until(lambda: node.node._bags.count == 2)
    assert node.end() == 0
    found = {topic: (kind, message) for topic, kind, message in read(tmp_path / 'bag')}
    assert sorted(found) == ['/arm/control_period', '/elsewhere/joints', '/robot_description']
    assert found['/arm/control_period'][1].data == 0.5
    kind, message = found['/elsewhere/joints']
    assert kind == 'sensor_msgs/msg/JointState'
    assert message.name == ['a'] and message.position.tolist() == [1.5]
    assert found['/robot_description'][1].data == '<robot/>'
    stood = UR10E.mount
    assert read_mount(tmp_path / 'bag') == ArmMount(
        Mount((0.25, *stood.position[1:]), stood.yaw, stood.tool), 0.5)


def test_the_mask_of_the_last_picture_is_waited_for(client, record, tmp_path):
    images, masks = (client.create_publisher(Image, name, STREAM)
                     for name in ('camera/image_raw', 'camera/robot_mask'))
    record()
    arrived(images, masks)
    masks.publish(random_image(1))
    images.publish(random_image(1))
    images.publish(random_image(2))
    arrived(images, masks)
    client.create_timer(0.3, lambda: masks.publish(random_image(2)))
    ask(client, False)
    last = [topic for topic, _, message in read(tmp_path / 'bag')
            if topic.startswith('/camera') and message.header.stamp.nanosec == 2]
    assert last == ['/camera/image_raw', '/camera/robot_mask']
