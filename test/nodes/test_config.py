# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The file of parameters names what the nodes declare, with the values that they have anyway."""

from importlib import import_module
from pathlib import Path
import sys

from rclpy.context import Context
from rclpy.node import Node
from tap_ros.contract import CLIMB_LIMIT, MOVE_LIMIT, NODE_MODULES
import yaml

FILE = Path(__file__).parents[2] / 'config/tap_ros.yaml'
NODES = {key.removeprefix('/**/'): values['ros__parameters']
         for key, values in yaml.safe_load(FILE.read_text()).items()}


def declared(name, *arguments):
    """Return the values of the parameters that a node declares, started with arguments."""
    context = Context()
    context.init(args=['--ros-args', *arguments])
    node = Node(name, context=context)
    try:
        before = set(node._parameters)
        sys.modules[import_module(NODE_MODULES[name]).main.__module__].declare_parameters(node)
        return {key: node.get_parameter(key).value for key in set(node._parameters) - before}
    finally:
        node.destroy_node()
        context.try_shutdown()


def test_the_file_has_every_parameter_with_its_default_and_reaches_the_nodes(tmp_path):
    assert set(NODES) == set(NODE_MODULES)
    for name, written in NODES.items():
        values = declared(name)
        values.pop('topics', None)  # of recorder_node; all that are known
        if name == 'visual_mpc_node':  # neither more than the arm does, nor less
            assert (values['max_step_xy'], values['max_step_z']) == (MOVE_LIMIT, CLIMB_LIMIT)
        if name == 'predictor_node':  # there a file, here its name
            values['weights'] = Path(values['weights']).stem
        assert written == values
        assert {key: type(value) for key, value in written.items()} == {
            key: type(value) for key, value in values.items()}
        given = written | {
            key: not value if isinstance(value, bool) else 0.9 * value
            for key, value in written.items() if isinstance(value, (bool, float))}
        file = tmp_path / f'{name}.yaml'
        file.write_text(yaml.dump({f'/**/{name}': {'ros__parameters': given}}))
        values = declared(name, '--params-file', str(file))
        assert {key: values[key] for key in given} == given
