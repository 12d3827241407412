# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Laws of retrieval, on recorded demonstrations."""

from pathlib import Path

import numpy as np
import pytest
from tap_ros.prediction.retrieval import (
    ends_of,
    EQUAL,
    LARGEST,
    LARGEST_WEIGHT,
    learned_weights,
    nearest,
    nearest_others,
    neighbours,
    spread_out,
    unlike,
    usual_distance,
)
from tap_ros.recording.cache import open_recordings

BAG = Path(__file__).parents[2] / 'bags' / 'sample_push2'


@pytest.fixture(scope='module')
def ends():
    return np.stack([ends_of(episode.frames[0], episode.frames[-1])
                     for episode in open_recordings([BAG], progress=False)])


def distance(one, other):
    """Return the root mean square difference of what two are compared by, the plain way."""
    return np.sqrt(np.square(one.astype(float) - other).mean())


def test_the_most_alike_come_first_and_a_demonstration_is_not_its_own_neighbour(ends):
    plain = np.array([[distance(a, b) for b in ends] for a in ends])
    indices, distances = nearest(ends, ends, 3)
    assert (indices[:, 0] == np.arange(len(ends))).all() and (distances[:, 0] == 0).all()
    np.fill_diagonal(plain, np.inf)
    indices, distances = neighbours(ends, 5)
    assert indices.shape == distances.shape == (len(ends), 5)
    assert (indices == plain.argsort(1)[:, :5]).all()
    assert np.allclose(distances, np.sort(plain, 1)[:, :5])
    assert usual_distance(ends) == pytest.approx(plain.min(1).max())
    assert neighbours(ends[:4], 9)[0].shape == (4, 3)  # there are no more


def test_of_equally_alike_ones_the_first_is_found_whatever_is_asked_beside_it(ends):
    twice = np.concatenate([ends, ends])
    indices, _ = neighbours(twice, 3)
    assert (indices[:20, 0] == np.arange(20, 40)).all()
    assert (indices[20:, 0] == np.arange(20)).all()
    assert (np.diff(indices[:, 1:]) == 20).all()
    many = np.concatenate([ends] * 30)  # more than are compared at once
    others = np.arange(20)[:, None] + [0, 20, 40]  # the first three that are the same
    assert (neighbours(many, 3)[0][60:] == np.concatenate([others] * 27)).all()
    different = np.random.default_rng(0).integers(0, 256, (300, *ends.shape[1:]), np.uint8)
    assert (neighbours(different, 1)[0][:, 0] != np.arange(300)).all()
    together = nearest(many, ends, 4)
    alone = [nearest(one[None], ends, 4) for one in ends]
    for part, parts in zip(together, zip(*alone)):
        assert (part == np.concatenate([*parts] * 30)).all()


def test_what_is_asked_about_is_left_out_where_there_are_others(ends):
    for one, other in zip(nearest_others(ends, ends, 3), neighbours(ends, 3)):
        assert (one == other).all()
    few = ends[:3]
    indices, distances = nearest_others(ends, few, 5)
    assert indices.shape == (20, 2)
    assert (np.sort(indices[:3], 1) == [[1, 2], [0, 2], [0, 1]]).all()
    assert (indices[3:] == nearest(ends[3:], few, 2)[0]).all() and (distances > 0).all()
    assert (nearest_others(ends, ends[:1], 5)[0] == 0).all()


def test_a_demonstration_that_is_moved_is_still_nearest_to_itself_at_any_size(ends):
    first = open_recordings([BAG], progress=False)[0]
    for scale in (1, 3):
        start, goal = (frame.repeat(scale, 0).repeat(scale, 1)
                       for frame in (first.frames[1], first.frames[-2]))
        asked = ends_of(start, goal)
        assert asked.shape == (2, 16, 16, 3) and asked.dtype == np.uint8
        (index,), (away,) = (part[0] for part in nearest(asked[None], ends, 1))
        assert index == 0 and 0 < away < usual_distance(ends)
        assert not unlike(away, usual_distance(ends))


def test_pictures_of_something_else_are_unlike_all(ends):
    usual = usual_distance(ends)
    start, goal = np.random.default_rng(0).integers(0, 256, (2, 64, 64, 3), np.uint8)
    (away,), = nearest(ends_of(start, goal)[None], ends, 1)[1]
    assert usual < away < LARGEST and f'by {away:.0f} (root' in unlike(away, usual)
    assert usual_distance(ends[:1]) == LARGEST  # one demonstration tells nothing


def test_what_is_chosen_covers_all(ends):
    chosen = spread_out(ends, 6)
    assert len({*chosen}) == 6 and (np.diff(chosen) > 0).all()
    assert (spread_out(ends, 6) == chosen).all() and (spread_out(ends, 99) == np.arange(20)).all()
    others = [np.random.default_rng(seed).permutation(20)[:6] for seed in range(20)]
    reach = [nearest(ends, ends[some], 1)[1].max() for some in (chosen, *others)]
    assert reach[0] <= np.median(reach[1:])
    twins = np.concatenate([ends[:6], ends[:6]])
    assert len({i % 6 for i in spread_out(twins, 6)}) == 6


def test_what_says_nothing_of_the_keyframe_is_learned_not_to_count(ends):
    keyframes = np.stack([episode.frames[20] for episode in
                          open_recordings([BAG], progress=False)])
    disturbed = ends.copy()  # a light in a corner of the start, on or off
    light = np.random.default_rng(0).integers(0, 2, 20) * 255
    disturbed[:, 0, :4, :4] = light[:, None, None, None]
    weights = learned_weights(disturbed, keyframes)
    assert weights.dtype == np.int32 and weights.shape == EQUAL.shape
    assert weights.min() >= 0 and weights.max() == LARGEST_WEIGHT
    assert weights[0, :4, :4].mean() < weights.mean() / 4
    small = np.stack([ends_of(one, one)[0] for one in keyframes]).astype(float)

    def apart(**how):
        """Return how far the keyframes of the most alike are, without the light."""
        near = neighbours(disturbed, 1, **how)[0][:, 0]
        return np.abs(small[near] - small).mean()

    assert apart(weights=weights) < apart()
    assert (learned_weights(ends[:2], keyframes[:2]) == EQUAL).all()  # they tell nothing
    assert (learned_weights(ends[[0] * 5], keyframes[:5]) == EQUAL).all()
    several = learned_weights(disturbed, np.stack([keyframes, keyframes], 1))
    assert (several == weights).all()


def test_a_pixel_counts_by_its_weight(ends):
    weights = np.zeros_like(EQUAL)
    weights[1, 3:9] = np.random.default_rng(0).integers(0, LARGEST_WEIGHT, (6, 16))
    indices, distances = neighbours(ends, 3, weights)
    squares = (np.square(ends[:, None].astype(float) - ends).mean(-1) * weights).sum((2, 3, 4))
    np.fill_diagonal(squares, np.inf)
    assert (indices == squares.argsort(1)[:, :3]).all()
    assert np.allclose(distances, np.sqrt(np.sort(squares, 1)[:, :3] / weights.sum()))
