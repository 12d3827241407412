# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Laws of what labels are found by: cameras together, and signals."""

import json

from made_bags import camera, joints, record
import numpy as np
import pytest
from tap_ros.__main__ import main
from tap_ros.apps.label_command import describe_all
from tap_ros.base.errors import ConfigError
from tap_ros.recording.cache import open_recordings
from tap_ros.recording.marks import write_marks
from tap_ros.recording.reading import Reading
from test_labels import COUNT, found, MARKED, two_moves

PAUSE = 30.0  # s, from the start of a demonstration to that of the next


@pytest.fixture(scope='module')
def shown():
    return [two_moves(seed) for seed in range(COUNT)]


@pytest.fixture(scope='module')
def bag(shown, tmp_path_factory):
    """Record what one camera sees of the first move, another of the second, and a signal of it."""
    messages = []
    for i, (frames, stamps, ends) in enumerate(shown):
        upper, lower = frames.copy(), frames.copy()
        upper[:, 16:], lower[:, :16] = 40, 40
        for t, stamp in enumerate(stamps):
            at = 10 + PAUSE * i + stamp / 1e9
            messages += [camera(at, upper[t], topic='/a/rgb'),
                         joints(at, topic='/signals', noise=float(t % 3),
                                hand=float(stamp / 1e9 > ends[1]))]
            if t % 2:  # another rate and other moments
                messages.append(camera(at + 0.03, lower[t], topic='/b/rgb'))
    return record(tmp_path_factory.mktemp('bags') / 'two', sorted(
        messages, key=lambda one: one[3]))


def off(films, shown):
    moments = found(films, shown).moments
    return np.median([np.abs(moments[i] - shown[i][2]) for i in range(MARKED, COUNT)], axis=0)


def test_what_one_camera_does_not_see_another_or_a_signal_tells(bag, shown):
    store, alone = describe_all([bag], ['/a/rgb'], [])
    assert len(store) == COUNT
    _, both = describe_all([bag], ['/a/rgb', '/b/rgb'], [])
    _, told = describe_all([bag], ['/a/rgb'], ['han'])
    assert both[0].features.shape[1] == 2 * alone[0].features.shape[1]
    assert both[0].grey == 2 * alone[0].grey
    np.testing.assert_array_equal(both[0].stamps, alone[0].stamps)
    assert told[0].features.shape[1] == alone[0].features.shape[1] + 5  # the times AROUND_S
    first, second = off(alone, shown)
    assert first < 0.1 and second > 0.15
    for films in (both, told):
        assert (off(films, shown) < 0.1).all()


def test_a_signal_or_camera_that_is_not_there_is_named(bag):
    with pytest.raises(ConfigError, match="no name holds 'foot'; expected a part of noise, hand"):
        describe_all([bag], ['/a/rgb'], ['foot'])


def test_the_command_takes_several_cameras_of_a_demonstration(bag, shown, tmp_path):
    store = open_recordings([bag], progress=False, reading=Reading(image_topic='/a/rgb'))
    marks = tmp_path / 'marks.json'
    write_marks(marks, store, [bag], {i: [
        (int(t), int(t)) for t in np.rint(10 * shown[i][2])] for i in range(MARKED)}, ['a', 'b'])
    assert main(['label', str(bag), '--marks', str(marks), '--out', str(tmp_path / 'out'),
                 '--image-topic', '/a/rgb', '--image-topic', '/b/rgb', '--signals', 'hand']) == 0
    rows = json.loads((tmp_path / 'out/labels.json').read_text())['labels']
    assert len(rows) == 2 * COUNT  # one of each demonstration, not of each camera
    assert rows[-1]['seconds'] == pytest.approx(shown[-1][2][1], abs=0.4)
