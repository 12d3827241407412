# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""`python -m tap_ros predict` on picture files."""

import os
import re

import cv2
import numpy as np
import pytest
from tap_ros.__main__ import main
from tap_ros.apps.predict_command import fit
from tap_ros.base.errors import ImageError
from tap_ros.prediction.nearest_keyframe import NearestKeyframe
from tap_ros.prediction.predictor import load_network, SubgoalPredictor
from tap_ros.recording.cache import open_recordings
from tap_ros.weights.weights import save_weights


@pytest.fixture(scope='module')
def episode():
    return open_recordings('bags/sample_push2')[0]


@pytest.fixture
def files(episode, tmp_path):
    paths = [tmp_path / 'start.png', tmp_path / 'goal.png']
    for path, frame, scale in zip(paths, (episode.frames[0], episode.frames[-1]), (3, 1)):
        cv2.imwrite(str(path), frame[..., ::-1].repeat(scale, 0).repeat(scale, 1))
    return [str(path) for path in paths]


def words(pixels):
    return [f'{u},{v}' for u, v in pixels]


def test_it_predicts_what_the_predictor_does_in_the_pixels_of_the_start_picture(
        episode, files, tmp_path, capsys):
    start, goal = episode.object_pixels[[0, -1]]
    out = tmp_path / 'a' / 'subgoal.png'
    assert main(['predict', *files, '--objects', *words((start + 0.5) * 3 - 0.5),
                 '--goal-objects', *words(goal), '--out', str(out)]) == 0
    subgoal, = SubgoalPredictor.load('push2').predict(
        episode.frames[0], episode.frames[-1], start, goal)
    told = capsys.readouterr().out
    found = np.array(re.findall(r'object_\d at ([\d.]+),([\d.]+)', told), float)
    assert found == pytest.approx((subgoal.expected_pixels + 0.5) * 3 - 0.5, abs=0.2)
    assert str(out) in told and 'note' not in told
    picture = cv2.imread(str(out))
    assert picture.shape[1] > 3 * picture.shape[0] and picture.std() > 20


def test_without_objects_it_says_that_one_may_be_missing(files, tmp_path, capsys):
    assert main(['predict', *files, '--out', str(tmp_path / 'subgoal.png')]) == 0
    assert '--objects' in capsys.readouterr().out


def refusal(capsys, *arguments):
    """Return the one line in which a prediction is refused."""
    assert main(['predict', *arguments]) == 1
    error = capsys.readouterr().err
    assert error.count('\n') == 1
    return error


def test_what_cannot_be_used_is_named_and_nothing_is_written(files, tmp_path, capsys):
    out = tmp_path / 'subgoal.png'
    (tmp_path / 'text.png').write_text('not a picture')
    cv2.imwrite(str(tmp_path / 'wide.png'), np.zeros((64, 96, 3), np.uint8))
    for change, named in (
            (['--objects', '1,2', '3,4'], '--goal-objects'),
            (['--objects', '20'], '--objects 20'),
            (['--objects', 'nan,2', '--goal-objects', '1,2'], 'outside'),
            (['--weights', 'grasp_forward'], 'goal'), (['--samples', '0'], 'num_samples'),
            (['--out', files[1]], f'--out {files[1]}: is a picture to predict'),
            (['--out', 'subgoal.jpg'], '--out subgoal.jpg: expected a .png'),
            (['--crop', '100,0,99'], 'crop 100,0,99 reaches beyond'),
            (['--crop', '0,0,20', '--objects', '40,9', '--goal-objects', '1,2'], 'outside the')):
        assert named in refusal(capsys, *files, '--out', str(out), *change), change
        assert not out.exists()
    os.mkfifo(tmp_path / 'fifo.png')
    (tmp_path / 'zero').symlink_to('/dev/zero')
    (tmp_path / 'sparse.png').touch()
    os.truncate(tmp_path / 'sparse.png', 30 * 2**30)
    for name, named in (('absent.png', 'absent.png is not there'),
                        ('', 'no regular file'), ('fifo.png', 'no regular file'),
                        ('zero', 'no regular file'), ('sparse.png', 'has more than'),
                        ('text.png', 'valid are JPEG, PNG'),
                        ('wide.png', '96x64')):
        assert named in refusal(capsys, str(tmp_path / name), files[1]), name


def test_the_part_that_is_used_is_asked_for_or_that_of_the_training(episode, tmp_path, capsys):
    network, _ = load_network('push2')
    weights = tmp_path / 'cut.safetensors'
    save_weights(weights, network, 'predictor', network.config, {
        'settings': {'crop': 'centre', 'size': 64}, 'camera_size': [192, 256]})
    files = [tmp_path / 'start.png', tmp_path / 'goal.png']
    for path, frame in zip(files, (episode.frames[0], episode.frames[-1])):
        wide = np.zeros((192, 256, 3), np.uint8)
        wide[:, 32:224] = frame[..., ::-1].repeat(3, 0).repeat(3, 1)
        cv2.imwrite(str(path), wide)
    start, goal = ((pixels + 0.5) * 3 - 0.5 + [32, 0] for pixels in episode.object_pixels[[0, -1]])
    subgoal, = SubgoalPredictor.load('push2').predict(
        episode.frames[0], episode.frames[-1], *episode.object_pixels[[0, -1]])
    for options in (['--weights', str(weights)], ['--crop', 'centre'], ['--crop', '32,0,192']):
        assert main(['predict', *map(str, files), *options, '--objects', *words(start),
                     '--goal-objects', *words(goal), '--out', str(tmp_path / 'out.png')]) == 0
        told = re.findall(r'object_\d at ([\d.]+),([\d.]+)', capsys.readouterr().out)
        assert np.array(told, float) == pytest.approx(
            (subgoal.expected_pixels + 0.5) * 3 - 0.5 + [32, 0], abs=0.2)
    assert '--crop whole' in refusal(capsys, *map(str, files))
    assert main(['predict', *map(str, files), '--crop', 'whole', '--objects', '255,191',
                 '--goal-objects', '0,0', '--out', str(tmp_path / 'out.png')]) == 0
    save_weights(weights, network, 'predictor', network.config, {
        'settings': {'crop': 'centre', 'size': 64}, 'camera_size': [144, 256]})
    assert main(['predict', *map(str, files), '--weights', str(weights), '--out',
                 str(tmp_path / 'out.png')]) == 0
    assert 'on the middle of pictures of 256x144' in capsys.readouterr().err


def test_no_square_part_is_asked_for_where_pictures_are_wide():
    wide = NearestKeyframe.load('bags/sample_push2')
    wide.image_size = (48, 64)
    with pytest.raises(ImageError, match='shape 64x48; give pictures of that shape, or squeeze'):
        fit(np.zeros((30, 30, 3), np.uint8), (0, 0, 30, 30), np.zeros((0, 2)), wide, 'start')
