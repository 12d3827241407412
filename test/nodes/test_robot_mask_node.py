# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""robot_mask_node: masks with the stamps of the pictures, or the reason; and what fills them."""

from importlib.util import find_spec
import time

from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import TwistStamped
from made_bags import decode_gripper
import numpy as np
from processes import Client, LocalNode, Newest, NodeProcess, until
import pytest
from sensor_msgs.msg import CameraInfo, Image, JointState
from std_msgs.msg import Header, String
from tap_ros.base.contract import CONTROL_PERIOD, ROBOT_MASK_ARM, ROBOT_MASK_FREE, ROBOT_MASK_HAND
from tap_ros.base.errors import ImageError, TapError
from tap_ros.messages.images import decode_camera_info, decode_mask
from tap_ros.messages.stamps import to_nanoseconds
from tap_ros.nodes.robot_mask.node import RobotMaskNode
from tap_ros.robots.ur10e import UR10E
from tap_ros.ros.robot_view import RobotView
from tap_ros.ros.topics import encode_camera_info, encode_image, LATCHED, STREAM, to_stamp

CAMERA = {  # of the simulator with its arm: 0.84 rad from straight down
    'camera_y': -1.36, 'camera_z': 1.33,
    'camera_qx': np.cos(0.42), 'camera_qy': 0.0, 'camera_qz': 0.0, 'camera_qw': -np.sin(0.42)}
SCENE = np.random.default_rng(0).integers(0, 256, (6, 9, 3), np.uint8)


@pytest.fixture(scope='module')
def sim(tmp_path_factory):
    """Start a simulator that shows the arm, to people too."""
    process = NodeProcess(
        'sim_node', tmp_path_factory.mktemp('sim') / 'log.txt',
        {'lock_step': 'true', 'seed': 3, 'look': 'arm', 'observer': 'true', 'image_size': 64})
    yield process.wait_for('ready')
    process.end()


def test_masks_have_the_stamps_of_the_pictures_and_cover_the_arm(sim, client):
    for i, shape in enumerate((  # by topic, our own
            CAMERA, CAMERA | {'urdf': 'ur10e', 'hand_radius': 0.04},
            *([{}] if find_spec('tf2_msgs') else []))):  # the camera by tf
        node = LocalNode(RobotMaskNode, remaps={'camera/robot_mask': f'own_mask{i}'}, **shape,
                         shadow=True, light_x=0.45, light_y=0.28)
        try:
            true, own = (Newest(client, Image, topic, STREAM)
                         for topic in ('camera/robot_mask', f'own_mask{i}'))
            message = own.wait(30)
            simulated = true.wait(
                10, lambda m, stamp=message.header.stamp: m.header.stamp == stamp)
        finally:
            node.end()
        assert message.header == simulated.header
        mask, wanted = (decode_mask(m, 'mask', (64, 64)) for m in (message, simulated))
        arm = wanted == ROBOT_MASK_ARM
        assert (mask[arm] != ROBOT_MASK_FREE).mean() > 0.97
        assert (mask[wanted == ROBOT_MASK_FREE] == ROBOT_MASK_FREE).mean() > 0.88
        assert (mask == ROBOT_MASK_HAND).any() == ('urdf' in shape)


def test_the_simulator_tells_where_its_robot_is(sim, client):
    image, mask, aside = (Newest(client, Image, topic, STREAM) for topic in (
        'camera/image_raw', 'camera/robot_mask', 'observer/image_raw'))
    joints = Newest(client, JointState, 'joint_states', STREAM)
    twist = client.create_publisher(TwistStamped, 'arm/delta_twist_cmds', STREAM)
    assert Newest(client, String, 'robot_description', LATCHED).wait(10).data.startswith('<?xml')
    goal_mask = Newest(client, Image, 'goal/robot_mask', LATCHED).wait(10)
    assert decode_mask(goal_mask, 'mask', (64, 64)).any()

    command = TwistStamped(header=image.wait(10).header)
    assert aside.wait(10).header == command.header, 'who comes late is shown it, too'
    command.twist.linear.x = 0.05 / CONTROL_PERIOD
    before = decode_gripper(joints.wait(10))
    twist.publish(command)
    then = to_nanoseconds(command.header.stamp) + round(CONTROL_PERIOD * 1e9)
    _, shown, seen, told = (
        topic.wait(10, lambda m: to_nanoseconds(m.header.stamp) == then)
        for topic in (image, mask, aside, joints))
    assert set(np.unique(decode_mask(shown, 'mask', (64, 64)))) == {
        ROBOT_MASK_FREE, ROBOT_MASK_HAND, ROBOT_MASK_ARM}
    assert seen.height == 384
    assert until(lambda: image.count > 5) and aside.count == 2, 'and it is drawn once'
    angles = dict(zip(told.name, told.position, strict=True))
    gripper = UR10E.gripper_at([angles[name] for name in UR10E.joints])
    assert np.allclose(gripper, decode_gripper(told)[:3], atol=1e-6)
    assert gripper[0] - before[0] > 0.03


