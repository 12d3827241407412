# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What a URDF says: poses of links, corners of shapes, and refusals in one line."""

import mujoco
import numpy as np
import pytest
from tap_ros.base.errors import ConfigError
from tap_ros.robots.urdf import read_urdf

ARM = """<robot name="r">
  <link name="a"><collision><origin xyz="0 0 1" rpy="0.1 0.2 0.3"/>
    <geometry><box size="1 2 3"/></geometry></collision></link>
  <link name="b"><collision><geometry><capsule radius="0.5" length="2"/></geometry></collision>
  </link>
  <link name="c"/><link name="d"/>
  <joint name="turn" type="revolute"><parent link="a"/><child link="b"/>
    <origin xyz="1 0 0" rpy="0.4 -0.5 0.6"/><axis xyz="1 2 3"/></joint>
  <joint name="slide" type="prismatic"><parent link="b"/><child link="c"/>
    <axis xyz="0 1 0"/></joint>
  <joint name="follow" type="prismatic"><parent link="b"/><child link="d"/>
    <axis xyz="0 -1 0"/><mimic joint="slide" multiplier="2" offset="0.1"/></joint>
</robot>"""


def in_mujoco(text, positions):
    """Return {link: pose (4, 4)} as MuJoCo finds them."""
    spec = mujoco.MjSpec.from_string(text)
    spec.compiler.fusestatic = False
    for body in spec.bodies[1:]:
        body.mass, body.inertia, body.explicitinertial = 1, [1, 1, 1], True
    data = mujoco.MjData(spec.compile())
    for name, position in positions.items():
        data.joint(name).qpos = position
    mujoco.mj_kinematics(data.model, data)
    poses = {}
    for i in range(data.model.nbody):
        pose = poses[data.model.body(i).name] = np.eye(4)
        pose[:3, :3], pose[:3, 3] = data.xmat[i].reshape(3, 3), data.xpos[i]
    return poses


def test_links_are_where_mujoco_has_them():
    robot = read_urdf(ARM, 'arm')
    assert robot.positions == ('turn', 'slide') and robot.links == ('a', 'b', 'c', 'd')
    found = robot.poses({'turn': 0.7, 'slide': 0.3})
    wanted = in_mujoco(ARM, {'turn': 0.7, 'slide': 0.3, 'follow': 2 * 0.3 + 0.1})
    for link in 'bcd':
        np.testing.assert_allclose(found[link], wanted[link], atol=1e-6)


def test_corners_contain_the_shapes_and_little_more():
    box, capsule = (shape.corners for shape in read_urdf(ARM, 'arm').shapes)
    assert np.isclose(np.linalg.norm(box - [0, 0, 1], axis=1), np.sqrt(14) / 2).all()
    directions = np.random.default_rng(0).normal(size=(500, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    reach = (capsule @ directions.T).max(0)
    true = 0.5 + np.abs(directions[:, 2])
    assert (reach >= true - 1e-9).all() and (reach <= 1.03 * true).all()


@pytest.mark.parametrize('old, new, words', [
    ('<box size="1 2 3"/>', '<mesh filename="a.stl"/>', 'link a has a mesh; expected box'),
    ('child link="b"', 'child link="x"', 'joint turn holds a link that is not there'),
    ('child link="c"', 'child link="b"', 'no tree'),
    ('<collision>', '<visual>', 'is no URDF'),
    ('radius="0.5"', 'radius="nan"', 'radius="nan"; expected numbers'),
    ('<parent link="a"/>', '', 'joint turn lacks its parent')])
def test_what_cannot_be_used_is_refused_in_one_line(old, new, words):
    assert old in ARM
    with pytest.raises(ConfigError, match='arm: .*' + words) as told:
        read_urdf(ARM.replace(old, new, 1), 'arm')
    assert '\n' not in str(told.value)
