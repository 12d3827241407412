# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What several nodes share of topics: quality of service, message classes, stamps."""

from builtin_interfaces.msg import Time
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from tap_ros.messages import topics
from tap_ros.messages.topics import Topic
from tap_ros.ros.parameters import Parameters
from tap_ros.ros.ros_messages import message_class

# Reliable and kept for late joiners: goals, the last subgoal.
LATCHED = QoSProfile(depth=1, reliability=ReliabilityPolicy.RELIABLE,
                     durability=DurabilityPolicy.TRANSIENT_LOCAL)
# Reliable, for everything that happens at control rate.
STREAM = QoSProfile(depth=10, reliability=ReliabilityPolicy.RELIABLE,
                    durability=DurabilityPolicy.VOLATILE)
# Of servers: requests that wait to be taken, answers that wait to be received. Of clients: answers
# that wait to be taken, those to all other clients among them, since every client receives all.
# With the default depth of 10, DDS drops what comes beyond without a word.
SERVICE_QOS = QoSProfile(depth=1000, reliability=ReliabilityPolicy.RELIABLE)

LOCK_STEP = 'sim/lock_step'  # latched: whether simulated time passes with commands alone


def of_topic(topic: Topic) -> tuple[type, str]:
    """Return message class and name of a topic, as subscriptions take them."""
    return message_class(topic.type), topic.name


def camera_image(parameters: Parameters) -> tuple[type, str]:
    """Return message class and name of the topic of the camera's pictures."""
    if parameters['image_transport'] == 'compressed':
        return message_class(topics.COMPRESSED_TYPE), f'{topics.IMAGE.name}/compressed'
    return of_topic(topics.IMAGE)


def camera_topics(parameters: Parameters) -> dict[str, tuple[type, str]]:
    """
    Return what belongs to a picture of the camera.

    :param parameters: with image_transport and robot_mask.
    :return: {short name: (message class, topic name)}, the picture first; with the robot mask
        when one is used.
    """
    return {'image': camera_image(parameters), 'objects': of_topic(topics.OBJECTS),
            **_mask(topics.ROBOT_MASK, parameters['robot_mask'])}


def goal_topics(robot_mask: str) -> dict[str, tuple[type, str]]:
    """Return the same for the picture of a goal."""
    return {'image': of_topic(topics.GOAL_IMAGE), 'objects': of_topic(topics.GOAL_OBJECTS),
            **_mask(topics.GOAL_ROBOT_MASK, robot_mask)}


def _mask(topic: Topic, robot_mask: str) -> dict[str, tuple[type, str]]:
    return {'mask': of_topic(topic)} if robot_mask != 'none' else {}


def to_stamp(nanoseconds: int) -> Time:
    """Return builtin_interfaces/Time."""
    seconds, rest = divmod(int(nanoseconds), 10**9)
    return Time(sec=seconds, nanosec=rest)
