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
    assert sorted(node.node_executable for node in nodes) == sorted(NODE_MODULES)


def test_demo_launch_ends_with_its_driver():
    driver, = [e for e in described('demo.launch.py')
               if isinstance(e, launch.ExecuteProcess)]
    words = [word.text for part in driver.process_description.cmd for word in part
             if isinstance(word, substitutions.TextSubstitution)]
    assert ['tap_ros', 'demo', '--attach'] == words[2:5]
