# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Laws of keyframes: where they come from, what is copied of them, and hostile files."""

from pathlib import Path

from lively import lively_network
import numpy as np
import pytest
from tap_ros.base.errors import ConfigError, WeightsError
from tap_ros.evaluation.prediction import evaluate
from tap_ros.images.drawing import png_bytes
from tap_ros.images.pixels import resize_image, to_float, to_uint8
from tap_ros.prediction.keyframe_bank import KeyframeBank, MOST
from tap_ros.prediction.predictor import load_network, SubgoalPredictor
from tap_ros.prediction.protocol import Request
from tap_ros.prediction.retrieval import ends_of, inlier_keyframes, neighbours
from tap_ros.recording.cache import open_recordings
from tap_ros.weights.weights import load_tensors, save_tensors, save_weights
import torch

BAG = Path(__file__).parents[2] / 'bags' / 'sample_push2'


@pytest.fixture(scope='module')
def episodes():
    return list(open_recordings([BAG], progress=False))


@pytest.fixture(scope='module')
def ends(episodes):
    return np.stack([ends_of(episode.frames[0], episode.frames[-1]) for episode in episodes])


@pytest.fixture(scope='module')
def bank(episodes, ends):
    """Keyframes as of a camera of 128 px, of pictures of 64 px."""
    return KeyframeBank.choose(ends, lambda i: full(episodes[i], 20))


def full(episode, t):
    """Return a frame as a camera of 128 px would show it, not just enlarged."""
    picture = episode.frames[t].repeat(2, 0).repeat(2, 1)
    picture[::2, ::2] //= 2
    return picture


TIMES = [0, 22, 11]  # of the start and of keyframes of two levels, the later one first


@pytest.fixture(scope='module')
def levels(episodes, ends):
    """Two keyframes of each demonstration, and where objects are in them."""
    return KeyframeBank.choose(
        ends, lambda n: full(episodes[n // 2], TIMES[1 + n % 2]), np.stack([
            one.object_pixels[TIMES] for one in episodes]).astype(np.float32), 2)


@pytest.fixture(scope='module')
def network(bank):
    made = lively_network(num_context=3, image_size=64)
    made.bank = bank
    return made


def ask(predictor, episode, **others):
    return predictor.predict(episode.frames[0], episode.frames[-1], episode.object_pixels[0],
                             episode.object_pixels[-1], **others)


def test_a_bank_comes_back_from_a_weights_file_as_it_was(network, bank, episodes, tmp_path):
    save_weights(tmp_path / 'w.safetensors', network, 'predictor', network.config, {'steps': 1})
    loaded = SubgoalPredictor.load(tmp_path / 'w.safetensors')
    assert loaded.mode == 'bidirectional' and loaded.training == {'steps': 1}
    again = load_network(tmp_path / 'w.safetensors')[0].bank
    assert len(again) == len(bank) == 20
    for i, keyframe in enumerate(again.keyframes):
        assert (keyframe == full(episodes[i], 20)).all()
    one, = ask(SubgoalPredictor(network), episodes[3])
    other, = ask(loaded, episodes[3])
    assert (one.image == other.image).all() and one.distance == other.distance > 0


def test_a_demonstration_is_shown_its_neighbour_and_never_itself(bank, ends, episodes):
    pairs = np.stack([episode.frames[[0, -1]] for episode in episodes])
    indices, distances = bank.find(pairs, 4)
    others, away = neighbours(ends, 4)
    assert (indices == others).all() and (distances == away[:, 0]).all()
    noise = np.random.default_rng(0).integers(0, 256, (1, 2, 64, 64, 3), np.uint8)
    _, (far,) = bank.find(noise, 1)
    assert bank.unlike(far) and not any(bank.unlike(one) for one in distances)
    single = KeyframeBank.choose(ends[:1], lambda i: full(episodes[i], 20))
    assert single.find(pairs, 3)[0].tolist() == [[0] * 3] * 20


