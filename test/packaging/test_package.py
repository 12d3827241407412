# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What the packages declare is what they have and need, and the build installs it."""

import ast
from distutils.core import run_setup
from importlib import import_module, metadata
from pathlib import Path
import re
import sys

from ament_index_python import get_package_prefix, get_package_share_directory
from catkin_pkg.package import parse_package
from packaging.requirements import Requirement
import setuptools.build_meta  # noqa: F401  setup.py sees that it is pip who asks
import tap_ros
from tap_ros.base.contract import NODE_CLASSES
from tap_ros.messages.topics import TOPICS

ROOT = Path(__file__).parents[2]
# Imported name: the key by which rosdep knows it.
ROSDEP_KEYS = {
    'PIL': 'python3-pil',
    'cv2': 'python3-opencv',
    'jinja2': 'python3-jinja2',
    'numpy': 'python3-numpy',
    'scipy': 'python3-scipy',
    'tqdm': 'python3-tqdm',
    'yaml': 'python3-yaml',
}
DISTRIBUTIONS = {  # other names
    'PIL': 'pillow', 'cv2': 'opencv-python-headless', 'google': 'protobuf', 'yaml': 'pyyaml'}
ROS_PACKAGES = {'tf2_ros': 'tf2_ros_py'}  # of modules with another name


def required(tree):
    """Walk a syntax tree, but not into what tolerates an ImportError and so is optional."""
    if isinstance(tree, ast.Try) and any(
            'ImportError' in ast.unparse(handler.type or tree) for handler in tree.handlers):
        return
    if isinstance(tree, ast.With) and 'suppress(ImportError)' in ast.unparse(tree.items[0]):
        return
    yield tree
    for child in ast.iter_child_nodes(tree):
        yield from required(child)


def imported_packages(*folders):
    """Return the top-level packages that code needs, without the project's own and Python's."""
    found = set()
    for folder in folders:
        for path in (ROOT / folder).rglob('*.py'):
            for node in required(ast.parse(path.read_text(), str(path))):
                if isinstance(node, ast.Import):
                    found |= {alias.name.split('.')[0] for alias in node.names}
                elif isinstance(node, ast.ImportFrom):
                    found.add(node.module.split('.')[0])
    return found - set(sys.stdlib_module_names) - {'tap_ros', 'sim_bridge', 'experiments'}


def normalized(distribution):
    """Return the name of a distribution as indexes compare it, without its extras."""
    return re.sub(r'[-_.]+', '-', distribution.split('[')[0]).lower()


def requirements(name):
    """Return {distribution: version} of a file of requirements."""
    lines = (ROOT / name).read_text().splitlines()
    pairs = [line.split('==') for line in lines if line and not line.startswith('#')]
    return {normalized(distribution): version for distribution, version in pairs}


OWNERS = metadata.packages_distributions()


def distributions_of(package):
    """Return the names of the distributions that a top-level package may come from."""
    return {normalized(owner) for owner in OWNERS.get(package, [package])}


def test_executables_launch_files_and_parameters_are_installed():
    for node in NODE_CLASSES:
        assert Path(get_package_prefix('tap_ros'), 'lib', 'tap_ros', node).exists(), 'make build'
    share = Path(get_package_share_directory('tap_ros'))
    for pattern in ('config/*.yaml', 'config/layouts/*', 'launch/*.launch.py'):
        here = {path.name for path in ROOT.glob(pattern)}
        assert here and here <= {path.name for path in share.glob(pattern)}


def test_the_layout_for_recordings_shows_only_what_is_recorded():
    layout = (ROOT / 'config' / 'layouts' / 'tap_ros.json').read_text()
    shown = re.findall(r'"(imageTopic|topicPath|value)": "(/[a-z_/]+)([^"]*)', layout)
    types = {topic.recorded: topic.type for topic in TOPICS}
    assert len(shown) > 10
    for kind, topic, fields in shown:
        package, _, name = types[topic].split('/')
        assert (name == 'Image') == (kind == 'imageTopic'), topic
        message = getattr(import_module(f'{package}.msg'), name)()
        for field in re.findall(r'[a-z_]+', fields):
            message = getattr(message, field)


def test_manifests_are_valid_and_of_one_version():
    manifests = [parse_package(str(ROOT / folder)) for folder in ('.', 'tap_msgs')]
    for manifest in manifests:
        assert manifest.package_format == 3
        manifest.validate()
    assert [m.get_build_type() for m in manifests] == ['ament_python', 'ament_cmake']
    assert manifests[0].version == manifests[1].version
    assert manifests[0].version == tap_ros.__version__


def undeclared(folders, *files):
    """Return what code imports that neither package.xml nor files of requirements name."""
    declared = {depend.name for depend in parse_package(str(ROOT)).exec_depends}
    required = {distribution for file in files for distribution in requirements(file)}
    return [name for name in sorted(imported_packages(*folders)) if name not in declared
            and (ROSDEP_KEYS | ROS_PACKAGES).get(name) not in declared
            and not distributions_of(name) & required]


def test_what_is_imported_is_declared_and_what_is_required_is_imported():
    assert not undeclared(('tap_ros', 'sim_bridge', 'launch'), 'requirements.txt',
                          'requirements-extras.txt', 'requirements-worlds.txt')
    assert not undeclared(('experiments',), 'requirements.txt', 'requirements-experiments.txt',
                          'requirements-dev.txt', 'requirements-worlds.txt')
    used = {'av', 'tensorboard'}  # where it is there; by way of torch.utils.tensorboard
    for name in imported_packages('tap_ros', 'sim_bridge', 'experiments', 'test'):
        used |= distributions_of(name)
    for name in ('requirements', 'requirements-experiments', 'requirements-extras'):
        assert set(requirements(f'{name}.txt')) <= used


def test_requirements_and_constraints_agree():
    pinned = requirements('constraints.txt')
    for name in ('requirements.txt', 'requirements-dev.txt', 'requirements-experiments.txt',
                 'requirements-extras.txt', 'requirements-worlds.txt', 'requirements-ros.txt',
                 'requirements-ros2.txt', 'requirements-docs.txt'):
        for distribution, version in requirements(name).items():
            assert pinned[distribution] == version, f'{name}: {distribution}'


def test_pip_brings_what_is_imported_and_the_pinned_versions_will_do(monkeypatch):
    monkeypatch.chdir(ROOT)
    described = run_setup('setup.py', stop_after='commandline')
    extras = dict(described.extras_require)
    assert extras.pop('test') == ['pytest']
    extras = {normalized(each.partition('>')[0]) for extra in extras.values() for each in extra}
    assert extras == set(requirements('requirements-extras.txt'))

    bounds = {normalized(each.name): each.specifier
              for each in map(Requirement, described.install_requires)}
    pinned = requirements('constraints.txt')
    assert all(bound.contains(pinned[name]) for name, bound in bounds.items())
    of_ros = {depend.name for depend in parse_package(str(ROOT)).exec_depends} | set(ROS_PACKAGES)
    imported = imported_packages('tap_ros', 'sim_bridge') - of_ros
    imported = {normalized(DISTRIBUTIONS.get(name, name)) for name in imported}
    # Where they are there; by way of torch.utils.tensorboard.
    imported |= {'av', 'ray', 'tensorboard'}
    assert set(bounds) | extras == imported - set(requirements('requirements-worlds.txt'))
