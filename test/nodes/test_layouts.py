# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The layouts of viewers show topics that running nodes publish."""

from collections.abc import Iterator
from importlib import import_module
from importlib.util import find_spec
import json
from pathlib import Path

from processes import until
import pytest
from rclpy.qos import DurabilityPolicy
import yaml

pytestmark = pytest.mark.slow
FOLDER = Path(__file__).parents[2] / 'config' / 'layouts'
IMAGE, CAMERA_INFO = 'sensor_msgs/msg/Image', 'sensor_msgs/msg/CameraInfo'
TEXT = 'std_msgs/msg/String'
DIAGNOSTICS = 'diagnostic_msgs/msg/DiagnosticArray'

# What the 3D panel of Lichtblick 1.28.1 draws, by packages/suite-base/src/panels/ThreeDeeRender.
DRAWN = (IMAGE, CAMERA_INFO, TEXT)
# Of rviz 14.1 (Jazzy), by rviz_default_plugins/plugins_description.xml.
DISPLAYS = {'RobotModel': TEXT, 'CameraInfo': CAMERA_INFO, 'Image': IMAGE}


def found(ask, missing):
    """Return what is asked for as a dict, once it has all names."""
    return until(lambda: missing <= set(answer := dict(ask())) and answer)


def numbers(path, separator, topics):
    """Check that a path through a message ends at a number."""
    topic = max((t for t in topics if path.startswith(t + separator)), key=len)
    package, kind, name = topics[topic][0].split('/')
    fields = getattr(import_module(f'{package}.{kind}'), name).get_fields_and_field_types()
    assert fields[path[len(topic) + 1:]] == 'double'


def foxglove():
    return json.loads((FOLDER / 'tap_ros.json').read_text())


def rviz():
    return yaml.safe_load((FOLDER / 'tap_ros.rviz').read_text())


def value(setting):
    """Return a value of a perspective, as qt_gui reads it."""
    assert setting['type'] == 'repr'
    return yaml.safe_load(setting['repr'])


def rqt() -> tuple[dict, dict]:
    """Return the running plugins, and the settings of each instance."""
    groups = json.loads((FOLDER / 'tap_ros.perspective').read_text())['groups']
    manager = groups['pluginmanager']
    settings = {name: {key: value(v) for key, v in group['groups']['plugin']['keys'].items()}
                for name, group in manager['groups'].items()}
    return value(manager['keys']['running-plugins']), settings


def displayed() -> Iterator[dict]:
    """Yield rviz's displays that show a topic."""
    for display in rviz()['Visualization Manager']['Displays']:
        if 'Topic' in display or 'Description Topic' in display:
            yield display


def test_foxglove_shows_topics_of_the_nodes(loop):
    panels = foxglove()['configById']
    images = [c['imageMode']['imageTopic'] for name, c in panels.items() if name[:6] == 'Image!']
    assert len(set(images)) == len(images) == 6
    drawn = [topic for c in panels.values() for topic in c.get('topics', ())]
    drawn += [c['cameraInfoTopic'] for panel in panels.values()
              for c in panel.get('topics', {}).values() if 'cameraInfoTopic' in c]
    plotted = [p['value'] for c in panels.values() for p in c.get('paths', ())]
    health = panels['DiagnosticSummary!all']['topicToRender']
    topics = found(loop.node.get_topic_names_and_types, {*images, *drawn, health})
    assert {topics[topic][0] for topic in images} == {IMAGE}
    assert {topics[topic][0] for topic in drawn} <= set(DRAWN)
    assert topics[health] == [DIAGNOSTICS]
    for path in plotted:
        if not path.isdigit():  # a line at a height
            numbers(path, '.', topics)
    call = panels['CallService!predict']
    services = found(loop.node.get_service_names_and_types, {call['serviceName']})
    assert services[call['serviceName']] == ['tap_msgs/srv/PredictSubgoal']
    assert json.loads(call['requestPayload']) == {}


def test_rviz_shows_topics_of_the_nodes_as_they_are_offered(loop):
    wanted = {}
    for display in displayed():
        topic = display.get('Topic') or display['Description Topic']
        wanted[topic['Value']] = DISPLAYS[display['Class'].split('/')[1]], topic
    topics = found(loop.node.get_topic_names_and_types, set(wanted))
    for name, (kind, topic) in wanted.items():
        assert topics[name] == [kind]
        info, = loop.node.get_publishers_info_by_topic(name)
        latched = info.qos_profile.durability == DurabilityPolicy.TRANSIENT_LOCAL
        assert topic['Durability Policy'] == ('Transient Local' if latched else 'Volatile'), name
        assert topic['Reliability Policy'] == 'Reliable'
    if find_spec('tf2_msgs'):
        assert topics['/tf'] == ['tf2_msgs/msg/TFMessage']


def test_rqt_shows_topics_of_the_nodes(loop):
    running, settings = rqt()
    images = [s['topic'] for s in settings.values() if 'topic' in s]
    assert len(set(images)) == len(images) == len(running['rqt_image_view/ImageView'])
    topics = found(loop.node.get_topic_names_and_types,
                   {*images, '/plan/distance', '/diagnostics'})
    assert {topics[topic][0] for topic in images} == {IMAGE}
    numbers(settings['plugin__rqt_plot__Plot__1']['topics'], '/', topics)
    service = settings['plugin__rqt_service_caller__ServiceCaller__1']['current_service_name']
    assert found(loop.node.get_service_names_and_types, {service})
