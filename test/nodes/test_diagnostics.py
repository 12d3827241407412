# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What log and /diagnostics say: of inputs and work, of silence."""

from threading import Thread
import time

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from processes import Client, LocalNode, Newest, until
import pytest
from sensor_msgs.msg import CompressedImage, Image, JointState
from std_msgs.msg import String
from std_srvs.srv import SetBool
from tap_msgs.msg import ObjectStates
from tap_ros.nodes.recorder.node import RecorderNode
from tap_ros.ros import diagnostics
from tap_ros.ros.calls import call
from tap_ros.ros.diagnostics import Diagnostics, Record
from tap_ros.ros.subscriptions import why_silent
from tap_ros.ros.topics import STREAM


def test_what_is_published_instead_and_the_remedy_are_named():
    eye = '/eye/image_raw'
    for kind, topic, published, words in (
            (Image, eye, {f'{eye}/compressed': CompressedImage},
             [f'{eye}/compressed is', '-p image_transport:=compressed']),
            (Image, eye, {eye: CompressedImage},
             ['published there is sensor_msgs/msg/CompressedImage; expected sensor_msgs/msg/Image',
              f'-p image_transport:=compressed -r {eye}/compressed:={eye}']),
            (JointState, '/joint_states', {f'/{side}/joint_states': JointState
                                           for side in ('left', 'right')},
             ['/left/joint_states, /right/joint_states', ':=/left/joint_states']),
            (ObjectStates, '/goal/objects', {'/goal/object': Image}, ['no node publishes it']),
            (None, eye, {'/eye/image_ra': String}, ['no node publishes it', '/eye/image_ra'])):
        with (Client('camera') as camera, Client('looking') as node,
              Client('visual_mpc_node') as ours):
            ours.create_publisher(Image, '/a/plan', STREAM)
            for name, other in published.items():
                camera.create_publisher(other, name, STREAM)

            def fits(topic=topic, kind=kind, words=words, node=node):
                return all(word in why_silent(node, topic, kind) for word in words)

            assert until(fits, 10), (published, why_silent(node, topic, kind))
            assert f'{topic}:={topic}' not in why_silent(node, topic, kind)
            assert until(lambda node=node: node.count_publishers('/a/plan'))
            name, other = next(iter(published.items()))
            assert until(lambda node=node, name=name: {'camera'} == {
                one.node_name for one in node.get_publishers_info_by_topic(name)})
            assert why_silent(node, name, other) == ''
            assert not {'/goal/image', '/goal/object', '/a/plan'} & set(
                why_silent(node, topic, kind).replace(',', ' ').replace(':', ' ').split())


def test_what_one_robot_is_told_names_nothing_of_another(client):
    topics = ('/b/camera/image_raw', '/b/camera/image_raw/compressed', '/b/wrist/image', '/image')
    kinds = (Image, CompressedImage, Image, Image)
    with (Client('tracker_node', namespace='/a') as node,
          Client('predictor_node', namespace='/b')):
        for kind, topic in zip(kinds, topics):
            client.create_publisher(kind, topic, STREAM)
        newest = Newest(client, DiagnosticArray, '/diagnostics', 10)
        Diagnostics(node, ['camera/image_raw'])
        told = newest.wait(10, lambda message: message.status[0].hardware_id == '/a/tracker_node')
        assert {status.name for status in told.status} == {
            'a/tracker_node: service', 'a/tracker_node: /a/camera/image_raw'}

        def why():
            return why_silent(node, '/a/camera/image_raw', Image)

        assert until(lambda: ':=/image' in why())
        assert until(lambda: node.count_publishers('/b/wrist/image'))
        assert until(lambda: ('predictor_node', '/b') in node.get_node_names_and_namespaces())
        assert '/b/' not in why()


def test_cameras_that_share_a_topic_are_named_once(client, hurried, capfd):
    node = LocalNode(RecorderNode, topics=['camera/image_raw'], record_on_start=False)
    try:
        with Client('left_eye') as left, Client('right_eye') as right:
            for camera in (left, right):
                camera.create_publisher(Image, 'camera/image_raw', STREAM)
            said = []

            def named():
                said.append(capfd.readouterr().err)
                return ''.join(said).count(
                    '2 nodes publish on /camera/image_raw, /left_eye, /right_eye')
            assert until(named) == 1
            assert not until(lambda: named() > 1, 2.5, pause=0.1)
    finally:
        assert node.end() == 0


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
    assert until(lambda: warned('/wrist/joints', 'no node publishes it'))
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


