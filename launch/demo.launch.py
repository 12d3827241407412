# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Run the demo on nodes that launch starts: what `make demo` does, with the ros2 command.

The driver of the demo resets the scenes, sends the goals, and prints the table; when it ends,
everything ends.
"""

from launch import LaunchDescription
from launch.actions import (
    DeclareLaunchArgument,
    ExecuteProcess,
    IncludeLaunchDescription,
    Shutdown,
)
from launch.launch_description_sources import PythonLaunchDescriptionSource
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
from launch_ros.substitutions import FindPackageShare


def generate_launch_description():
    """Describe the nodes of nodes.launch.py, in lock-step, and the driver of the demo."""
    nodes = PathJoinSubstitution([FindPackageShare('tap_ros'), 'launch', 'nodes.launch.py'])
    # python3 of the shell, like the nodes: ros2 itself may run with another one.
    driver = ['python3', '-m', 'tap_ros', 'demo', '--attach',
              '--scenes', LaunchConfiguration('scenes'),
              '--objects', LaunchConfiguration('objects')]
    return LaunchDescription([
        DeclareLaunchArgument('scenes', default_value='3', description='How many scenes to push.'),
        DeclareLaunchArgument(
            'objects', default_value='tracked', choices=['tracked', 'truth'],
            description='Where the objects come from: clicks and a tracker, or the simulation.'),
        DeclareLaunchArgument(
            'record', default_value='runs/demo-recording', description='Folder to record into.'),
        IncludeLaunchDescription(
            PythonLaunchDescriptionSource(nodes),
            launch_arguments={
                'lock_step': 'true', 'objects': LaunchConfiguration('objects'),
                'record': LaunchConfiguration('record')}.items()),
        ExecuteProcess(cmd=driver, name='demo', output='screen', emulate_tty=True,
                       on_exit=Shutdown(reason='the demo has ended')),
    ])
