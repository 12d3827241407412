# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What the recorder promises: whole bags, no overwriting, and staying up when the disk fails."""

from pathlib import Path
import resource
from time import sleep
import warnings

import cv2
from mcap.reader import make_reader
import numpy as np
from processes import NodeProcess
import pytest
import rclpy
from rclpy.duration import Duration
from rclpy.qos import qos_profile_sensor_data
from rclpy.signals import SignalHandlerOptions
from sensor_msgs.msg import Image, JointState
from std_msgs.msg import Float64, String
from std_srvs.srv import SetBool
from tap_ros.nodes.clients import call
from tap_ros.nodes.recorder.node import RecorderNode
from tap_ros.nodes.ros_messages import encode_image
from tap_ros.nodes.topics import LATCHED, STREAM, to_stamp
from tap_ros.recording.attachments import read_attachments
from tap_ros.recording.messages import decode
from tap_ros.recording.mounts import ArmMount, read_mount
from tap_ros.recording.reader import iter_episodes
from tap_ros.robots import ur10e


def read(folder):
    """Return [(topic, type, decoded message)] of the only file in a bag, CRCs checked."""
    path, = Path(folder).glob('*.mcap')
    with path.open('rb') as stream:
        reader = make_reader(stream, validate_crcs=True)
        return [(channel.topic, schema.name, decode(schema.name, message.data))
                for schema, channel, message in reader.iter_messages()]


@pytest.fixture
def record(tmp_path):
    """Start a recorder; none is left running."""
    started = []

    def start(**parameters):
        parameters.setdefault('folder', tmp_path / 'bag')
        started.append(NodeProcess(
            'recorder_node', tmp_path / f'log{len(started)}.txt', parameters))
        return started[-1]

    yield start
    for process in started:
        process.kill()


def wait_for_subscriber(publisher, give_up_after=200):
    for _ in range(give_up_after):
        if publisher.get_subscription_count():
            return
        sleep(0.1)
    raise AssertionError(f'nobody subscribes to {publisher.topic_name}')


def arrived(publisher):
    """Wait until the recorder has all that was published reliably."""
    wait_for_subscriber(publisher)
    assert publisher.wait_for_all_acked(Duration(seconds=20))


def finish(client, success=True):
    """End the bag; what has arrived before is written first."""
    service = client.create_client(SetBool, 'recorder/record')
    answer = call(service, SetBool.Request(data=False), 20)
    assert answer.success == success, answer.message
    return answer.message


def size_when_written(path, at_least, give_up_after=60):
    """Wait until a file has so many bytes and grows no more; return how many it has."""
    sizes = [0, 0]
    for _ in range(give_up_after):
        if sizes[-1] == sizes[-2] >= at_least:
            return sizes[-1]
        sleep(1.0)  # it is flushed every half second
        sizes.append(path.stat().st_size)
    raise AssertionError(f'{path} has {sizes[-1]} bytes')


def random_image(stamp):
    rng = np.random.default_rng(stamp)
    return encode_image(rng.integers(0, 256, (32, 32, 3), np.uint8), to_stamp(stamp), 'camera')


def test_messages_come_back_as_they_were_sent(client, record, tmp_path):
    goal = client.create_publisher(Image, 'goal/image', LATCHED)
    goal.publish(random_image(1))  # before the recorder is there
    images = client.create_publisher(Image, 'camera/image_raw', qos_profile_sensor_data)
    gripper = client.create_publisher(Float64, 'gripper/command', STREAM)
    process = record().wait_for('ready')
    for publisher in (goal, images, gripper):
        wait_for_subscriber(publisher)
    process.wait_for('recorded as best effort')
    sleep(1.0)  # a best-effort publisher cannot tell when its new subscriber is ready
    sent = [random_image(stamp) for stamp in range(2, 12)]
    for index, image in enumerate(sent):
        images.publish(image)
        gripper.publish(Float64(data=index / 10))
        sleep(0.02)
    arrived(gripper)
    assert finish(client).startswith('21 messages')
    assert process.end() == 0, process.text
    found = read(tmp_path / 'bag')
    assert (tmp_path / 'bag' / 'metadata.yaml').is_file()
    pictures = [m.data.tobytes() for topic, _, m in found if topic == '/camera/image_raw']
    assert pictures == [bytes(image.data) for image in sent]
    assert [m.data for topic, _, m in found if topic == '/gripper/command'] \
        == [index / 10 for index in range(10)]
    assert [m.data.tobytes() for topic, _, m in found if topic == '/goal/image'] \
        == [bytes(random_image(1).data)]


