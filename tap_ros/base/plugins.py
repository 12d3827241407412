# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Parts that can be replaced by name: those of this package, and those that other packages add.

Another package adds one by an entry point, without a fork:

    [project.entry-points.'tap_ros.arms']
    xarm7 = 'my_package.xarm7:XARM7'
"""

from importlib import import_module
from importlib.metadata import entry_points
from typing import Any

from tap_ros.base.errors import ConfigError
from tap_ros.base.text import escaped, meant

# By group: name -> 'module:attribute'.
BUILT_IN: dict[str, dict[str, str]] = {
    'tap_ros.arms': {
        'panda': 'tap_ros.robots.panda:PANDA', 'ur10e': 'tap_ros.robots.ur10e:UR10E'},
    'tap_ros.forward_models': {
        'learned': 'tap_ros.planning.forward_model:LearnedForwardModel',
        'true': 'sim_bridge.true_model:TrueModel'},
    'tap_ros.predictors': {
        'nearest_keyframe': 'tap_ros.prediction.nearest_keyframe:NearestKeyframe',
        'tap': 'tap_ros.prediction.predictor:SubgoalPredictor'},
    'tap_ros.solvers': {'cem': 'tap_ros.planning.solvers.cem:cem',
                        'icem': 'tap_ros.planning.solvers.icem:icem'},
    'tap_ros.tasks': {
        'grasp': 'sim_bridge.tasks.grasp:GRASP', 'pick_place': 'sim_bridge.tasks.grasp:PICK_PLACE',
        'push2': 'sim_bridge.tasks.push:PUSH2', 'push3': 'sim_bridge.tasks.push:PUSH3',
        'order2': 'sim_bridge.tasks.order:ORDER2', 'order3': 'sim_bridge.tasks.order:ORDER3',
        'stack2': 'sim_bridge.tasks.stack:STACK2', 'stack3': 'sim_bridge.tasks.stack:STACK3'},
    'tap_ros.trackers': {'rigid': 'tap_ros.tracking.rigid_tracker:RigidTracker'},
    'tap_ros.worlds': {'metaworld': 'sim_bridge.metaworld:MetaWorld',
                       'mujoco_table': 'sim_bridge.simulator:Simulator',
                       'ogbench': 'sim_bridge.ogbench:CubeDouble'},
}

_HAS = {  # an attribute of what entry points of a group name; of others that they can be called
    'tap_ros.arms': 'joints', 'tap_ros.forward_models': 'load', 'tap_ros.predictors': 'load',
    'tap_ros.tasks': 'demonstrate'}


def names(group: str) -> list[str]:
    """Return the names of a group, sorted: those of this package and those of entry points."""
    return sorted({*BUILT_IN[group], *(point.name for point in entry_points(group=group))})


def load_plugin(group: str, name: str) -> Any:
    """
    Import what a name stands for.

    :param group: one of BUILT_IN, such as 'tap_ros.arms'.
    :param name: of this package, or of an entry point of the group; this package's go first.
    :return: the class or object.
    :raises ConfigError: for an unknown name; it names the nearest one and all valid ones. For an
        entry point that cannot be imported, or is no such thing, it names its package.
    """
    kind = group.partition('.')[2].removesuffix('s').replace('_', ' ')
    place = BUILT_IN[group].get(name)
    if place is not None:
        module, _, attribute = place.partition(':')
        return getattr(import_module(module), attribute)
    for point in entry_points(group=group, name=name):
        try:
            found = point.load()
            if not hasattr(found, _HAS.get(group, '__call__')):
                raise TypeError(f'is of type {type(found).__name__}, which is no {kind}')
        except (Exception, SystemExit) as error:
            package = point.dist.name if point.dist else 'an unknown package'
            why = escaped(f'{type(error).__name__}: {error}', 300)
            raise ConfigError(
                f'{kind} {escaped(name, 60)}: entry point {escaped(point.value, 100)} of the '
                f'package {escaped(package, 60)} cannot be used: {why}; mend that package, or '
                f'uninstall it') from error
        return found
    valid = names(group)
    raise ConfigError(f'{kind} {name!r} is unknown; {meant(name, valid)}valid: '
                      f'{", ".join(valid) or "none"}')