def test_what_is_alike_is_kept_in_the_weights_file(ends, episodes, tmp_path):
    weights = np.zeros((2, 16, 16), np.int32)
    weights[0, :8] = 7
    made = lively_network(num_context=3, image_size=64)
    made.bank = KeyframeBank.choose(ends, lambda i: full(episodes[i], 20), weights=weights)
    save_weights(tmp_path / 'w.safetensors', made, 'predictor', made.config, {})
    again = load_network(tmp_path / 'w.safetensors')[0].bank
    pairs = np.stack([episode.frames[[0, -1]] for episode in episodes])
    indices, distances = again.find(pairs, 2)
    assert (indices == neighbours(ends, 2, weights)[0]).all()
    assert (indices != neighbours(ends, 2)[0]).any()
    assert (distances == neighbours(ends, 1)[1][:, 0]).all()  # what is unlike, is so anywhere
    tensors, metadata = load_tensors(tmp_path / 'w.safetensors')
    for wrong in (-weights, 0 * weights, weights.astype(np.int64), weights[:1], weights * 200):
        save_tensors(tmp_path / 'v.safetensors', {
            **tensors, 'bank.weights': torch.from_numpy(np.ascontiguousarray(wrong))}, metadata)
        with pytest.raises(WeightsError, match='keyframes cannot be used: .*weights of pixels'):
            load_network(tmp_path / 'v.safetensors')
    del tensors['bank.weights']  # of a file that was written before there were any
    save_tensors(tmp_path / 'v.safetensors', tensors, metadata)
    assert (load_network(tmp_path / 'v.safetensors')[0].bank.find(pairs, 1)[0] == neighbours(
        ends, 1)[0]).all()


@pytest.mark.parametrize('count', [1, 3])
def test_the_network_is_given_keyframes_by_whoever_asks(count, bank, episodes):
    network = lively_network(num_context=2 + count, image_size=64)
    network.bank = bank
    predictor = SubgoalPredictor(network)
    chosen = [1, 4, 7]
    pairs = np.stack([episodes[i].frames[[0, -1]] for i in chosen])
    keyframes = [[resize_image(bank.keyframes[i], (64, 64)) for i in each]
                 for each in bank.find(pairs, count)[0]]
    context = torch.cat([to_float(pairs), to_float(np.array(keyframes))], 1)
    with torch.inference_mode():
        given, found = network(context), network(to_float(pairs))
    assert given.image.equal(found.image)
    together = predictor.predict_together([Request(*pair) for pair in pairs])
    for b, i in enumerate(chosen):
        alone, = ask(predictor, episodes[i])
        for shown in (alone.image, together[b][0].image):
            assert np.abs(shown.astype(int) - to_uint8(given.image)[b]).mean() < 0.1


@pytest.mark.parametrize('known, count', [(False, 1), (True, 1), (True, 3)])
def test_a_network_is_scored_as_the_predictor_that_it_becomes(bank, levels, known, count):
    network = lively_network(num_context=2 + count, image_size=64)
    network.bank = levels if known else bank
    store, chosen = open_recordings([BAG], progress=False), [1, 4, 7]
    as_network, as_predictor = (evaluate(asked, store, chosen)['prediction']
                                for asked in (network, SubgoalPredictor(network)))
    assert np.allclose(as_network.min_l1, as_predictor.min_l1, atol=0.002)
    assert np.allclose(as_network.object_mass, as_predictor.object_mass, atol=0.01)
    assert np.allclose(as_network.bottleneck, as_predictor.bottleneck, atol=0.2)


def test_recursion_puts_the_prediction_between_start_and_keyframe(network, bank, episodes):
    episode = episodes[5]
    earlier, later = ask(SubgoalPredictor(network), episode, recursion_depth=2)
    keyframe = bank.scaled((64, 64))[bank.find(episode.frames[None, [0, -1]], 1)[0][0, 0]]
    with torch.inference_mode():
        again = network(to_float(np.stack([episode.frames[0], later.image, keyframe]))[None])
    assert np.abs(earlier.image.astype(int) - to_uint8(again.image)[0]).mean() < 1
    assert np.abs(earlier.image.astype(int) - later.image).mean() > 3
    assert earlier.distance == later.distance and not earlier.warning


def copies(bank, count=1, shown=0):
    """Return a predictor that copies one of count keyframes; for the left half, the start."""
    made = lively_network(num_context=2 + count, image_size=64)
    made.bank = bank
    forward = made.forward

    def half(context, z=None):
        found = forward(context, z)
        found.flow.zero_()
        found.masks.zero_()
        found.masks[:, 0, ..., :32], found.masks[:, 2 + shown, ..., 32:] = 1, 1
        return found

    made.forward = half
    return SubgoalPredictor(made, {
        'settings': {'crop': 'centre', 'size': 64}, 'camera_size': [128, 128]})


@pytest.fixture
def copying(bank):
    """Return such a predictor with a bank that knows nothing of objects."""
    return copies(bank)


def test_objects_are_where_start_and_goal_are_copied_from(copying, episodes):
    episode = episodes[0]
    pixels = np.array([[10, 20], [50, 30]])
    subgoal, = copying.predict(episode.frames[0], episode.frames[-1], pixels, pixels[::-1])
    assert subgoal.mass == pytest.approx([1, 0])  # the second is copied from the keyframe
    assert np.allclose(subgoal.expected_pixels[0], pixels[0], atol=1e-3)
    assert np.allclose(subgoal.object_maps.sum((1, 2)), 1)


