# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The launch files start the nodes; read with launch from apt or of `make ros2`."""

from importlib.util import module_from_spec, spec_from_file_location
from pathlib import Path

import pytest
from tap_ros.contract import NODE_MODULES

launch_ros = pytest.importorskip('launch_ros.actions', reason='launch_ros is not there: make ros2')
launch = pytest.importorskip('launch.actions')
substitutions = pytest.importorskip('launch.substitutions')

FOLDER = Path(__file__).parents[2] / 'launch'


def described(name):
    """Return the actions of a launch file."""
    spec = spec_from_file_location('described', FOLDER / name)
    module = module_from_spec(spec)
    spec.loader.exec_module(module)
    return module.generate_launch_description().entities


def test_nodes_launch_starts_each_executable_once():
    nodes = [e for e in described('nodes.launch.py') if isinstance(e, launch_ros.Node)]
    ours = [node.node_executable for node in nodes if node.node_package == 'tap_ros']
    assert sorted(ours) == sorted(NODE_MODULES)


def test_rviz_is_started_only_if_asked_for_and_with_a_file_that_is_there():
    context = pytest.importorskip('launch').LaunchContext()
    entities = described('nodes.launch.py')
    argument, = [e for e in entities
                 if isinstance(e, launch.DeclareLaunchArgument) and e.name == 'rviz']
    assert argument.default_value[0].text == 'false'
    rviz, = [e for e in entities
             if isinstance(e, launch_ros.Node) and e.node_package == 'rviz2']
    for value in ('true', 'false'):
        context.launch_configurations['rviz'] = value
        assert rviz.condition.evaluate(context) == (value == 'true')
    path = Path(*[part.text for part in rviz.cmd[2][0].substitutions[1:]])
    assert (FOLDER.parent / path).is_file()


def test_demo_launch_ends_with_its_driver():
    driver, = [e for e in described('demo.launch.py')
               if isinstance(e, launch.ExecuteProcess)]
    words = [word.text for part in driver.process_description.cmd for word in part
             if isinstance(word, substitutions.TextSubstitution)]
    assert ['tap_ros', 'demo', '--attach'] == words[2:5]
