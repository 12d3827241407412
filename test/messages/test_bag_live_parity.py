# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
What the nodes see of some traffic is what is read from its recording, bit for bit.

The live side is the oracle: the classes that visual_mpc_node and predictor_node look at their
topics with, fed by real publishers. The same messages, serialized as the recorder has them, go
into a bag. Networks are trained on the second and served the first.
"""

import io
import time
from types import SimpleNamespace

import numpy as np
from PIL import Image as Picture
from processes import Client
import pytest
from rclpy.serialization import serialize_message
from sensor_msgs.msg import CompressedImage, Image, JointState
from tap_msgs.msg import ObjectStates
from tap_msgs.srv import PredictSubgoal
from tap_ros.base.contract import GRIPPER_JOINTS, ROBOT_MASK_ARM, ROBOT_MASK_HAND
from tap_ros.images.crop import Crop, TrainedCrop
from tap_ros.images.robot_mask import FreeView
from tap_ros.nodes.planner.planner_inputs import PlannerInputs
from tap_ros.nodes.predictor.requests import RequestReader
from tap_ros.prediction.fullsize import fit
from tap_ros.recording.cache import open_recordings
from tap_ros.recording.file_writer import BagWriter
from tap_ros.recording.reading import Reading
from tap_ros.robots.arm import DEFAULT_ARM, get_arm
from tap_ros.ros.topics import encode_image, encode_mask, encode_objects, LATCHED, STREAM, to_stamp

pytestmark = pytest.mark.ros
MS = 10**6
BEGIN, PERIOD, DRIVER = 10**10, 250 * MS, 40 * MS  # ns: of the pictures, of the joint states
COUNT, SIZE = 5, (48, 64)
ARM = get_arm(DEFAULT_ARM)
PARAMS = {
    'joint_prefix': '', 'mount_frame': '', 'fixed_opening': 0.0, 'max_silence': 0.35,
    'arm': DEFAULT_ARM,
    'mount_turn': ARM.mount.yaw, 'tool_length': ARM.mount.tool,
    **{f'mount_{axis}': value for axis, value in zip('xyz', ARM.mount.position)}}


class Given(dict):
    """Parameters of which all were given."""

    given = frozenset(PARAMS)


def pixels_of(t):
    coarse = np.random.default_rng(t).integers(0, 256, (6, 8, 3), np.uint8)
    return np.array(Picture.fromarray(coarse).resize(SIZE[::-1], Picture.Resampling.BICUBIC))


def padded(t, stamp):
    message = encode_image(pixels_of(t), stamp, 'eye')
    rows = np.pad(pixels_of(t)[..., ::-1].reshape(SIZE[0], -1), ((0, 0), (0, 5)))
    message.encoding, message.step, message.data = 'bgr8', rows.shape[1], rows.tobytes()
    return message


def mosaic(t, stamp):
    message = Image(height=SIZE[0], width=SIZE[1], step=SIZE[1], encoding='bayer_rggb8',
                    data=pixels_of(t)[..., 1].tobytes())
    message.header.stamp = stamp
    return message


def jpeg(t, stamp):
    buffer = io.BytesIO()
    Picture.fromarray(pixels_of(t)).save(buffer, 'JPEG', quality=80)
    message = CompressedImage(format='rgb8; jpeg compressed bgr8', data=buffer.getvalue())
    message.header.stamp = stamp
    return message


def states(stamp, **positions):
    message = JointState(name=list(positions), position=[float(x) for x in positions.values()])
    message.header.stamp = to_stamp(stamp)
    return message


def told(stamp):
    """Return where the gripper is at a time, by the names that the simulator has for it."""
    s = (stamp - BEGIN) / 1e9
    return dict(zip(GRIPPER_JOINTS, (0.1 * np.sin(9 * s), 0.2 * s - 0.1, 0.05, 0.5 + 0.1 * s)))


def told_at_own_times(n, stamp):
    return [states(stamp, **told(stamp))]


def told_with_pictures(n, stamp):
    stamp = BEGIN + n * PERIOD if n < COUNT else BEGIN + 10**12
    return [states(stamp, **told(stamp))] if n < COUNT else []


def arm(n, stamp):
    """Two drivers: the arm's, whose joints are in an order of its own, and the gripper's."""
    angles = dict(zip(ARM.joints, 0.3 * np.arange(6) + np.sin((stamp - BEGIN) / 3e8)))
    found = [states(stamp, **dict(sorted(angles.items())))]
    if n in (1, 9):  # now and then
        found.append(states(stamp, gripper_opening=0.1 * n))
    return found


def traffic(picture, joints):
    """Return (stamp in ns, topic, message) in the order in which they come."""
    found = []
    mask = np.zeros(SIZE, np.uint8)
    mask[10:30, 20:40], mask[30:36, 20:40] = ROBOT_MASK_ARM, ROBOT_MASK_HAND
    topic = 'camera/image_raw' + ('/compressed' if picture is jpeg else '')

    def objects(stamp, t):
        return encode_objects(
            ('cup', 'box')[::1 - 2 * (t % 2)], np.array([(20.3 + t, 24.1), (33, 11.7)]),
            [[0, 0, 0, 0, 0, 0, 1]] * 2, stamp, 'world', ObjectStates.SOURCE_TRACKED)

    goal = to_stamp(BEGIN - 900 * MS)
    for name, message in (('goal/objects', objects(goal, 7)),
                          ('goal/image', encode_image(pixels_of(99), goal, 'eye')),
                          ('goal/robot_mask', encode_mask(np.roll(mask, 3), goal, 'eye'))):
        found.append((BEGIN - 900 * MS, name, message))
    for t in range(COUNT):
        at = BEGIN + t * PERIOD
        stamp = to_stamp(at)
        found += [(at, 'objects', objects(stamp, t)),
                  (at, 'camera/robot_mask', encode_mask(np.roll(mask, 2 * t, 1), stamp, 'eye')),
                  (at, topic, picture(t, stamp))]
    for n, at in enumerate(range(BEGIN - 45 * MS, BEGIN + COUNT * PERIOD, DRIVER)):
        for message in joints(n, at):
            stamp = message.header.stamp
            found.append((stamp.sec * 10**9 + stamp.nanosec, 'joint_states', message))
    return sorted(found, key=lambda one: one[0])


def seen_live(node, other, crop, sent, compressed, robot_mask):
    """Publish messages; return {stamp: (Observation of the planner, Request to the predictor)}."""
    params = Given(PARAMS | {'image_transport': 'compressed' if compressed else 'raw',
                            'robot_mask': robot_mask})
    planner = PlannerInputs(node, params, lambda: crop, lambda name: None)
    reader = RequestReader(node, params, lambda name: None)
    predictor = SimpleNamespace(camera_crop=crop, mode='bidirectional', full_size=True)
    publishers = {topic: other.create_publisher(
        type(message), topic, LATCHED if topic.startswith('goal') else STREAM)
        for _, topic, message in sent}
    deadline = time.monotonic() + 20
    while any(publisher.get_subscription_count() < node.count_subscribers(topic)
              for topic, publisher in publishers.items()):
        assert time.monotonic() < deadline
        time.sleep(0.02)
    planner.begin(0.0)
    found, due = {}, None
    for stamp, topic, message in sent:
        publishers[topic].publish(message)
        due = stamp if topic.startswith('camera/image') else due
        if due is None or topic != 'joint_states' or 'gripper_opening' == message.name[0]:
            continue
        deadline = time.monotonic() + 10
        while due is not None:  # until the picture and a state after it have come
            seen, lacking = planner.look()
            if seen is not None and seen.stamp_ns == due:
                request = reader.read(PredictSubgoal.Request(), predictor).request
                assert np.array_equal(request.start, planner.sharp(seen)), 'not made smaller yet'
                found[due] = seen, fit(request, crop)
                due = None
            assert time.monotonic() < deadline, lacking
            time.sleep(0.01)
    return found


@pytest.mark.parametrize('picture, joints, part, robot_mask', [
    (padded, told_at_own_times, Crop('8,3,40'), 'all'),
    (mosaic, told_with_pictures, Crop('centre', 32), 'none'),
    (jpeg, arm, Crop('8,0,48'), 'arm')])
def test_what_is_seen_live_is_what_is_read_from_the_recording(
        tmp_path, picture, joints, part, robot_mask):
    sent = traffic(picture, joints)
    crop = TrainedCrop(part, SIZE, part.cut_size(SIZE))
    # A node of an earlier test that was killed may seem to publish for a while.
    with (Client('seeing', namespace='/parity') as node,
          Client('publishing', namespace='/parity') as other):
        live = seen_live(node, other, crop, sent, picture is jpeg, robot_mask)
    assert len(live) == COUNT
    with BagWriter(tmp_path / 'bag') as writer:
        for stamp, topic, message in sent:
            kind = f'{type(message).__module__.split(".")[0]}/msg/{type(message).__name__}'
            writer.write_raw(f'/{topic}', kind, serialize_message(message), stamp)
    (episode,) = open_recordings(
        tmp_path / 'bag', reading=Reading(crop=part.part, size=part.size))
    view = FreeView(robot_mask)
    assert episode.object_source == 'tracked'
    for t, stamp in enumerate(episode.stamps.tolist()):
        shown = view.update(episode.frames[t], episode.robot_masks[t])
        seen, request = live[stamp]
        np.testing.assert_array_equal(seen.image, shown)
        np.testing.assert_array_equal(seen.gripper, episode.grippers[t])
        assert seen.names == episode.object_names
        np.testing.assert_array_equal(seen.pixels, episode.object_pixels[t])
        np.testing.assert_array_equal(request.start, shown)
        np.testing.assert_array_equal(
            request.goal, view.fill(episode.goal_frame, episode.goal_mask))
        order = slice(None, None, 1 - 2 * (t % 2))  # the request has the order of the picture
        np.testing.assert_array_equal(request.start_pixels, episode.object_pixels[t][order])
        np.testing.assert_array_equal(request.goal_pixels, episode.goal_pixels[order])