def test_a_node_is_not_told_of_silence_while_it_started_or_was_kept_from_listening(
        client, hurried, capfd):
    pictures = client.create_publisher(Image, 'camera/image_raw', STREAM)
    client.create_timer(0.1, lambda: pictures.publish(Image()))

    def slowly(**options):
        made = RecorderNode(**options)
        time.sleep(3.0)
        return made

    node = LocalNode(slowly, topics=['camera/image_raw'], record_on_start=False)
    try:
        camera = node.node._diagnostics._inputs['/camera/image_raw']
        assert until(lambda: camera.count > 10)
        busy = node.node.create_timer(0.01, lambda: (busy.cancel(), time.sleep(3.0)))
        assert until(busy.is_canceled)
        before = camera.count
        assert until(lambda: camera.count > before + 10)
    finally:
        assert node.end() == 0
    assert 'nothing has come' not in capfd.readouterr().err


def test_objects_that_wait_to_be_selected_are_nothing_to_warn_of(client, hurried, capfd):
    objects = client.create_publisher(ObjectStates, 'objects', STREAM)
    node = LocalNode(RecorderNode, topics=['joint_states', 'objects'], record_on_start=False)
    try:
        said = []

        def named(topic, why):
            said.append(capfd.readouterr().err)
            return f'nothing has come on {topic} for 1 s{why}' in ''.join(said)
        assert until(lambda: named('/joint_states', ': no node'))
        assert until(lambda: node.node.count_publishers('/objects'))
        assert not until(lambda: named('/objects', ', though'), 2.5, pause=0.1)
        client.destroy_publisher(objects)
        assert until(lambda: named('/objects', ': no node'))
    finally:
        assert node.end() == 0


def statuses(message):
    """Return {name: (level, message, {key: value})}."""
    return {status.name: (status.level, status.message, {v.key: v.value for v in status.values})
            for status in message.status}


def test_work_and_inputs_of_many_threads_are_counted_and_silence_is_told(client, monkeypatch):
    monkeypatch.setattr(diagnostics, 'PERIOD', 0.2)
    newest = Newest(client, DiagnosticArray, '/diagnostics', 10)
    waiting = ['a', 'b', 'c']
    told = Diagnostics(
        client, ['camera/image_raw', 'objects'], ['/goal/image', 'episode'],
        queue=lambda: len(waiting), expected=['episode'])

    def work():
        for index in range(100):
            told.received('camera/image_raw')
            told.received('/camera/image_raw')
            told.took(index % 100, 'predict_subgoal')
    threads = [Thread(target=work) for _ in range(8)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    told.error('bad\nname \x1b[31m')
    message = newest.wait(
        10.0, lambda message: statuses(message)['test_client: service'][2]['errors'] == '1')
    found = statuses(message)
    assert set(found) == {
        'test_client: service', 'test_client: /camera/image_raw', 'test_client: /objects',
        'test_client: /goal/image', 'test_client: /episode'}
    assert {status.hardware_id for status in message.status} == {'/test_client'}
    level, word, values = found['test_client: /camera/image_raw']
    assert (level, word, values['count']) == (DiagnosticStatus.OK, 'OK', '1600')
    for needed in ('/objects', '/episode'):
        assert found[f'test_client: {needed}'][:2] == (DiagnosticStatus.WARN, 'NotReceived')
    level, word, values = found['test_client: /goal/image']
    assert (level, word) == (DiagnosticStatus.OK, 'NotReceived'), 'it may never come'
    assert (values['count'], values['age_s']) == ('0', 'nan')
    level, text, values = found['test_client: service']
    assert (level, text) == (DiagnosticStatus.ERROR, r'bad\nname \x1b[31m')
    assert values.pop('last_error_age_s')
    assert values == {
        'queue': '3', 'errors': '1', 'last_error': text, 'predict_subgoal calls': '800',
        'predict_subgoal p50_ms': '49.50', 'predict_subgoal p99_ms': '98.01'}
    level, word, values = statuses(newest.wait(10.0, lambda message: 'Stale' in (
        status.message for status in message.status)))['test_client: /camera/image_raw']
    assert level == DiagnosticStatus.STALE and float(values['age_s']) >= 2.0


def test_a_rate_is_the_frequency_and_only_recent_events_count():
    for frequency in (0.5, 4.0, 30.0, 5000.0):
        record = Record()
        assert record.rate(0.0) == 0.0
        for index in range(500):
            record.add(index / frequency, index)
        end = 499 / frequency
        assert record.rate(end) == pytest.approx(frequency, rel=1e-6)
        assert record.recent(end + 60.0, 60.0)[:, 1].tolist() == [499]
        assert record.rate(end + 60.1) == 0.0 and record.count == 500
