# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
The topics, each once: what nodes subscribe to and publish, what is recorded, and what is read.

A new topic is a row of TOPICS; the recorder records it then. If recordings are to be read for it,
its `becomes` is a group of columns, see recording/columns.py.
"""

from dataclasses import dataclass
import re
from typing import Any

from tap_ros.base.errors import ConfigError
from tap_ros.base.text import escaped

IMAGE_TYPE, COMPRESSED_TYPE = 'sensor_msgs/msg/Image', 'sensor_msgs/msg/CompressedImage'


@dataclass(frozen=True)
class Topic:
    """
    One topic.

    :param name: relative, as nodes use it; recordings have it in any namespace.
    :param type: of its messages.
    :param becomes: what a recording's messages become, the name of columns; '': they are not read.
    :param latched: transient_local, depth 1: late joiners get it.
    :param periodic: comes with every picture.
    :param needed: a recording without it is of no use.
    :param compressed: pictures may come compressed, on NAME/compressed.
    """

    name: str
    type: str
    becomes: str = ''
    latched: bool = False
    periodic: bool = False
    needed: bool = False
    compressed: bool = False

    @property
    def types(self) -> tuple[str, ...]:
        """Types that messages may have."""
        return (self.type, COMPRESSED_TYPE) if self.compressed else (self.type,)

    @property
    def recorded(self) -> str:
        """Name in our recordings."""
        return f'/{self.name}'

    def is_called(self, topic: str) -> bool:
        """Return whether a full name is this topic's in some namespace."""
        plain = topic.removesuffix('/compressed') if self.type == IMAGE_TYPE else topic
        return plain.endswith(f'/{self.name}')


IMAGE = Topic('camera/image_raw', IMAGE_TYPE, 'frame', periodic=True, needed=True, compressed=True)
ROBOT_MASK = Topic('camera/robot_mask', IMAGE_TYPE, 'mask', compressed=True)
CAMERA_INFO = Topic('camera/camera_info', 'sensor_msgs/msg/CameraInfo', periodic=True)
CAMERA_POSE = Topic('camera/pose', 'geometry_msgs/msg/PoseStamped', latched=True)
OBJECTS = Topic('objects', 'tap_msgs/msg/ObjectStates', 'object', periodic=True)
JOINT_STATES = Topic('joint_states', 'sensor_msgs/msg/JointState', 'joint', periodic=True)
# Numbers by name, of whatever the robot measures; joints of which nothing is known move no arm.
SIGNALS = Topic('signals', JOINT_STATES.type, 'signal')
TWIST = Topic('arm/delta_twist_cmds', 'geometry_msgs/msg/TwistStamped', 'twist')
# Seconds that one of these velocities is meant for. Recordings without it have metres instead.
CONTROL_PERIOD = Topic('arm/control_period', 'std_msgs/msg/Float64', 'period', latched=True)
GRIPPER_COMMAND = Topic('gripper/command', 'std_msgs/msg/Float64', 'command')
GOAL_IMAGE = Topic('goal/image', IMAGE_TYPE, 'goal', latched=True, compressed=True)
GOAL_ROBOT_MASK = Topic('goal/robot_mask', IMAGE_TYPE, 'goal_mask', latched=True,
                        compressed=True)
GOAL_OBJECTS = Topic('goal/objects', 'tap_msgs/msg/ObjectStates', 'goal_object', latched=True)
# What a simulator knows where the objects are tracked: to measure only.
TRUE_OBJECTS = Topic(f'truth/{OBJECTS.name}', OBJECTS.type)
TRUE_GOAL_OBJECTS = Topic(f'truth/{GOAL_OBJECTS.name}', OBJECTS.type, latched=True)
EPISODE = Topic('episode', 'tap_msgs/msg/Episode', 'mark')
CLOCK = Topic('clock', 'rosgraph_msgs/msg/Clock')
MODEL_CARDS = tuple(Topic(f'{node}/model_card', 'std_msgs/msg/String', latched=True)
                    for node in ('predictor_node', 'visual_mpc_node'))
TOPICS = (
    IMAGE, ROBOT_MASK, CAMERA_INFO, CAMERA_POSE, OBJECTS, JOINT_STATES, SIGNALS, TWIST,
    CONTROL_PERIOD, GRIPPER_COMMAND, GOAL_IMAGE, GOAL_ROBOT_MASK, GOAL_OBJECTS, TRUE_OBJECTS,
    TRUE_GOAL_OBJECTS, EPISODE, CLOCK,
    Topic('subgoal', 'tap_msgs/msg/Subgoal', latched=True),
    Topic('subgoal/image', IMAGE_TYPE, latched=True),
    Topic('subgoal/overlay', IMAGE_TYPE, latched=True),
    Topic('plan/distance', 'std_msgs/msg/Float64'), *MODEL_CARDS)
BY_NAME = {topic.name: topic for topic in TOPICS}
BY_COLUMNS = {topic.becomes: topic for topic in TOPICS if topic.becomes}


def camera_view(name: str) -> Topic:
    """
    Return the topic of another camera that saw the same; nothing takes it for IMAGE.

    :param name: letters, digits and underscores, such as wrist.
    :raises ConfigError: for another name, and for IMAGE's own.
    """
    topic = Topic(f'camera/{name}/image_raw', IMAGE_TYPE)
    if not re.fullmatch('[A-Za-z][A-Za-z0-9_]*', name) or IMAGE.is_called(topic.recorded):
        raise ConfigError(f'{escaped(name, 60)!r} is no name of another camera; expected one such '
                          'as wrist: letters, digits and underscores, and not camera')
    return topic


@dataclass(frozen=True)
class Qos:
    """The quality of service that a publisher offers, as far as it differs between our topics."""

    depth: int = 10
    reliability: str = 'reliable'  # or 'best_effort'
    durability: str = 'volatile'  # or 'transient_local'

    def profile(self) -> dict[str, Any]:
        """Return what rosbag2 writes about it."""
        infinite = {'sec': 9223372036, 'nsec': 854775807}
        return {
            'history': 'keep_last', 'depth': self.depth, 'reliability': self.reliability,
            'durability': self.durability, 'deadline': infinite, 'lifespan': infinite,
            'liveliness': 'automatic', 'liveliness_lease_duration': infinite,
            'avoid_ros_namespace_conventions': False}


def default_qos(topic: str) -> Qos:
    """Return the Qos of a topic of this package, in any namespace; others stream."""
    if any(one.latched and one.becomes and one.is_called(topic) for one in TOPICS):
        return Qos(depth=1, durability='transient_local')
    return Qos()