@pytest.mark.errors('no robot mask: ')
def test_without_a_robot_or_its_joints_there_is_no_mask_and_the_reason(client):
    cameras = client.create_publisher(CameraInfo, 'alone/camera/camera_info', STREAM)
    diagnostics = Newest(client, DiagnosticArray, '/diagnostics', 10)
    camera = encode_camera_info(np.eye(3), (64, 64), to_stamp(10**9), 'eye')
    client.create_timer(0.1, lambda: cameras.publish(camera))
    for parameters, words in (
            (CAMERA, 'nothing that can be used has come on robot_description'),
            (CAMERA | {'urdf': 'ur10e'}, 'nothing is known of shoulder_pan_joint')):
        node = LocalNode(RobotMaskNode, '/alone', **parameters)

        def tells_why(message, words=words):
            return any(words in pair.value for status in message.status for pair in status.values)

        try:
            diagnostics.wait(30, tells_why)
        finally:
            node.end()


def test_joints_that_wait_behind_the_picture_are_taken_before_it_is_given_up(client, capfd):
    masks = Newest(client, Image, 'slow/camera/robot_mask', STREAM)
    cameras, joints = (client.create_publisher(kind, f'slow/{name}', STREAM) for kind, name in (
        (CameraInfo, 'camera/camera_info'), (JointState, 'joint_states')))
    node = LocalNode(RobotMaskNode, '/slow', **CAMERA, urdf='ur10e')
    try:
        assert until(cameras.get_subscription_count) and until(joints.get_subscription_count)
        begun = []
        busy = node.node.create_timer(
            0.01, lambda: (busy.cancel(), begun.append(busy), time.sleep(2.0)))
        assert until(lambda: begun)
        for stamp in (10**9, 2 * 10**9):
            joints.publish(JointState(
                header=Header(stamp=to_stamp(stamp)), name=UR10E.joints, position=[0.0] * 6))
        cameras.publish(encode_camera_info(np.eye(3), (64, 64), to_stamp(2 * 10**9), 'eye'))
        assert masks.wait(20).header.stamp.sec == 2
    finally:
        node.end()
    assert 'ERROR' not in capfd.readouterr().err


def test_of_two_cameras_and_of_what_fails_there_is_no_mask_and_the_reason(client, capfd):
    diagnostics = Newest(client, DiagnosticArray, '/diagnostics', 10)
    node = LocalNode(RobotMaskNode, '/pair', **CAMERA, urdf='ur10e')
    camera = encode_camera_info(np.eye(3), (64, 64), to_stamp(10**9), 'eye')

    def told(words):
        return diagnostics.wait(30, lambda message: any(
            words in pair.value for status in message.status for pair in status.values))

    try:
        with Client('left_eye') as left, Client('right_eye') as right:
            publishers = [one.create_publisher(CameraInfo, '/pair/camera/camera_info', STREAM)
                          for one in (left, right)]
            left.create_timer(0.1, lambda: publishers[0].publish(camera))
            told('2 nodes publish on /pair/camera/camera_info, /left_eye, /right_eye')
        assert until(lambda: not client.count_publishers('/pair/camera/camera_info'))
        assert until(lambda: not node.node._waiting)
        cameras = client.create_publisher(CameraInfo, '/pair/camera/camera_info', STREAM)
        assert until(cameras.get_subscription_count)
        tried, last = [], 2 * 10**9  # one of the pictures before may still be on its way

        def fail(stamp_ns, *_):
            tried.append(stamp_ns)
            return 1 / 0

        node.node._history.at = fail
        cameras.publish(encode_camera_info(np.eye(3), (64, 64), to_stamp(last), 'eye'))
        assert until(lambda: last in tried)
        told('division by zero')
        assert until(lambda: not node.node._waiting)
    finally:
        assert not node.end()
    assert tried.count(last) == 1
    assert capfd.readouterr().err.count('ZeroDivisionError') == len(tried)


