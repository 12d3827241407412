# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Start simulation, predictor, planner; if asked for tracker, recorder, robot masks, explorer, rviz2.

Parameters come from config/tap_ros.yaml of the package or from params_file; for a real camera and
arm start with sim:=false.
"""

from pathlib import Path

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument, OpaqueFunction
from launch.conditions import IfCondition
from launch.substitutions import (
    EqualsSubstitution,
    IfElseSubstitution,
    LaunchConfiguration,
    NotEqualsSubstitution,
    PathJoinSubstitution,
)
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue
from launch_ros.substitutions import FindPackageShare


def generate_launch_description():
    """Describe the nodes and the arguments of this file."""
    record, files = LaunchConfiguration('record'), LaunchConfiguration('params_file')
    return LaunchDescription([
        DeclareLaunchArgument(
            'params_file',
            default_value=PathJoinSubstitution(
                [FindPackageShare('tap_ros'), 'config', 'tap_ros.yaml']),
            description='YAML file with the parameters of the nodes.'),
        DeclareLaunchArgument(
            'namespace', default_value='', description='Namespace of all nodes and topics.'),
        DeclareLaunchArgument(
            'sim', default_value='true', choices=['true', 'false'],
            description='Start the simulation; false with a real camera and arm.'),
        DeclareLaunchArgument(
            'lock_step', default_value='false', choices=['true', 'false'],
            description='Simulated time passes only with commands, so that runs repeat exactly.'),
        DeclareLaunchArgument(
            'objects', default_value='truth', choices=['truth', 'tracked'],
            description='Where the objects come from: the simulation, or tracker_node, which '
                        'follows what is clicked; with a real camera tracked starts it, too.'),
        DeclareLaunchArgument(
            'record', default_value='', description='Folder to record into; empty: no recorder.'),
        DeclareLaunchArgument(
            'mask', default_value='false', choices=['true', 'false'],
            description='Publish masks of a real robot; the simulation publishes its own.'),
        DeclareLaunchArgument(
            'explorer', default_value='false', choices=['true', 'false'],
            description='Serve a page for browsers at http://127.0.0.1:8000/.'),
        DeclareLaunchArgument(
            'rviz', default_value='false', choices=['true', 'false'],
            description='Start rviz2 (if it is installed) with config/layouts/tap_ros.rviz.'),
        DeclareLaunchArgument(
            'use_sim_time', default_value=LaunchConfiguration('sim'), choices=['true', 'false'],
            description='All but the simulation take the time from /clock.'),
        OpaqueFunction(function=check, args=[files, LaunchConfiguration('rviz')]),
        start('sim_node', {
            'lock_step': typed('lock_step', bool), 'objects': typed('objects', str)},
            condition=IfCondition(LaunchConfiguration('sim'))),
        start('tracker_node', condition=IfCondition(
            EqualsSubstitution(LaunchConfiguration('objects'), 'tracked'))),
        start('predictor_node'),
        start('visual_mpc_node'),
        start('recorder_node', {'folder': typed('record', str)},
              condition=IfCondition(NotEqualsSubstitution(record, ''))),
        start('robot_mask_node', condition=IfCondition(LaunchConfiguration('mask'))),
        start('explorer_node', condition=IfCondition(LaunchConfiguration('explorer'))),
        Node(
            package='rviz2', executable='rviz2', output='screen',
            namespace=LaunchConfiguration('namespace'),
            remappings=[('/tf', 'tf'), ('/tf_static', 'tf_static')],
            arguments=['-d', PathJoinSubstitution(
                [FindPackageShare('tap_ros'), 'config', 'layouts', 'tap_ros.rviz'])],
            parameters=[{'use_sim_time': typed('use_sim_time', bool)}],
            condition=IfCondition(LaunchConfiguration('rviz'))),
    ])


def check(context, params_file, rviz):
    """Raise RuntimeError, before a node starts, for what is not there."""
    file = params_file.perform(context)
    if not Path(file).is_file():
        raise RuntimeError(f'params_file: {file} is not there; nothing is started')
    if rviz.perform(context) == 'true':
        try:
            FindPackageShare('rviz2').perform(context)
        except LookupError as error:
            raise RuntimeError('rviz: rviz2 is not installed; install it, or leave rviz out; '
                               'nothing is started') from error


def start(executable, parameters=None, condition=None):
    """
    Return the action that starts a node.

    :param executable: one of this package.
    :param parameters: dict of those that override the parameter file.
    :param condition: launch condition, None for always.
    """
    parameters = parameters or {}
    if executable != 'sim_node':  # which publishes /clock
        parameters['use_sim_time'] = typed('use_sim_time', bool)
    return Node(
        package='tap_ros', executable=executable, namespace=LaunchConfiguration('namespace'),
        parameters=[LaunchConfiguration('params_file'), parameters],
        # The clock of this simulation is in its namespace; another one's is not.
        remappings=[('/clock', IfElseSubstitution(LaunchConfiguration('sim'), 'clock', '/clock'))],
        # A busy machine takes longer to end a node than the 5 s after which launch would kill it.
        condition=condition, output='screen', emulate_tty=True, sigterm_timeout='20')


def typed(argument, value_type):
    """Return a launch argument as a parameter value of a type."""
    return ParameterValue(LaunchConfiguration(argument), value_type=value_type)