def test_what_has_arrived_when_it_ends_is_recorded(client, tmp_path):
    publisher = client.create_publisher(Float64, 'gripper/command', STREAM)
    rclpy.init(args=['--ros-args', '-p', f'folder:={tmp_path / "bag"}'],
               signal_handler_options=SignalHandlerOptions.NO)
    try:
        node = RecorderNode()
        wait_for_subscriber(publisher)
        for value in range(8):
            publisher.publish(Float64(data=float(value)))
        arrived(publisher)
        assert node.close() == 0  # no callback has run
        node.destroy_node()
    finally:
        rclpy.shutdown()
    assert [message.data for *_, message in read(tmp_path / 'bag')] == list(range(8))


def test_a_bag_is_never_overwritten_and_each_one_has_the_goal(client, record, tmp_path):
    goal = client.create_publisher(Image, 'goal/image', LATCHED)
    goal.publish(random_image(1))
    (tmp_path / 'bag').mkdir()
    (tmp_path / 'bag' / 'precious.txt').write_text('mine')
    process = record().wait_for('ready')
    arrived(goal)
    service = client.create_client(SetBool, 'recorder/record')
    assert 'bag-2' in finish(client)
    assert 'bag-3' in call(service, SetBool.Request(data=True), 20).message
    assert process.end() == 0, process.text
    assert [path.name for path in (tmp_path / 'bag').iterdir()] == ['precious.txt']
    for name in ('bag-2', 'bag-3'):
        assert [topic for topic, _, _ in read(tmp_path / name)] == ['/goal/image']


def test_goal_pictures_and_model_cards_are_attached(client, record, tmp_path):
    goal = client.create_publisher(Image, 'goal/image', LATCHED)
    cards = client.create_publisher(String, 'predictor_node/model_card', LATCHED)
    goal.publish(random_image(1))  # before the recorder is there
    cards.publish(String(data='# mine.safetensors'))
    process = record().wait_for('ready')
    for stamp in (1, 2, 2):
        arrived(goal)
        goal.publish(random_image(stamp))
    arrived(goal)
    arrived(cards)
    path, = (tmp_path / 'bag').glob('*.mcap')
    size_when_written(path, 4 * 32 * 32 * 3)  # two goals, as messages and as files
    finish(client)
    service = client.create_client(SetBool, 'recorder/record')
    assert call(service, SetBool.Request(data=True), 20).success  # with what holds by now
    finish(client)
    assert process.end() == 0, process.text
    for name, pictures in (('bag', [1, 2]), ('bag-2', [2])):
        file, = (tmp_path / name).glob('*.mcap')
        found = {}
        for each in read_attachments(file):
            found.setdefault(each.name, []).append(each.data)
        assert found['predictor_node_model_card.md'] == [b'# mine.safetensors']
        assert [cv2.imdecode(np.frombuffer(png, np.uint8), cv2.IMREAD_COLOR)[..., ::-1].tobytes()
                for png in found['goal.png']] == [
            bytes(random_image(stamp).data) for stamp in pictures]


