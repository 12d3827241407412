# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What the simulator's node publishes of a world: its clock, pictures, objects, joints and tf."""

from collections.abc import Iterable
from importlib.util import find_spec
from typing import Any

from builtin_interfaces.msg import Time
from geometry_msgs.msg import PoseStamped
import mujoco
import numpy as np
from rclpy.node import Node
from rclpy.qos import QoSProfile
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import CameraInfo, Image, JointState
from sim_bridge.world.protocol import ability, Observation, World
from std_msgs.msg import String
from tap_msgs.msg import ObjectStates
from tap_ros.base.contract import CAMERA_FRAME, WORLD_FRAME
from tap_ros.messages import topics
from tap_ros.robots.arm import Transform
from tap_ros.robots.description import robot_description
from tap_ros.ros import topics as ros_topics
from tap_ros.ros.topics import LATCHED, STREAM

STREAMS = {'clock': Clock, 'joint_states': JointState, 'objects': ObjectStates,
           'camera/camera_info': CameraInfo, 'camera/robot_mask': Image, 'camera/image_raw': Image}
GOAL = {'goal/objects': ObjectStates, 'goal/image': Image, 'goal/robot_mask': Image}


class ScenePublishers:
    """
    Publishes what is seen of a world.

    :param node: rclpy Node.
    :param world: World; the description of its arm is latched.
    :param observer: publish observer/image_raw as well, the camera's view with the whole arm. It
        is costly: drawn for those who look, and sent again only for those who have come since.
    :param tracked: publish objects and goal/objects under truth/: tracker_node publishes its own.
    """

    def __init__(self, node: Node, world: World, observer: bool, tracked: bool) -> None:
        self._newest: dict[str, Any] = {}  # topic -> the message sent last
        beside = 'truth/' if tracked else ''
        self._publishers = {topic: node.create_publisher(
            kind, f'{beside if kind is ObjectStates else ""}{topic}', qos)
            for kinds, qos in ((STREAMS, STREAM), (GOAL, LATCHED))
            for topic, kind in kinds.items()}
        self._observer = None
        if observer:
            ability(world, 'observer_picture')  # refuses a world without
            self._observer = node.create_publisher(Image, 'observer/image_raw', STREAM)
        self._pose = node.create_publisher(PoseStamped, topics.CAMERA_POSE.name, LATCHED)
        self._description = node.create_publisher(String, 'robot_description', LATCHED)
        if world.arm is not None:
            self._description.publish(String(data=robot_description(world.arm)))
        self._moving = self._fixed = None
        if find_spec('tf2_msgs') is not None:  # no wheel has it
            from tf2_msgs.msg import TFMessage
            # Qualities as of tf2_ros' broadcasters; in its namespace, as frames have no prefix.
            self._moving = node.create_publisher(TFMessage, 'tf', QoSProfile(depth=100))
            self._fixed = node.create_publisher(TFMessage, 'tf_static', LATCHED)

    def moment(self, world: World, seen: Observation, stamp: Time) -> None:
        """Publish a moment; its transforms once: listeners warn of a second time."""
        arm = world.arm
        self._newest = {
            'clock': Clock(clock=stamp),
            'joint_states': ros_topics.encode_joints(
                seen.gripper, stamp, WORLD_FRAME,
                dict(zip(arm.joints, seen.arm_joints)) if arm is not None else None),
            'objects': _objects(seen, stamp),
            'camera/camera_info': ros_topics.encode_camera_info(
                world.camera_matrix, seen.image.shape[:2], stamp, CAMERA_FRAME),
            'camera/image_raw': ros_topics.encode_image(seen.image, stamp, CAMERA_FRAME),
            'camera/robot_mask': ros_topics.encode_mask(seen.robot_mask, stamp, CAMERA_FRAME)}
        self._world, self._viewers = world, 0  # who has been sent the observer's picture of it
        if arm is not None:
            _send(self._moving, arm.transforms(seen.arm_joints), stamp)
        self.send_newest()

    def send_newest(self) -> None:
        """Send the newest moment, again if need be."""
        for topic, message in self._newest.items():
            self._publishers[topic].publish(message)
        if self._observer is not None:
            before, self._viewers = self._viewers, self._observer.get_subscription_count()
            if self._viewers > before:
                self._observer.publish(ros_topics.encode_image(
                    ability(self._world, 'observer_picture')(), self._newest['clock'].clock,
                    CAMERA_FRAME))

    def goal(self, goal: Observation, stamp: Time) -> None:
        """Publish the goal of a scene."""
        self._publishers['goal/objects'].publish(_objects(goal, stamp))
        self._publishers['goal/image'].publish(
            ros_topics.encode_image(goal.image, stamp, CAMERA_FRAME))
        self._publishers['goal/robot_mask'].publish(
            ros_topics.encode_mask(goal.robot_mask, stamp, CAMERA_FRAME))

    def frames(self, world: World, stamp: Time) -> None:
        """Tell where the cameras and the ends of the arm are in this scene."""
        fixed = [] if world.arm is None else world.arm.fixed_transforms
        if world.camera_pose is not None:
            fixed.append(Transform(WORLD_FRAME, CAMERA_FRAME, world.camera_pose))
            place, turn = _fields(world.camera_pose)
            self._pose.publish(ros_topics.make_message(PoseStamped, {
                'header': {'stamp': {'sec': stamp.sec, 'nanosec': stamp.nanosec},
                           'frame_id': WORLD_FRAME},
                'pose': {'position': place, 'orientation': turn}}))
        _send(self._fixed, fixed, stamp)


def _objects(observation: Observation, stamp: Time) -> ObjectStates:
    """Encode the objects of an Observation, which come from the simulator itself."""
    return ros_topics.encode_objects(
        observation.object_names, observation.object_pixels, observation.object_poses, stamp,
        WORLD_FRAME, ObjectStates.SOURCE_GROUND_TRUTH)


def _send(publisher: Any, transforms: Iterable[Transform], stamp: Time) -> None:
    """Publish transforms, where there is a publisher."""
    if publisher is None:
        return
    fields = []
    for parent, child, pose in transforms:
        place, turn = _fields(pose)
        fields.append({
            'header': {'stamp': {'sec': stamp.sec, 'nanosec': stamp.nanosec}, 'frame_id': parent},
            'child_frame_id': child,
            'transform': {'translation': place, 'rotation': turn}})
    publisher.publish(ros_topics.make_message(publisher.msg_type, {'transforms': fields}))


def _fields(pose: np.ndarray) -> tuple[dict[str, float], dict[str, float]]:
    """Return the fields of place and orientation of a pose (4, 4)."""
    quaternion = np.empty(4)  # w, x, y, z
    mujoco.mju_mat2Quat(quaternion, pose[:3, :3].ravel())
    return dict(zip('xyz', pose[:3, 3].tolist())), dict(zip('wxyz', quaternion.tolist()))