def test_a_bad_start_names_the_parameter():
    for parameters, words in (
            ({'urdf': '/nowhere.urdf'}, '/nowhere.urdf is no file'),
            ({'urdf': 'ur10e', 'base_frame': 'nowhere'}, 'no link nowhere; it has world, base'),
            ({'shadow': True, 'light_z': 1.0}, 'light_z: is 1; expected less than 0'),
            ({'camera_qx': 0.0}, 'a quaternion of no direction'),
            ({'dilation': -1.0}, 'dilation')):
        with pytest.raises(TapError, match=words):
            LocalNode(RobotMaskNode, **parameters)


def test_intrinsics_are_those_of_the_pictures_that_are_sent():
    K = np.array([[500.0, 0, 320], [0, 510, 240], [0, 0, 1]])
    message = encode_camera_info(K, (480, 640), to_stamp(1), 'eye')
    found, size = decode_camera_info(message, False)
    np.testing.assert_array_equal(found, K)
    assert size == (480, 640)
    message.roi.x_offset, message.roi.width, message.roi.height = 80, 480, 480
    message.binning_x = message.binning_y = 4
    found, size = decode_camera_info(message, True)  # p is the same
    np.testing.assert_array_equal(found, [[125, 0, 60], [0, 127.5, 60], [0, 0, 1]])
    assert size == (120, 120)
    for name, value, words in (
            ('d', [0.1, 0.0], 'bends straight lines'), ('k', [np.nan] * 9, 'k is not that of'),
            ('height', 0, '64x0 pixels')):
        message = encode_camera_info(np.eye(3), (64, 64), to_stamp(1), 'eye')
        setattr(message, name, value)
        with pytest.raises(ImageError, match=words):
            decode_camera_info(message, False)


# Pictures without the robot


def covered(columns, seed=1):
    """Return the scene with a robot before some columns, and its mask: hand, then arm."""
    mask = np.zeros((6, 9), np.uint8)
    mask[:3, columns], mask[3:, columns] = ROBOT_MASK_HAND, ROBOT_MASK_ARM
    noise = np.random.default_rng(seed).integers(0, 256, SCENE.shape, np.uint8)
    return np.where(mask[..., None] > 0, noise, SCENE), mask


def mask_message(mask, stamp=1, padding=2, **changes):
    """Make a message whose rows are padded."""
    rows = np.pad(mask, ((0, 0), (0, padding)), constant_values=7)
    message = Image(height=mask.shape[0], width=mask.shape[1], encoding='mono8',
                    step=rows.shape[1], data=rows.tobytes())
    message.header.stamp = to_stamp(stamp)
    for name, value in changes.items():
        setattr(message, name, value)
    return message


def see(view, columns, stamp, jumps=0):
    picture, mask = covered(columns, stamp)
    return view.see(encode_image(picture, to_stamp(stamp), 'eye'), mask_message(mask, stamp),
                    jumps)


def test_what_was_seen_last_takes_the_place_of_the_robot_until_another_scene_begins():
    goal, mask = covered([7], 5)
    for jumps in (0, 1):
        view = RobotView('all')
        np.testing.assert_array_equal(see(view, [0, 1], 10), covered([0, 1], 10)[0])
        np.testing.assert_array_equal(view.fill_goal(goal, mask_message(mask)), SCENE)
        np.testing.assert_array_equal(see(view, [4, 5], 20), SCENE)
        older = see(view, [8], 15)  # filled, and not remembered
        np.testing.assert_array_equal(older, SCENE)
        np.testing.assert_array_equal(see(view, [0, 1], 30), SCENE)
        if not jumps:
            view.clear()
        # The same stamps may come again.
        np.testing.assert_array_equal(see(view, [3], 20, jumps), covered([3], 20)[0])
        np.testing.assert_array_equal(see(view, [5], 30, jumps), SCENE)


def test_masks_are_read_padded_or_refused_with_the_reason():
    mask = covered([2])[1]
    np.testing.assert_array_equal(decode_mask(mask_message(mask), 'mask', (6, 9)), mask)
    free = np.zeros((6, 9), np.uint8)
    for message, words in (
            (mask_message(free + 1), 'mask: a robot mask with the value 1; expected 0'),
            (mask_message(free.T), '9x6 pixels .* got 6x9'),
            (mask_message(free, encoding='rgb8'), "'rgb8' .* valid .*: mono8"),
            (mask_message(free, step=3), 'step is 3 bytes')):
        with pytest.raises(ImageError, match=words):
            decode_mask(message, 'mask', (6, 9))