def test_topics_of_any_type_can_be_recorded(client, record, tmp_path):
    joints = client.create_publisher(JointState, 'elsewhere/joints', STREAM)
    robot = client.create_publisher(String, 'robot_description', LATCHED)
    robot.publish(String(data='<robot/>'))  # before the recorder is there
    process = record(topics='[elsewhere/joints,robot_description]', compression='none',
                     mount_x=0.25, fixed_opening=0.5).wait_for('ready')
    wait_for_subscriber(joints)
    joints.publish(JointState(name=['a'], position=[1.5]))
    arrived(joints)
    arrived(robot)
    path, = (tmp_path / 'bag').glob('*.mcap')
    size_when_written(path, 1000)
    finish(client)
    assert process.end() == 0, process.text
    found = {topic: (kind, message) for topic, kind, message in read(tmp_path / 'bag')}
    assert sorted(found) == ['/elsewhere/joints', '/robot_description']
    kind, message = found['/elsewhere/joints']
    assert kind == 'sensor_msgs/msg/JointState'
    assert message.name == ['a'] and message.position.tolist() == [1.5]
    assert found['/robot_description'][1].data == '<robot/>'
    stood = ur10e.SIMULATED
    assert read_mount(tmp_path / 'bag') == ArmMount(
        ur10e.Mount((0.25, *stood.position[1:]), stood.yaw, stood.tool), 0.5)


def test_a_full_disk_is_told_and_the_node_stays_up(client, record, tmp_path):
    images = client.create_publisher(Image, 'camera/image_raw', STREAM)
    process = record().wait_for('ready')
    service = client.create_client(SetBool, 'recorder/record')
    wait_for_subscriber(images)
    # Files of this process cannot grow any further: what a full disk looks like to it.
    resource.prlimit(process.process.pid, resource.RLIMIT_FSIZE, (100_000, 200_000))
    for stamp in range(1, 200):
        images.publish(random_image(stamp))
        sleep(0.01)
    process.wait_for('recording has stopped after')
    assert str(tmp_path / 'bag') in process.text
    assert 'recording has stopped after' in finish(client, success=False)
    resource.prlimit(process.process.pid, resource.RLIMIT_FSIZE, (200_000, 200_000))
    assert 'bag-2' in call(service, SetBool.Request(data=True), 20).message
    images.publish(random_image(1))
    arrived(images)
    assert '1 messages' in finish(client)
    assert process.end() == 0, process.text
    assert len(read(tmp_path / 'bag-2')) == 1


def test_a_bag_that_cannot_be_finished_is_a_failure(client, record, tmp_path):
    images = client.create_publisher(Image, 'camera/image_raw', STREAM)
    process = record().wait_for('ready')
    wait_for_subscriber(images)
    for stamp in range(1, 9):  # no more than the publisher keeps
        images.publish(random_image(stamp))
    arrived(images)
    path, = (tmp_path / 'bag').glob('*.mcap')
    room = size_when_written(path, 8 * 32 * 32 * 3) + 100
    resource.prlimit(process.process.pid, resource.RLIMIT_FSIZE, (room, 2 * room))
    assert 'could not be finished' in finish(client, success=False)
    with warnings.catch_warnings(action='ignore'):  # that it was not finished
        episode, = iter_episodes(tmp_path / 'bag')
    assert len(episode) == 8
    resource.prlimit(process.process.pid, resource.RLIMIT_FSIZE, (room, room))
    service = client.create_client(SetBool, 'recorder/record')
    assert call(service, SetBool.Request(data=True), 20).success, 'it stays up'
    for stamp in range(1, 9):  # no more than the publisher keeps
        images.publish(random_image(stamp))
    arrived(images)
    assert process.end() == 1, process.text
    assert 'Traceback' not in process.text


@pytest.mark.parametrize('parameters, words', [
    ({'compression': 'rar'}, ['compression', 'rar', 'zstd, lz4, none']),
    ({'folder': '/proc/nowhere'}, ['/proc/nowhere', 'cannot be made']),
])
def test_a_bad_start_ends_with_one_clear_line(record, parameters, words):
    process = record(**parameters)
    assert process.process.wait(60) == 1
    line, = [line for line in process.text.splitlines() if line.strip()]
    assert '[FATAL]' in line
    for word in words:
        assert word in line
