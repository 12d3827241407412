# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""An arm from a foreign URDF: axes and frames of any direction, meshes, refusals in one line."""

import numpy as np
import pytest
from tap_ros.base.errors import ConfigError, KinematicsError
from tap_ros.robots.arm import Mount
from tap_ros.robots.from_urdf import arm_from_urdf
from test_urdf import in_mujoco

LIMIT = '<limit lower="-2" upper="2.5" velocity="3" effort="50"/>'
JOINTS = [  # name, type, place, roll pitch yaw, axis
    ('stand', 'fixed', '0.1 0 0.2', '0 0 1.5707963267948966', '0 0 1'),
    ('a', 'revolute', '0 0 0.3', '0.1 1.5707963267948966 0.2', '0 1 0'),
    ('finger', 'prismatic', '0 0 0', '0 0 0', '1 0 0'),
    ('b', 'continuous', '0.4 0 0', '0 -1.5707963267948966 0', '1 2 -3'),
    ('bend', 'fixed', '0 0.1 0', '-0.7 0.3 2.0', '0 0 1'),
    ('c', 'revolute', '0.3 0.1 0', '0 0 0', '0 0 -1'),
    ('d', 'revolute', '0 0.2 0', '1 2 3', '-1 0 0'),
    ('e', 'revolute', '0 0.2 0.1', '3.141592653589793 0 0', '0 1 0.5'),
    ('f', 'revolute', '0.1 0 0', '0 1.2 0', '0 1 0'),
    ('tool', 'fixed', '0 0 0.1', '0 0.4 0', '0 0 1')]
PARENTS = {'a': 'stand', 'finger': 'tool', 'b': 'a'}
NAMES = tuple('abcdef')
START = np.array([0.2, 0.5, -0.4, 0.9, 0.1, 0.3])
MOUNT = Mount((0.1, 0.2, 0.0), 0.4, 0.15)


def text(**changes):
    """Return the URDF, with links of meshes; changes: {joint: its limit}."""
    parts, parent = ['<robot name="r"><link name="root"/>'], 'root'
    for name, kind, place, turn, axis in JOINTS:
        parts.append(
            f'<link name="{name}_link"><collision><geometry><mesh filename="x.stl"/></geometry>'
            f'</collision></link><joint name="{name}" type="{kind}">'
            f'<parent link="{f"{PARENTS[name]}_link" if name in PARENTS else parent}"/>'
            f'<child link="{name}_link"/><origin xyz="{place}" rpy="{turn}"/>'
            f'<axis xyz="{axis}"/>{changes.get(name, LIMIT)}</joint>')
        parent = f'{name}_link' if name != 'finger' else parent
    return ''.join([*parts, '</robot>'])


def arm(urdf=None, joints=NAMES, flange='tool_link', start=START):
    return arm_from_urdf('foreign', urdf or text(), joints, flange, start, MOUNT)


def test_its_links_are_where_mujoco_has_them():
    found = arm()
    assert found.limits.tolist() == [[-2, 2.5], [-2 * np.pi, 2 * np.pi], *[[-2, 2.5]] * 4]
    for joints in np.random.default_rng(0).uniform(-2, 2, (5, 6)):
        seen = in_mujoco(text().replace('<collision>', '<visual>').replace(
            '</collision>', '</visual>'), dict(zip(NAMES, joints)))
        pose = np.linalg.inv(seen['stand_link']) @ seen['tool_link']
        np.testing.assert_allclose(found.forward(joints), pose, atol=1e-6)
        again = found.inverse(found.forward(START + 0.1 * joints))
        np.testing.assert_allclose(
            found.forward(again), found.forward(START + 0.1 * joints), atol=1e-8)
    assert len(found.transforms(START)) == 6 and len(found.shapes) > 3
    with pytest.raises(KinematicsError, match='stays .* m and .* degrees away'):
        found.inverse(np.eye(4) + 5 * np.eye(4, k=3))


@pytest.mark.parametrize('make, words', [
    (lambda: arm('<robot'), 'arm foreign: is no URDF'),
    (lambda: arm(joints=(*NAMES, 'g')), 'has no joint g that turns; it has a, b, c, d, e, f'),
    (lambda: arm(joints=NAMES[::-1]), 'is carried by a, b, c, d, e, f; expected f'),
    (lambda: arm(joints=()), '0 joints are named; expected 1 to 8'),
    (lambda: arm(flange='hand'), 'has no link hand'),
    (lambda: arm(start=START[1:]), r'start has the shape \(5,\); expected'),
    (lambda: arm(text(c='')), "joint c lacks the limit 'lower'"),
    (lambda: arm(text(c='<limit lower="1" upper="1" velocity="1" effort="1"/>')),
     'joint c has the limits'),
    (lambda: arm(text(c='<limit lower="a" upper="1" velocity="1" effort="1"/>')), 'is no URDF')])
def test_what_cannot_be_used_is_named(make, words):
    with pytest.raises(ConfigError, match=words):
        make()
