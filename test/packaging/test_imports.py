# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Who may import whom, and who may import ROS."""

import ast
from graphlib import TopologicalSorter
from pathlib import Path
import re
import subprocess
import sys

import pytest
import tap_ros

ROOT = Path(__file__).parents[2]
OWN = ('tap_ros', 'sim_bridge', 'experiments')
NEED_ROS = ('tap_ros.ros.', 'tap_ros.nodes.', 'sim_bridge.ros.', 'tap_ros.apps.demo.',
            'tap_ros.apps.explorer.', 'tap_ros.apps.call_command.',
            'tap_ros.apps.node_processes.')

# What takes seconds to import: what each node does without, so that it is back soon after a crash.
DONE_WITHOUT = {
    ('sim_bridge.ros.sim_node', 'tap_ros.nodes.recorder.node'):
        ('torch', 'cv2', 'scipy', 'matplotlib', 'pandas', 'tensorboard', 'tyro'),
    ('tap_ros.nodes.predictor.node', 'tap_ros.nodes.planner.node'):
        ('scipy', 'matplotlib', 'pandas', 'tensorboard', 'mujoco', 'tyro'),
}
PRINT_LOADED = """
import importlib, sys
for name in sys.argv[1:]:
    importlib.import_module(name)
print(*sys.modules)
"""

IMPORT_ALL = """
import importlib, sys

class NoRos:
    def find_spec(self, name, path=None, target=None):
        top = name.split('.')[0]
        if (top.endswith(('_msgs', '_srvs', '_interfaces')) or
                top.startswith(('rcl', 'rosidl', 'ament', 'launch'))):
            raise ModuleNotFoundError(f'{name} is blocked: no ROS here', name=name)

sys.meta_path.insert(0, NoRos())
for name in sys.argv[1:]:
    importlib.import_module(name)
"""


def modules():
    """Return {module name: path} of both packages and of the experiments."""
    paths = [path for package in OWN
             for path in sorted((ROOT / package).rglob('*.py'))]
    names = ['.'.join(path.relative_to(ROOT).with_suffix('').parts) for path in paths]
    return {name.removesuffix('.__init__'): path for name, path in zip(names, paths, strict=True)}


def layers():
    """Return what each point of the list in docs/architecture.md names, as modules."""
    section = (ROOT / 'docs' / 'architecture.md').read_text().split('\n## Folders\n')[1]
    rows = re.findall(r'^- (`[^:]*`):', section.split('\n## ')[0], re.MULTILINE)
    return [[name.removesuffix('.py').strip('/').replace('/', '.')
             for name in re.findall('`(.*?)`', row)] for row in rows]


MODULES = modules()
LAYERS = layers()


def imported(path):
    """Return the absolute names that a file imports, of modules and of what is in them."""
    names = set()
    for node in ast.walk(ast.parse(path.read_text(), str(path))):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f'{path}: imports are absolute'
            names |= {f'{node.module}.{alias.name}' for alias in node.names}
    return names


def layer(name):
    """Return the number of the layer of a module: that of the longest name that it begins with."""
    found = [(len(prefix), number) for number, prefixes in enumerate(LAYERS)
             for prefix in prefixes if f'{name}.'.startswith(f'{prefix}.')]
    return max(found)[1]


def may_import_ros(name):
    return f'{name}.'.startswith(NEED_ROS) or 'nodes' in name.split('.')


def test_every_folder_has_its_row_and_every_row_its_folder():
    listed = {name for row in LAYERS for name in row}
    assert {name for name, path in MODULES.items() if path.stem == '__init__'
            and name.count('.') < 2} <= listed
    assert all((ROOT / name.replace('.', '/')).exists() or name in MODULES for name in listed)


def test_imports_come_only_from_above():
    wrong = [f'{name} imports {target}' for name, path in MODULES.items()
             for target in imported(path)
             if target.split('.')[0] in OWN and layer(target) > layer(name)]
    assert not wrong


def test_the_package_does_without_the_simulator():
    assert not [name for name, path in MODULES.items() if name.startswith('tap_ros')
                and any(target.startswith('sim_bridge') for target in imported(path))]


def module_of(name):
    """Return the module that an imported name is, or is in."""
    return name if name in MODULES else name.rpartition('.')[0]


def test_there_is_no_circle_between_modules_or_folders():
    modules = {name: {module_of(target) for target in imported(path)} & MODULES.keys() - {name}
               for name, path in MODULES.items() if not name.startswith('experiments')}
    folders = {}
    for name, targets in modules.items():
        folder, *others = (MODULES[each].parent for each in (name, *targets))
        folders.setdefault(folder, set()).update(set(others) - {folder})
    for graph in (modules, folders):
        TopologicalSorter(graph).prepare()  # raises CycleError, which names it


def test_without_ros_all_but_the_nodes_can_be_imported():
    names = [name for name in MODULES if not may_import_ros(name)]
    run = subprocess.run([sys.executable, '-c', IMPORT_ALL, *names], cwd=ROOT, text=True,
                         stderr=subprocess.PIPE)
    assert run.returncode == 0, run.stderr


@pytest.mark.ros
@pytest.mark.parametrize('nodes', DONE_WITHOUT)
def test_nodes_load_nothing_slow_that_they_do_not_need(nodes):
    run = subprocess.run([sys.executable, '-c', PRINT_LOADED, *nodes], cwd=ROOT, text=True,
                         stdout=subprocess.PIPE, check=True)
    loaded = run.stdout.split()
    assert set(nodes) <= set(loaded)
    assert not set(DONE_WITHOUT[nodes]) & set(loaded)


def test_what_is_exported_is_there_and_told_and_loaded_only_when_asked_for():
    stub = ast.parse((ROOT / 'tap_ros' / '__init__.pyi').read_text())
    told = {alias.asname: node.module for node in stub.body if isinstance(node, ast.ImportFrom)
            for alias in node.names}
    assert told == tap_ros._EXPORTS
    script = ('import sys, tap_ros; assert not {"torch", "mujoco", "mcap"} & set(sys.modules)\n'
              'assert set(tap_ros.__all__) <= set(dir(tap_ros))\n'
              'for name in tap_ros.__all__: assert getattr(tap_ros, name).__name__ == name\n'
              'try: tap_ros.nothing\n'
              'except AttributeError as error: print(error)')
    run = subprocess.run([sys.executable, '-c', script], cwd=ROOT, text=True, capture_output=True)
    assert (run.returncode, run.stdout) == (0, "module 'tap_ros' has no attribute 'nothing'\n"), (
        run.stderr)
