# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The layouts of viewers show topics that running nodes publish."""

import json
from pathlib import Path

from processes import until
import pytest
from rclpy.qos import DurabilityPolicy
import yaml

pytestmark = pytest.mark.slow
FOLDER = Path(__file__).parents[2] / 'config' / 'layouts'
IMAGE, TEXT = 'sensor_msgs/msg/Image', 'std_msgs/msg/String'
CAMERA_INFO, NUMBER = 'sensor_msgs/msg/CameraInfo', 'std_msgs/msg/Float64'
DIAGNOSTICS = 'diagnostic_msgs/msg/DiagnosticArray'
# Of rviz 14.1 (Jazzy), by rviz_default_plugins/plugins_description.xml.
DISPLAYS = {'RobotModel': TEXT, 'CameraInfo': CAMERA_INFO, 'Image': IMAGE}


def foxglove():
    """Return the topics that Foxglove and Lichtblick show, with their types."""
    panels = json.loads((FOLDER / 'tap_ros.json').read_text())['configById']
    shown = {panel['imageMode']['imageTopic']: IMAGE for name, panel in panels.items()
             if name.startswith('Image!')}
    assert len(shown) == 6
    for panel in panels.values():
        for path in panel.get('paths', ()):
            if not path['value'].isdigit():  # a line at a height
                shown[path['value'].removesuffix('.data')] = NUMBER
        for topic, settings in panel.get('topics', {}).items():
            shown[topic] = (IMAGE if 'cameraInfoTopic' in settings else
                            CAMERA_INFO if 'distance' in settings else TEXT)
    shown[panels['DiagnosticSummary!all']['topicToRender']] = DIAGNOSTICS
    return shown


def rqt():
    """Return the same for rqt; settings are written as Python has them."""
    groups = json.loads((FOLDER / 'tap_ros.perspective').read_text())['groups']
    shown = {'/diagnostics': DIAGNOSTICS}
    for group in groups['pluginmanager']['groups'].values():
        settings = group['groups']['plugin']['keys']
        if 'topic' in settings:
            shown[yaml.safe_load(settings['topic']['repr'])] = IMAGE
        elif 'topics' in settings:
            shown[yaml.safe_load(settings['topics']['repr']).removesuffix('/data')] = NUMBER
    return shown


def rviz():
    """Return rviz's displays that show a topic, {topic: (type, settings)}."""
    layout = yaml.safe_load((FOLDER / 'tap_ros.rviz').read_text())
    return {topic['Value']: (DISPLAYS[display['Class'].split('/')[1]], topic)
            for display in layout['Visualization Manager']['Displays']
            if (topic := display.get('Topic') or display.get('Description Topic'))}


def test_all_viewers_show_topics_of_the_nodes_as_they_are_offered(loop):
    shown = [foxglove(), rqt(), {topic: kind for topic, (kind, _) in rviz().items()}]
    wanted = {topic for layout in shown for topic in layout}
    topics = until(lambda: wanted <= set(
        found := dict(loop.node.get_topic_names_and_types())) and found)
    for layout in shown:
        for topic, kind in layout.items():
            assert topics[topic] == [kind], topic
    for name, (_, settings) in rviz().items():
        info, = loop.node.get_publishers_info_by_topic(name)
        latched = info.qos_profile.durability == DurabilityPolicy.TRANSIENT_LOCAL
        assert settings['Durability Policy'] == ('Transient Local' if latched else 'Volatile')
        assert settings['Reliability Policy'] == 'Reliable'