def test_each_level_of_recursion_has_a_keyframe_and_objects_are_where_it_has_them(
        levels, episodes, tmp_path):
    assert len(levels) == 20 and levels.levels == 2 and len(levels.keyframes) == 40
    episode = episodes[4]
    start, goal = (full(episode, t) for t in (0, -1))
    pixels = episode.object_pixels[[0, -1]] * 2 + 0.5  # in pictures of 128 px
    alike = episodes[levels.find(np.stack([
        resize_image(one, (64, 64)) for one in (start, goal)])[None], 1)[0][0, 0]]
    of_start = pixels[0, ::-1]  # whatever their order: by where they begin
    order = [int(np.linalg.norm(alike.object_pixels[0] * 2 - at, axis=1).argmin())
             for at in of_start]
    assert sorted(order) == [0, 1]
    earlier, later, last = copies(levels).predict(
        start, goal, of_start, pixels[1, ::-1], recursion_depth=3)[::-1]
    for subgoal, t in ((earlier, 22), (later, 11), (last, 11)):  # beyond the last: that one again
        assert (subgoal.image[:, 70:] == full(alike, t)[:, 70:]).all()
        for at, k, mass in zip(subgoal.expected_pixels, order, subgoal.mass):
            if alike.object_pixels[t, k, 0] > 33 and of_start[order.index(k), 0] > 70:
                assert np.abs(at - alike.object_pixels[t, k] * 2 - 0.5).max() < 0.02
                assert mass == pytest.approx(1)
    made = lively_network(num_context=3, image_size=64)
    made.bank = levels
    save_weights(tmp_path / 'w', made, 'predictor', made.config, {})
    again = load_network(tmp_path / 'w')[0].bank
    assert again.levels == 2 and again.tensors().keys() == levels.tensors().keys()
    assert all(again.tensors()[name].equal(tensor) for name, tensor in levels.tensors().items())


def test_an_object_of_which_a_keyframe_knows_nothing_is_nowhere_in_it(episodes, ends):
    places = np.stack([one.object_pixels[[0, 20]] for one in episodes]).astype(np.float32)
    places[:, 1, 1] = np.nan
    bank = KeyframeBank.choose(ends, lambda i: full(episodes[i], 20), places)
    maps = torch.zeros(1, 2, 3, 64, 64)
    asked = np.concatenate([places[7, 0], [[5, 5]]])
    added = bank.beside_maps(maps, [asked], np.array([[7]]))[0, 2]
    assert added.sum((1, 2)).tolist() == pytest.approx([1, 0, 0])
    v, u = divmod(int(added[0].argmax()), 64)
    assert np.abs(np.array([u, v]) - places[7, 1, 0]).max() <= 0.5
    again = KeyframeBank.take(bank.tensors(), 'file')
    assert again.beside_maps(maps, [asked], np.array([[7]])).equal(
        bank.beside_maps(maps, [asked], np.array([[7]])))
    assert all(tensor.isfinite().all() for tensor in bank.tensors().values())


@pytest.mark.parametrize('count, shown', [(1, 0), (3, 0), (3, 1), (3, 2)])
def test_each_keyframe_is_copied_at_its_full_size(count, shown, bank, episodes):
    chosen = [2, 6]
    pictures = [[full(episodes[i], t) for t in (0, -1)] for i in chosen]
    found = copies(bank, count, shown).predict_together([Request(*pair) for pair in pictures])
    alike, _ = bank.find(np.stack([[resize_image(one, (64, 64)) for one in pair]
                                   for pair in pictures]), count)
    for (subgoal,), (start, _), numbers in zip(found, pictures, alike):
        assert subgoal.image.shape == (128, 128, 3)
        assert (subgoal.image[:, 70:] == bank.keyframes[numbers[shown]][:, 70:]).all()
        assert (subgoal.image[:, :58] == start[:, :58]).all()


def test_a_bank_is_bounded_and_covers_what_it_is_chosen_from(episodes):
    many = np.random.default_rng(1).integers(0, 256, (150, 2, 16, 16, 3), np.uint8)
    asked = []
    bank = KeyframeBank.choose(many, lambda i: asked.append(i) or episodes[i % 20].frames[i % 30])
    assert len(bank) == MOST == len({*asked[1:]}) == len(asked) - 1  # the first tells the size


