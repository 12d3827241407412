# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Laws of the prediction metrics."""

from dataclasses import replace
from itertools import product
import json
import re
from types import SimpleNamespace
import warnings

import cv2
from made_episodes import move_squares, write_bag
import numpy as np
import pytest
from tap_ros.apps.evaluate_prediction import Options, run
from tap_ros.base.errors import ConfigError, ImageError, RecordingWarning
from tap_ros.base.options import parse
from tap_ros.evaluation.bottleneck import bottleneck_scores
from tap_ros.evaluation.full_size import answer_at_full_size
from tap_ros.evaluation.hits import seconds_off
from tap_ros.evaluation.intervals import bootstrap
from tap_ros.evaluation.prediction import evaluate, verdict
from tap_ros.evaluation.samples import score_samples
from tap_ros.images.crop import Crop, TrainedCrop
from tap_ros.images.pixels import to_float
from tap_ros.prediction.keyframe_bank import KeyframeBank
from tap_ros.prediction.networks import Prediction, PredictorConfig, PredictorNetwork
from tap_ros.prediction.retrieval import ends_of
from tap_ros.prediction.warp import combine, one_hot_maps, warp
from tap_ros.recording.cache import open_recordings
from tap_ros.recording.marks import write_marks
from tap_ros.recording.reading import Reading
from tap_ros.weights.weights import save_weights
import torch

SIZE = 32


class Store(list):
    """Episodes in memory, read like an EpisodeStore."""

    image_size = (SIZE, SIZE)

    @property
    def lengths(self):
        return np.array([len(episode.frames) for episode in self])

    def frames(self, i):
        return self[i].frames


