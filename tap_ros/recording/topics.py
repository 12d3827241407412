# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The topics of a recording: names, types, quality of service, and how they are found again."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from tap_ros.errors import RecordingError
from tap_ros.text import listing

IMAGE = '/camera/image_raw'
ROBOT_MASK = '/camera/robot_mask'
CAMERA_INFO = '/camera/camera_info'
OBJECTS = '/objects'
JOINT_STATES = '/joint_states'
TWIST = '/arm/delta_twist_cmds'
GRIPPER_COMMAND = '/gripper/command'
GOAL_IMAGE = '/goal/image'
GOAL_ROBOT_MASK = '/goal/robot_mask'
GOAL_OBJECTS = '/goal/objects'
EPISODE = '/episode'
CLOCK = '/clock'

COMPRESSED = 'sensor_msgs/msg/CompressedImage'  # the camera's pictures may have this type
TYPES = {
    IMAGE: 'sensor_msgs/msg/Image',
    ROBOT_MASK: 'sensor_msgs/msg/Image',
    CAMERA_INFO: 'sensor_msgs/msg/CameraInfo',
    OBJECTS: 'tap_msgs/msg/ObjectStates',
    JOINT_STATES: 'sensor_msgs/msg/JointState',
    TWIST: 'geometry_msgs/msg/TwistStamped',
    GRIPPER_COMMAND: 'std_msgs/msg/Float64',
    GOAL_IMAGE: 'sensor_msgs/msg/Image',
    GOAL_ROBOT_MASK: 'sensor_msgs/msg/Image',
    GOAL_OBJECTS: 'tap_msgs/msg/ObjectStates',
    EPISODE: 'tap_msgs/msg/Episode',
    CLOCK: 'rosgraph_msgs/msg/Clock',
}
# transient_local, depth 1: late joiners get it
LATCHED = frozenset({GOAL_IMAGE, GOAL_ROBOT_MASK, GOAL_OBJECTS})
PICTURES = frozenset({IMAGE, ROBOT_MASK, GOAL_IMAGE, GOAL_ROBOT_MASK})


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
    """Return the Qos of a topic of this package, in any namespace."""
    if any(topic == name or topic.endswith(name) for name in LATCHED):
        return Qos(depth=1, durability='transient_local')
    return Qos()


def resolve(available: Mapping[str, str], source: str,
            image_topic: str = '') -> dict[str, str]:
    """
    Find the topics of a recording, in whatever namespace they are.

    :param available: dict topic -> type of what the recording holds.
    :param source: what messages call the recording.
    :param image_topic: the camera's topic; by default the one that ends in /camera/image_raw, else
        the only one of images, compressed or not; X/compressed beside X does not count.
    :return: dict from the names above to topics of the recording; what it lacks is left out.
    :raises RecordingError: without an image topic, or when several would do.
    """
    known = listing((f'{t} ({k})' for t, k in sorted(available.items())), 20) or 'none'
    if image_topic and available.get(image_topic) not in (TYPES[IMAGE], COMPRESSED):
        raise RecordingError(
            f'{source}: no topic {image_topic} of type {TYPES[IMAGE]} or {COMPRESSED}; topics '
            f'found: {known}')
    found = {IMAGE: image_topic} if image_topic else {}
    for name, kind in TYPES.items():
        if name in found or name in (CAMERA_INFO, CLOCK):
            continue
        candidates = [
            topic for topic in available
            if topic.endswith(name) and available[topic] == kind
            and not any(longer.endswith(name) and longer != name and topic.endswith(longer)
                        for longer in TYPES)]
        space = found[IMAGE].removesuffix(IMAGE) if found.get(IMAGE, '').endswith(IMAGE) else ''
        if space + name in candidates:
            candidates = [space + name]
        if len(candidates) > 1:
            raise RecordingError(
                f'{source}: several topics could be {name}: {listing(sorted(candidates))}; '
                'name the camera topic (image_topic, --image-topic) whose namespace is wanted')
        if candidates:
            found[name] = candidates[0]
    if IMAGE not in found:
        images = [topic for topic, kind in available.items()
                  if kind == TYPES[IMAGE] and topic not in found.values()]
        # Of a camera that is there raw, too, nothing more is learned from the compressed pictures.
        images += [topic for topic, kind in available.items() if kind == COMPRESSED
                   and topic.removesuffix('/compressed') not in images]
        if len(images) != 1:
            raise RecordingError(
                f'{source}: no topic ends in {IMAGE} with type {TYPES[IMAGE]}; name the camera '
                'topic (image_topic, --image-topic) if it is called otherwise; topics found: '
                f'{known}')
        found[IMAGE] = images[0]
    return found
