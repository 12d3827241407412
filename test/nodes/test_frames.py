# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The poses of fixed frames in each other, from the messages of tf_static."""

from types import SimpleNamespace

from geometry_msgs.msg import Quaternion, Transform, TransformStamped, Vector3
import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from tap_ros.ros.frames import FixedFrames


def pose(place, turn=(0, 0, 0)):
    """Return a pose (4, 4), turned by Euler angles xyz, rad."""
    found = np.eye(4)
    found[:3, :3], found[:3, 3] = Rotation.from_euler('xyz', turn).as_matrix(), place
    return found


def told(parent, child, place, quaternion):
    x, y, z, w = map(float, quaternion)
    message = TransformStamped(child_frame_id=child, transform=Transform(
        translation=Vector3(**dict(zip('xyz', map(float, place)))),
        rotation=Quaternion(x=x, y=y, z=z, w=w)))
    message.header.frame_id = parent
    return message


@pytest.fixture
def frames(client):
    """Return FixedFrames, and a function that tells it of a transform."""
    found = FixedFrames(client)

    def tell(parent, child, place, turn=(0, 0, 0)):
        quaternion = turn if len(turn) == 4 else Rotation.from_euler('xyz', turn).as_quat()
        found._take(SimpleNamespace(transforms=[told(parent, child, place, quaternion)]))
    return found, tell


def test_a_camera_is_found_through_frames_between_it_and_the_base(frames):
    found, tell = frames
    assert found.pose('eye', 'world') is None
    tell('world', 'table', (0, 0, 0.7), (0, 0, 1.0))
    tell('/table', 'base', (1, 0, 0), (0, 0.5, 0))
    tell('mast', 'eye', (0, 0, 0.1), (np.pi, 0, 0))
    assert found.pose('eye', 'base') is None
    tell('world', 'mast', (0, -1, 1), (0.3, 0, 0))
    table, base = pose((0, 0, 0.7), (0, 0, 1)), pose((1, 0, 0), (0, 0.5, 0))
    eye = pose((0, -1, 1), (0.3, 0, 0)) @ pose((0, 0, 0.1), (np.pi, 0, 0))
    np.testing.assert_allclose(found.pose('eye', 'world'), eye, atol=1e-12)
    np.testing.assert_allclose(
        table @ base @ found.pose('eye', 'base'), eye, atol=1e-12)
    np.testing.assert_allclose(found.pose('world', 'world'), np.eye(4))
    tell('world', 'mast', (0, 5, 1))  # somebody has moved it
    assert found.pose('eye', 'world')[1, 3] == 5


def test_what_is_no_pose_is_ignored_and_circles_end(frames, capfd):
    found, tell = frames
    tell('world', 'eye', (0, 0, 1))
    for place, turn in (((np.nan, 0, 0), (0, 0, 0, 1)), ((0, 0, 0), (0, 0, 0, 0)),
                        ((1e9, 0, 0), (0, 0, 0, 1))):
        tell('world', 'eye', place, turn)
    assert found.pose('eye', 'world')[2, 3] == 1
    assert 'tf_static: eye in world is ignored' in capfd.readouterr().err
    tell('b', 'a', (0, 0, 1))
    tell('a', 'b', (0, 0, 1))
    assert found.pose('a', 'world') is None