class Pasting(torch.nn.Module):
    """Shows the goal in the left half and the start in the right half of the picture."""

    def __init__(self):
        super().__init__()
        self.share = torch.nn.Parameter(torch.zeros(()))
        self.config = PredictorConfig(image_size=SIZE)

    def forward(self, context, z=None):
        B, C, _, H, W = context.shape
        masks = torch.zeros(B, C, 1, H, W)
        masks[:, 0, ..., W // 2:], masks[:, 1, ..., :W // 2] = 1, 1
        return Prediction(combine(context, masks), torch.zeros(B, C, 2, H, W), masks, None)


# Object 0 stays in the left half, object 1 in the right one.
EPISODES = Store(move_squares([[6, 6], [24, y]], [[12, 10], [27, y - 9]], seed=seed)
                 for seed, y in enumerate((16, 20, 24)))


def test_bottleneck_is_either_object_first_and_the_sum_over_objects():
    start = torch.tensor([[[5.0, 5.0], [20.0, 20.0]]])
    goal = torch.tensor([[[5.0, 9.0], [26.0, 20.0]]])

    def score(first, second):
        maps = torch.stack([one_hot_maps(first, (SIZE, SIZE)), one_hot_maps(second, (SIZE, SIZE))])
        return bottleneck_scores(maps[None], start, goal).item()

    assert score(goal[0, 0], start[0, 1]) == 0
    assert score(start[0, 0], goal[0, 1]) == 0
    # Copying costs the shorter way of the two; halfway costs both halves.
    assert score(start[0, 0], start[0, 1]) == pytest.approx(4)
    assert score(goal[0, 0], goal[0, 1]) == pytest.approx(4)
    halfway = (start + goal)[0] / 2
    assert score(halfway[0], halfway[1]) == pytest.approx(2 + 3)


def test_with_three_objects_one_or_two_may_have_moved_but_not_none_or_all():
    start = torch.tensor([[[2.0, 2], [2, 10], [10, 2]]])
    goal = start + 4
    gap = 32 ** 0.5
    for moved in product((0.0, 1.0), repeat=3):
        pixels = start + 4 * torch.tensor(moved)[None, :, None]
        score = bottleneck_scores(one_hot_maps(pixels[0], (16, 16))[None], start, goal)
        assert score.item() == pytest.approx(gap if sum(moved) in (0, 3) else 0, abs=1e-4)


def test_a_perfect_bottleneck_is_found_and_matched():
    scores = evaluate(Pasting(), EPISODES, range(3))['prediction']
    assert np.allclose(scores.bottleneck, 0, atol=1e-4)
    assert np.allclose(scores.min_l1, 0, atol=1e-6)
    assert scores.match_step.tolist() == [4, 4, 4]
    assert np.allclose(scores.match_fraction, 0.5)
    assert scores.summary()['bottleneck_0px'] == 0 or scores.bottleneck.max() == 0
    assert scores.summary()['bottleneck_1px'] == 1


def test_an_object_that_is_left_out_is_not_to_be_seen():
    class Erasing(Pasting):
        """Like Pasting, but shows a tenth of object 0 only, and elsewhere the start."""

        def forward(self, context, z=None):
            masks = super().forward(context).masks
            masks[:, 1] *= 0.1
            masks[:, 0] = 1 - masks[:, 1]
            flow = torch.zeros(len(context), 2, 2, SIZE, SIZE)
            flow[:, 0, 1, :, :SIZE // 2] = SIZE  # the start is read from its lowest row
            return Prediction(combine(warp(context, flow), masks), flow, masks, None)

    whole, left_out = (evaluate(made(), EPISODES, range(3))['prediction']
                       for made in (Pasting, Erasing))
    assert np.allclose(whole.object_mass, 1, atol=1e-4)
    assert np.allclose(left_out.object_mass, 0.1, atol=1e-4)
    for scores, visible in ((whole, 1), (left_out, 0)):
        summary = scores.summary()
        assert (summary['bottleneck_1px'], summary['visible_bottleneck_1px']) == (1, visible)


def test_leaving_out_and_copying_cost_all_of_a_changed_pixel():
    scores = evaluate(Pasting(), EPISODES, range(3))
    # Pasting shows the true bottleneck, whose pixels all stand in one of the inputs.
    assert np.isnan(scores['prediction'].changed_l1).all()
    # The frames beside the inputs show an object on its way: where copying has the table.
    table, there = np.array([40, 40, 40]), np.array([200, 60, 20])
    full = np.abs(there - table).mean() / 255
    assert scores['copy-start'].changed_l1 == pytest.approx(full, rel=0.35)
    assert 'changed_l1' not in scores['prediction'].summary()


def test_a_verdict_is_of_the_matched_frame_and_memorised_is_said():
    def scored(errors, copied, times=2):
        return replace(blank, min_l1=np.tile(errors, times), copying=np.tile(copied, times))

    blank = evaluate(Pasting(), EPISODES, range(3))['prediction']
    frames = [episode.frames.astype(float) / 255 for episode in EPISODES]
    assert blank.copying == pytest.approx([min(
        np.abs(f[4] - f[0]).mean(), np.abs(f[4] - f[-1]).mean()) for f in frames], abs=1e-6)
    good, bad = scored([0.1, 0.2, 0.1], [0.3, 0.3, 0.2]), scored([0.3, 0.4, 0.3], [0.2, 0.3, 0.2])
    assert 'better than copying' in verdict(good, None)[0]
    assert 'worse than copying' in verdict(bad, None)[0]
    assert 'not told from' in verdict(scored([0.1, 0.4, 0.2], [0.2, 0.3, 0.2]), None)[0]
    assert len(verdict(good, good)) == 2
    assert verdict(bad, good)[2].startswith('memorised')
    few = scored([0.1, 0.2, 0.1], [0.3, 0.3, 0.2], times=1)
    assert 'too few' in verdict(few, None)[0] and len(verdict(few, good)) == 2


def test_copying_matches_the_frame_beside_it_and_is_no_bottleneck():
    scores = evaluate(Pasting(), EPISODES, range(3))
    assert scores['copy-start'].match_step.tolist() == [1, 1, 1]
    assert scores['copy-goal'].match_step.tolist() == [7, 7, 7]
    shorter = [min(np.linalg.norm(e.object_pixels[-1] - e.object_pixels[0], axis=1))
               for e in EPISODES]
    assert np.allclose(scores['copy-start'].bottleneck, shorter, atol=1e-4)
    assert np.allclose(scores['copy-goal'].bottleneck, shorter, atol=1e-4)


def network(**options):
    torch.manual_seed(0)
    made = PredictorNetwork(PredictorConfig(**{
        'image_size': SIZE, 'base_width': 4, 'new_pixels': False, **options})).eval()
    for name, weight in made.named_parameters():
        # With fresh weights z would hardly matter.
        weight.data.mul_(10 if 'decoder.0.' in name else 1)
    return made


def test_forward_scores_count_the_last_frame_and_have_no_goal_to_copy():
    class CopiesTheEnd(torch.nn.Module):
        """Knows the last frame of the first episode."""

        def __init__(self):
            super().__init__()
            self.share = torch.nn.Parameter(torch.zeros(()))
            self.config = PredictorConfig(image_size=SIZE, num_context=1)

        def forward(self, context, z=None):
            assert context.shape[1] == 1
            image = to_float(EPISODES[0].frames[-1:])
            flow = torch.zeros(1, 1, 2, SIZE, SIZE)
            return Prediction(image, flow, torch.ones(1, 1, 1, SIZE, SIZE), None)

    scores = evaluate(CopiesTheEnd(), EPISODES, [0])
    assert list(scores) == ['prediction', 'copy-start']
    assert scores['prediction'].match_fraction.tolist() == [1]
    assert scores['prediction'].min_l1 == pytest.approx([0], abs=1e-6)
    assert scores['copy-start'].match_step.tolist() == [1]


def test_the_best_of_more_samples_is_never_worse_and_of_one_is_what_evaluate_measures():
    made = network(latent_size=8, new_pixels=True)
    scores = evaluate(made, EPISODES, range(3))['prediction']
    one, few, more = (score_samples(made, EPISODES, range(3), count=count) for count in (1, 3, 12))
    assert one.min_l1 == pytest.approx(scores.min_l1, abs=1e-6)
    assert one.match_step.tolist() == scores.match_step.tolist()
    assert (few.min_l1 <= one.min_l1 + 1e-7).all() and (more.min_l1 <= few.min_l1 + 1e-7).all()
    assert (more.min_l1 < one.min_l1).all()
    assert (one.spread == 0).all() and (more.spread > 0).all()
    assert np.isnan(more.spread_px).all()


def score(words):
    run(parse(Options, words))


@pytest.mark.parametrize(('crop', 'camera', 'told'), [
    ('4,0,24', [64, 64], '32x32 pixels .* on the part 4,0,24 of pictures of 64x64'),
    ('centre', [48, 64], 'on the middle of pictures of 64x48'), ('centre', [64, 64], '')])
def test_recordings_of_another_camera_are_not_cut_elsewhere_without_a_word(tmp_path, crop, camera,
                                                                           told):
    bag = write_bag(tmp_path / 'bag', [EPISODES[0]])
    made = PredictorNetwork(PredictorConfig(image_size=16, base_width=4))
    weights = tmp_path / 'weights.safetensors'
    save_weights(weights, made, 'predictor', made.config, {
        'settings': {'crop': crop, 'size': 16}, 'camera_size': camera})
    with warnings.catch_warnings(record=True) as found:
        warnings.simplefilter('always')
        try:
            score(['--weights', str(weights), '--recordings', str(bag), '--all'])
        except ImageError as error:
            assert crop != 'centre'
            found.append(SimpleNamespace(message=error))
    said = [str(one.message) for one in found if 'trained on' in str(one.message)]
    assert bool(said) == bool(told) and all(re.search(told, text) for text in said)


def test_answers_are_scored_at_the_size_that_was_recorded(tmp_path):
    episodes = [move_squares([[9, 9]], [[50, 50]], size=2 * SIZE, seed=seed) for seed in range(2)]
    bag = write_bag(tmp_path / 'bag', episodes)
    store = open_recordings(bag, reading=Reading(size=SIZE), progress=False)
    remembers = SimpleNamespace(
        mode='bidirectional', full_size=True, image_size=(SIZE, SIZE),
        camera_crop=TrainedCrop(Crop(), None, (SIZE, SIZE)),
        predict_together=lambda requests: [[SimpleNamespace(image=next(
            one.frames[4] for one in episodes if (one.frames[0] == request.start).all()))]
            for request in requests])
    found = answer_at_full_size(remembers, store, [0, 1], [4, 3])
    assert found[0].l1 == 0 < found[0].copying and found[1].l1 > 0
    np.testing.assert_array_equal(found[1].pictures, episodes[1].frames[[0, 4, 3, -1]])
    remembers.image_size = (2 * SIZE, 2 * SIZE)
    assert not answer_at_full_size(remembers, store, [0], [4])


def test_the_command_scores_and_draws_pictures_as_they_were_recorded(tmp_path, capsys):
    bag = write_bag(tmp_path / 'bag', [
        move_squares([[9, 9]], [[50, 50]], size=2 * SIZE, seed=seed, goal_frame=None)
        for seed in range(5)])
    weights, made = tmp_path / 'weights.safetensors', network()
    save_weights(weights, made, 'predictor', made.config, {'settings': {'size': SIZE}})
    score(['--weights', str(weights), '--recordings', str(bag), '--all', '--out', str(tmp_path)])
    assert 'at 64x64 pixels, 5 episodes:' in capsys.readouterr().out
    found = json.loads((tmp_path / 'scores.json').read_text())['scores']['full_size']
    assert len(found['l1']) == len(found['copying']) == 5
    assert cv2.imread(str(tmp_path / 'pictures.png')).shape[0] > 5 * 2 * SIZE


@pytest.mark.parametrize('options', [
    {}, {'latent_size': 8}, {'num_context': 1, 'new_pixels': True},
    {'num_context': 3, 'latent_size': 8}])
def test_the_command_scores_what_training_held_out(tmp_path, capsys, options):
    bag = write_bag(tmp_path / 'bag', EPISODES)
    made, forward = network(**options), options.get('num_context') == 1
    if options.get('num_context') == 3:
        made.bank = KeyframeBank.choose(np.stack([
            ends_of(one.frames[0], one.frames[-1]) for one in EPISODES]),
            lambda i: EPISODES[i].frames[4])
    weights = tmp_path / 'weights.safetensors'
    save_weights(weights, made, 'predictor', made.config, {'settings': {'test_fraction': 0.0}})
    common = ['--weights', str(weights), '--recordings', str(bag)]
    with pytest.raises(ConfigError, match='--all'):
        score(common)
    marks = tmp_path / 'marks.json'
    marks.write_text('{"marks": []}')
    with pytest.raises(ConfigError, match='marked; .* from 0: 0, 1, 2'):
        score([*common, '--all', '--marks', str(marks)])
    assert 'prediction' not in capsys.readouterr().out, 'nothing is scored before'
    write_marks(marks, open_recordings([bag], progress=False), [bag], {
        0: [(2, 4)], 1: [(5, 5)], 2: [(7, 7)]}, labels={1})  # no truth
    with pytest.warns(RecordingWarning, match='3 episodes are'):
        score([*common, '--all', '--samples', '3', '--marks', str(marks), '--out',
               str(tmp_path / 'out')])
    shown = capsys.readouterr().out
    assert 'positions: unknown' in shown and 'in 2 marked episodes' in shown
    assert 'all episodes, also those trained on' in shown and 'held-out' not in shown
    scores = json.loads((tmp_path / 'out' / 'scores.json').read_text())['scores']
    hits = scores.pop('marks')
    seconds, error = hits.pop('seconds'), hits.pop('error')
    assert [one[0] for one in seconds] == sorted(one[0] for one in seconds) and error[0] > 0
    assert f'error at the mark: too few to tell from copying; {error[0]:.2f} times' in shown
    assert set(hits) == {'prediction', 'middle', 'random'}
    assert hits['middle'][0][0] == hits['middle'][1][0] == 0.5
    assert hits['random'][0][0] == pytest.approx((3 / 7 + 1 / 7) / 2)
    assert hits['random'][1][0] == pytest.approx((5 / 7 + 2 / 7) / 2)
    assert ('best of 3' in shown) == ('latent_size' in options)
    methods = {'prediction', 'copy-start', 'copy-goal'} - (
        {'copy-goal'} if forward else set())
    assert set(scores) - {'samples'} == methods
    assert all(method in shown for method in methods)
    assert scores['prediction']['episodes'] == 3
    low, high = scores['prediction']['intervals']['min_l1']
    assert low <= scores['prediction']['min_l1'] <= high
    sheet = cv2.imread(str(tmp_path / 'out' / 'pictures.png'))
    panels = 5 - forward + ('new_pixels' not in options)
    assert sheet.shape == (20 + 3 * 130 - 2, panels * 130 - 2, 3)


def test_weights_of_one_mark_are_scored_by_that_one(tmp_path):
    bag, made, out = write_bag(tmp_path / 'bag', EPISODES), network(), tmp_path / 'out'
    weights, marks = tmp_path / 'weights.safetensors', tmp_path / 'marks.json'

    def scored(name, names):
        write_marks(marks, store, [bag], {0: [(2, 2), (6, 6)], 2: [(3, 3), (7, 7)]}, names)
        save_weights(weights, made, 'predictor', made.config, {'settings': {'mark_name': name}})
        score(['--weights', str(weights), '--recordings', str(bag), '--all', '--marks',
               str(marks), '--out', str(out)])
        return json.loads((out / 'scores.json').read_text())['scores']['marks']['random'][0][0]

    store = open_recordings([bag], progress=False)
    with warnings.catch_warnings():
        warnings.simplefilter('ignore')
        every = scored('', ('grasp', 'release'))
        assert scored('release', ('grasp', 'release')) == pytest.approx(every / 2)
        for names in ((), ('grasp', 'lift')):
            with pytest.raises(ConfigError, match='^mark_name: release is none of the marks'):
                scored('release', names)


def test_another_predictor_is_scored_by_what_it_shows_and_its_maps(tmp_path, capsys):
    bag, out = write_bag(tmp_path / 'bag', EPISODES[:1]), tmp_path / 'out'
    score(['--weights', f'nearest_keyframe:{bag}', '--recordings', str(bag), '--all',
           '--goal-picture', 'last', '--out', str(out)])
    assert 'all episodes, also those trained on' in capsys.readouterr().out
    scores = json.loads((out / 'scores.json').read_text())['scores']
    assert scores['prediction']['min_l1'] < 1e-6  # it has seen this episode
    assert scores['prediction']['bottleneck_median'] < scores['copy-goal']['bottleneck_median'] / 2


def test_differences_are_paired():
    baseline = np.random.default_rng(2).uniform(1, 5, 50)

    def gain(errors):
        return bootstrap(lambda a, b: 1 - a.mean(-1) / b.mean(-1), errors, baseline)

    assert gain(0.75 * baseline) == pytest.approx((0.25, 0.25, 0.25))
    _, low, high = gain(0.75 * baseline[::-1])
    assert high - low > 0.1


def test_errors_at_the_mark_are_those_at_its_frame():
    scores = evaluate(Pasting(), EPISODES, [0, 1], 'last', marks={1: [(2, 2)]})
    copying = scores['copy-start']
    assert np.isnan(copying.at_mark[0]) and np.isnan(copying.copying_at_mark[0])
    frames = EPISODES[1].frames.astype(float)
    assert copying.at_mark[1] == pytest.approx(
        np.abs(frames[2] - frames[0]).mean() / 255, abs=1e-4)
    assert copying.copying_at_mark[1] == pytest.approx(
        min(np.abs(frames[2] - frames[end]).mean() for end in (0, -1)) / 255, abs=1e-4)
    assert scores['prediction'].at_mark[1] != scores['prediction'].min_l1[1]


def test_moments_are_off_by_the_seconds_to_the_nearest_mark():
    stamps = np.arange(9) * 250_000_000
    off = seconds_off(3 * [[(2, 3), (7, 7)]], 3 * [stamps], np.array([1, 3, 5]))
    np.testing.assert_allclose(off, [0.25, 0, 0.5])
