# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The layouts of viewers show topics that running nodes publish."""

from pathlib import Path
import re

from processes import until
import pytest
from rclpy.qos import DurabilityPolicy, ReliabilityPolicy
import yaml

pytestmark = pytest.mark.slow
FOLDER = Path(__file__).parents[2] / 'config' / 'layouts'


def test_all_viewers_show_topics_of_the_nodes_as_they_are_offered(loop):
    wanted = {'/diagnostics'}
    for file in FOLDER.iterdir():
        found = set(re.findall(r'(?<=["\' ])/[a-z_]+(?:/[a-z_]+)*', file.read_text()))
        assert len(found) > 2, file
        wanted |= {name.removesuffix('/data') for name in found}

    def missing():
        return wanted - {name for name, _ in (*loop.node.get_topic_names_and_types(),
                                              *loop.node.get_service_names_and_types())}

    assert until(lambda: not missing()), missing()
    layout = yaml.safe_load((FOLDER / 'tap_ros.rviz').read_text())
    for display in layout['Visualization Manager']['Displays']:
        shown = display.get('Topic') or display.get('Description Topic')
        if shown:
            info, = loop.node.get_publishers_info_by_topic(shown['Value'])
            latched = info.qos_profile.durability == DurabilityPolicy.TRANSIENT_LOCAL
            assert shown['Durability Policy'] == ('Transient Local' if latched else 'Volatile')
            assert info.qos_profile.reliability == ReliabilityPolicy.RELIABLE