def test_hostile_banks_are_refused_in_one_line(network, tmp_path):
    path = tmp_path / 'w.safetensors'
    save_weights(path, network, 'predictor', network.config, {})
    tensors, about = load_tensors(path)
    ends, file = tensors['bank.ends'], tensors['bank.keyframe.3']

    def as_file(width, height):
        return torch.from_numpy(np.frombuffer(
            png_bytes(np.zeros((height, width, 3), np.uint8)), np.uint8).copy())

    bomb = as_file(8000, 8000)
    for changes, said in (
            ({'bank.ends': ends[:19]}, 'expected 1 to 64'), ({'bank.ends': None}, 'bank.ends'),
            ({'bank.ends': ends.float()}, 'expected 1 to 64'),
            ({'bank.ends': ends.bfloat16()}, 'ScalarType'),
            ({'bank.ends': ends[..., :15, :]}, 'expected 1 to 64'),
            ({'bank.keyframe.3': None}, 'keyframe'),
            ({'bank.keyframe.03': file.clone()}, 'keyframe'),
            ({'bank.keyframe.3': file.float()}, 'bytes of a file'),
            ({'bank.keyframe.3': file[None]}, 'bytes of a file'),
            ({'bank.keyframe.3': file[:0]}, 'damaged'),
            ({'bank.keyframe.3': file[:-500]}, 'damaged'),
            ({'bank.keyframe.3': as_file(64, 64)}, 'differ in size'),
            ({'bank.keyframe.3': bomb}, 'are more than'),
            ({f'bank.keyframe.{n}': file.clone() for n in range(65)} | {
                'bank.ends': ends[:1].expand(65, -1, -1, -1, -1).contiguous()}, 'expected 1 to'),
            ({'bank.objects': torch.zeros(19, 2, 1, 2)}, 'places of at most'),
            ({'bank.objects': torch.zeros(20, 3, 1, 2)}, 'places of at most'),
            ({'bank.objects': torch.zeros(20, 2, 33, 2)}, 'places of at most'),
            ({'bank.objects': torch.zeros(20, 2, 1, 3)}, 'places of at most'),
            ({'bank.objects': torch.zeros(20, 2, 2)}, 'places of at most'),
            ({'bank.objects': torch.full((20, 2, 1, 2), torch.inf)}, 'not finite'),
            ({'bank.objects': torch.full((20, 2, 1, 2), 1e30)}, 'at most 1000000 pixels'),
            ({'bank.objects': torch.zeros(20, 2, 1, 2).double()}, 'places of at most'),
            ({'bank.objects': torch.zeros(20, 2, 1, 2).bfloat16()}, 'ScalarType'),
            ({f'bank.keyframe.{n}': file.clone() for n in range(20, 30)}, 'expected 1 to'),
            ({f'bank.keyframe.{n}': file.clone() for n in range(180)}, 'expected 1 to'),
            ({name: None for name in tensors if name.startswith('bank.')}, 'without a bank')):
        wrong = {name: tensor for name, tensor in {**tensors, **changes}.items()
                 if tensor is not None}
        save_tensors(path, wrong, about)
        with pytest.raises(WeightsError) as error:
            SubgoalPredictor.load(path)
        text = str(error.value)
        assert said in text and text.isprintable() and str(path) in text and len(text) < 400


def test_weights_for_two_pictures_have_no_bank(network, bank, tmp_path):
    two = lively_network(image_size=64)
    two.bank = bank
    save_weights(tmp_path / 'two', two, 'predictor', two.config, {})
    with pytest.raises(WeightsError, match='2 pictures with a bank'):
        load_network(tmp_path / 'two')
    with pytest.raises(ConfigError, match='more with a bank'):
        SubgoalPredictor(two)
    with pytest.raises(ConfigError, match='these are for 3'):
        SubgoalPredictor(lively_network(num_context=3))
    save_weights(tmp_path / 'zero', {name: 0 * weight for name, weight in {
        **network.state_dict()}.items()} | bank.tensors(), 'predictor', network.config, {})
    with pytest.raises(WeightsError, match='all weights are zero'):
        load_network(tmp_path / 'zero')


def test_each_of_several_keyframes_has_its_objects(levels, episodes):
    asked = np.stack([episodes[i].object_pixels[0] for i in (3, 5)]).astype(np.float32)
    chosen, maps = np.array([[7, 2, 9], [1, 1, 4]]), torch.zeros(2, 2, 2, 64, 64)
    together = levels.beside_maps(maps, asked, chosen, 2)
    assert together.shape == (2, 5, 2, 64, 64)
    for b, k in np.ndindex(2, 3):
        alone = levels.beside_maps(maps[:1], asked[b:b + 1], chosen[b:b + 1, k:k + 1], 2)
        assert together[b, 2 + k].equal(alone[0, 2])


def test_keyframes_unlike_those_of_similar_demonstrations_are_outliers(episodes, ends):
    keyframes = np.stack([one.frames[None, -1] for one in episodes])
    keyframes[[4, 11]] = 255 - keyframes[[4, 11]]
    assert np.flatnonzero(~inlier_keyframes(ends, keyframes)).tolist() == [4, 11]
    assert inlier_keyframes(ends, 0 * keyframes).all()
    assert inlier_keyframes(ends[:2], keyframes[3:5]).all()
