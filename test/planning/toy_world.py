# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""A small world seen from above: squares that a dot pushes along without turning them."""

import numpy as np
from tap_ros.planning.table import Table
from tap_ros.recording.episode import Episode
import torch

SIZE = 32
SCALE = 30  # pixels per metre
MIDDLE = (SIZE - 1) / 2
ORIGIN_U = MIDDLE - 1.5  # so that the picture is not its own mirror image
# homography of the table and camera of the arm, row-major
TABLE = (SCALE, 0.0, ORIGIN_U, 0.0, -SCALE, MIDDLE, 0.0, 0.0, 1.0)
ARM = (SCALE, 0.0, 0.0, ORIGIN_U, 0.0, -SCALE, 0.0, MIDDLE, 0.0, 0.0, 0.0, 1.0)
HALF_SQUARE, HALF_DOT = 0.1, 0.05  # m


def to_pixels(points):
    """Project (..., 2) metres to (u, v)."""
    return np.stack([ORIGIN_U + SCALE * points[..., 0], MIDDLE - SCALE * points[..., 1]], -1)


def draw(squares, dot, colours):
    """Return a picture uint8 (SIZE, SIZE, 3)."""
    picture = np.full((SIZE, SIZE, 3), 50, np.uint8)
    v, u = np.mgrid[:SIZE, :SIZE]
    shapes = [*zip(squares, colours, [HALF_SQUARE] * len(squares)), (dot, (250,) * 3, HALF_DOT)]
    for place, colour, half in shapes:
        centre = to_pixels(place)
        inside = (abs(u - centre[0]) <= half * SCALE) & (abs(v - centre[1]) <= half * SCALE)
        picture[inside] = colour
    return picture


def push(squares, before, after):
    """Move the squares (K, 2) that the dot meets on its way from before to after."""
    squares, reach = squares.copy(), HALF_SQUARE + HALF_DOT
    for share in np.linspace(0, 1, 9)[1:]:
        dot = before + share * (after - before)
        for k, square in enumerate(squares):
            overlap = reach - np.abs(square - dot)
            if (overlap > 0).all():
                axis = overlap.argmin()
                squares[k, axis] += overlap[axis] * np.sign(square - dot)[axis]
    return squares


def make_episode(seed, length=18):
    """Draw an episode: the dot goes through a square, more or less."""
    rng = np.random.default_rng(seed)
    squares = rng.uniform(-0.3, 0.3, (2, 2))
    colours = rng.integers(90, 220, (2, 3))
    dot = squares[0] + rng.choice([-1, 1], 2) * rng.uniform(0.17, 0.25, 2)
    frames, grippers, actions, places = [], [], [], []
    for _ in range(length):
        to_square = squares[0] - dot
        action = np.clip(to_square * rng.uniform(0.2, 1) + rng.normal(0, 0.02, 2), -0.08, 0.08)
        after = np.clip(dot + action, -0.45, 0.45)
        frames.append(draw(squares, dot, colours))
        grippers.append([*dot, 0, 0])
        actions.append([*action, 0, 0])
        places.append(squares)
        squares, dot = push(squares, dot, after), after
    places, actions[-1] = np.array(places), [0, 0, 0, 0]
    poses = np.zeros((length, 2, 7))
    poses[..., :2], poses[..., 6] = places, 1
    pixels = to_pixels(places).astype(np.float32)
    return Episode(
        frames=np.stack(frames), stamps=np.arange(length) * 250_000_000 + (seed + 1) * 10 ** 11,
        actions=np.array(actions, np.float32), grippers=np.array(grippers, np.float32),
        object_names=('object_0', 'object_1'), object_pixels=pixels, object_poses=poses,
        goal_frame=frames[-1], goal_pixels=pixels[-1], goal_poses=poses[-1], task='push2',
        seed=seed, outcome='success')


class Telekinesis:
    """A forward model: all objects go where the gripper goes, whether it touches them or not."""

    table = Table(torch.tensor(TABLE).view(3, 3), (SIZE, SIZE))

    def begin(self, image, gripper, arm_hidden=False):
        return None

    def carried_maps(self, start, gripper, maps, actions, /, every=1):
        here = maps.flatten(1) @ self.table.pixels().flatten(0, 1)  # (K, 2)
        for t in range(every, actions.shape[1] + 1, every):
            way = actions[:, :t, :2].sum(1) * torch.tensor([SCALE, -SCALE])
            at = here + way[:, None]  # (N, K, 2)
            carried = self.table.seed_maps(at.flatten(0, 1))
            yield carried.view(*at.shape[:2], *carried.shape[1:])
