# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Laws of what labels are found by: cameras together, and signals."""

from dataclasses import replace
import json
import warnings

from made_bags import camera, joints, record
from made_episodes import make_episode, write_bag
from made_lerobot import write_set
import numpy as np
import pytest
from tap_ros.__main__ import main
from tap_ros.apps.label_command import describe_all
from tap_ros.base.errors import ConfigError
from tap_ros.recording.cache import open_recordings
from tap_ros.recording.marks import beside, write_marks
from tap_ros.recording.reading import Reading, reading_of
from tap_ros.training.labels import SIZE
from tap_ros.training.marks import episode_preferences
from tap_ros.training.predictor_config import TrainingConfig
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


def seen(*topics):
    return Reading(topics, crop='whole', size=SIZE)


def off(films, shown):
    moments = found(films, shown).moments
    return np.median([np.abs(moments[i] - shown[i][2]) for i in range(MARKED, COUNT)], axis=0)


def test_what_one_camera_does_not_see_another_or_a_signal_tells(bag, shown):
    store, alone = describe_all([bag], seen('/a/rgb'), [])
    assert len(store) == COUNT
    _, both = describe_all([bag], seen('/a/rgb', '/b/rgb'), [])
    _, told = describe_all([bag], seen('/a/rgb'), ['han'])
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
        describe_all([bag], seen('/a/rgb'), ['foot'])


def test_a_signal_that_a_demonstration_lacks_is_left_out(tmp_path):
    one = make_episode(1)
    ramp = np.arange(len(one), dtype=np.float32)[:, None]
    bag = write_bag(tmp_path / 'bag', [replace(
        make_episode(k, start=(k + 1) * 10 ** 11), signal_names=names,
        signals=np.repeat(ramp, len(names), 1)) for k, names in enumerate((['b'], ['a', 'b']))])
    for parts, left in (['b'], ['b']), ([''], ['b']), (['a'], []):
        with warnings.catch_warnings(record=True) as told:
            warnings.simplefilter('always')
            store, films = describe_all([bag], Reading(crop='whole', size=SIZE), parts)
        assert [str(one.message).endswith('a (demonstration 0)') for one in told] == (
            [] if parts == ['b'] else [True])
        plain = describe_all([bag], Reading(crop='whole', size=SIZE), [])[1]
        assert films[0].features.shape[1] == plain[0].features.shape[1] + 5 * len(left)


def test_one_topic_given_twice_is_refused(bag, tmp_path, capsys):
    for command in ('label', 'mark', 'inspect'):
        assert main([command, str(bag), '--image-topic', '/a/rgb', '--image-topic', '/a/rgb', *(
            ['--out', str(tmp_path / 'out')] if command == 'label' else [])]) == 1
        assert 'image_topic: /a/rgb is given twice' in capsys.readouterr().err


def test_training_learns_the_moment_from_another_camera(bag, shown, tmp_path):
    """The second move is seen by the other camera alone."""
    config = TrainingConfig(
        recordings=(str(bag),), image_topic=('/a/rgb',), crop='centre', size=64, start_crop=0.0,
        selection='marks', marks=str(tmp_path / 'm.json'), label_topic=('/b/rgb',))
    store = open_recordings([bag], progress=False, reading=reading_of(config))
    write_marks(config.marks, store, [bag], {i: [
        2 * [int(np.rint(10 * shown[i][2][1]))]] for i in range(MARKED)})
    config.check()
    found, _ = episode_preferences(store, config, np.arange(COUNT))
    away = [abs(store.seconds(i)[found[i][0].argmax()] - shown[i][2][1])
            for i in range(MARKED, COUNT)]
    assert np.median(away) < 0.11
    with pytest.raises(ConfigError, match='label_topic: /a/rgb is given twice'):
        replace(config, label_topic=('/a/rgb',)).check()
    with pytest.raises(ConfigError, match='give --marks'):
        replace(config, marks='', selection='progress').check()


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


def test_cameras_that_were_imported_together_tell_of_one_demonstration(shown, tmp_path, capsys):
    """The second move is seen by the wrist alone."""
    episodes = []
    for frames, _, _ in shown:
        upper, lower = frames.copy(), frames.copy()
        upper[:, 16:], lower[:, :16] = 40, 40
        episodes.append({'observation.images.head': upper, 'observation.images.wrist': lower})
    folder, bag = write_set(tmp_path / 'set', episodes), tmp_path / 'bag'
    assert main(['import-lerobot', str(folder), '--out', str(bag), '--camera',
                 'observation.images.head', '--camera', 'observation.images.wrist']) == 0
    store = open_recordings([bag], progress=False)  # of the first camera, unasked
    assert store.cameras == ['/camera/image_raw'] and len(store) == COUNT
    write_marks(beside(bag), store, [bag], {i: [
        (int(t), int(t)) for t in np.rint(10 * shown[i][2])] for i in range(MARKED)}, ['a', 'b'])

    def away(*topics):
        """Return how far off the label of the second move is, of those not marked, s."""
        assert main(['label', str(bag), '--out', str(tmp_path / 'out'), *(
            word for topic in topics for word in ('--image-topic', topic))]) == 0
        rows = json.loads((tmp_path / 'out/labels.json').read_text())['labels']
        assert len(rows) == 2 * COUNT
        return np.median([abs(row['seconds'] - one[2][1])
                          for row, one in list(zip(rows[1::2], shown, strict=True))[MARKED:]])
    assert away() > 0.15
    assert away('/camera/image_raw', '/camera/wrist/image_raw') < 0.1
    cut = ['--crop', 'centre', '--size', '64']
    assert main(['inspect', str(bag), *cut]) == 0
    said = capsys.readouterr().out
    assert '/camera/wrist/image_raw  sensor_msgs/msg/Image' in said
    assert 'camera      /camera/image_raw\n' in said
    weights = tmp_path / 'run/predictor.safetensors'
    assert main(['train', 'predictor', str(bag), '--recipe', 'debug', '--steps', '2', *cut,
                 '--test-fraction', '0.3', '--out', str(weights.parent)]) == 0
    assert main(['evaluate', 'prediction', '--recordings', str(bag), '--weights',
                 str(weights)]) == 0


def test_the_command_cuts_demonstrations_as_mark_and_train_do(bag, tmp_path, capsys):
    """Between the demonstrations of this bag are 20 s and more."""
    def labelled(*options):
        out = tmp_path / 'out'
        code = main(['label', str(bag), '--marks', str(marks), '--out', str(out),
                     '--image-topic', '/a/rgb', *options])
        return code and capsys.readouterr().err or {row['episode'] for row in json.loads(
            (out / 'labels.json').read_text())['labels']}
    reading = Reading('/a/rgb', rate=5, gap=0, episode_seconds=60)
    store, marks = open_recordings([bag], progress=False, reading=reading), tmp_path / 'm.json'
    assert len(store) < COUNT
    write_marks(marks, store, [bag], {i: [(20, 20)] for i in range(2)}, ['a'])
    assert labelled('--rate', '5', '--gap', '0', '--episode-seconds', '60') == {
        *range(len(store))}
    assert 'is outside; the episode goes from' in labelled()
