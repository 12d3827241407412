# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""predict_subgoal and the states of its node, asked over DDS, with small untrained networks."""

import threading

import cv2
from lifecycle_msgs.msg import State, Transition
from lively import lively_network
import numpy as np
from processes import Client, Lifecycle, LocalNode, Newest, until
import pytest
from sensor_msgs.msg import Image
from std_msgs.msg import String
from tap_msgs.msg import ObjectStates, Subgoal
from tap_msgs.srv import PredictSubgoal
from tap_ros.__main__ import main
from tap_ros.messages.images import decode_image, decode_map
from tap_ros.messages.subgoals import decode_subgoals
from tap_ros.nodes.predictor import requests
from tap_ros.nodes.predictor.node import PredictorNode
from tap_ros.prediction.keyframe_bank import KeyframeBank
from tap_ros.prediction.predictor import SubgoalPredictor
from tap_ros.prediction.retrieval import ends_of
from tap_ros.ros.calls import call
from tap_ros.ros.topics import encode_image, encode_objects, LATCHED, SERVICE_QOS, STREAM, to_stamp
from tap_ros.weights.weights import save_weights, stored_digest

NAMES = ('cup', 'box')
STAMP = to_stamp(2_500_000_000)
PICTURES = np.random.default_rng(0).integers(0, 256, (2, 32, 32, 3), np.uint8)


def objects(pixels, names=NAMES, stamp=STAMP):
    return encode_objects(names, pixels, [[0, 0, 0, 0, 0, 0, 1]] * len(names), stamp, 'world',
                          ObjectStates.SOURCE_TRACKED)


START, GOAL = (encode_image(picture, STAMP, 'eye') for picture in PICTURES)
START_OBJECTS, GOAL_OBJECTS = objects([(8, 9), (20, 21)]), objects([(12, 13), (24, 17)])
WITH_GOAL = {'start': START, 'goal': GOAL, 'start_objects': START_OBJECTS,
             'goal_objects': GOAL_OBJECTS}
ALONE = {'start': START, 'start_objects': START_OBJECTS}


def weights_file(path, **config):
    """Write weights of an untrained network."""
    network = lively_network(**config)
    if network.config.num_context == 3:  # of dark scenes
        shown = np.random.default_rng(2).integers(0, 30, (3, 2, 32, 32, 3), np.uint8)
        network.bank = KeyframeBank.choose(
            np.stack([ends_of(*pair) for pair in shown]), lambda i: shown[i, 0])
    save_weights(path, network, 'predictor', network.config, {})
    return path


class Service(LocalNode):
    """A node in a namespace of its own, so that several can live side by side, and its client."""

    def __init__(self, client, name, **parameters):
        super().__init__(PredictorNode, f'/{name}', **parameters)
        self.name, self.client_node = name, client
        self.client = client.create_client(
            PredictSubgoal, f'/{name}/predict_subgoal', qos_profile=SERVICE_QOS)
        self.subgoal = Newest(client, Subgoal, f'/{name}/subgoal', LATCHED)
        assert self.client.wait_for_service(30)

    def ask(self, **fields):
        return call(self.client, PredictSubgoal.Request(**fields), 60)

    def answer(self, **fields):
        """Ask for what must succeed."""
        response = self.ask(**fields)
        assert response.success, response.message
        assert len(response.sample) == len(response.level) == len(response.subgoals)
        return response

    def refusal(self, **fields):
        """Ask for what must be refused, and return the reason."""
        response = self.ask(**fields)
        assert not response.success and not response.subgoals
        assert not len(response.sample) and not len(response.level)
        return response.message


@pytest.fixture(scope='module')
def client():
    with Client() as node:
        yield node


@pytest.fixture(scope='module')
def files(tmp_path_factory):
    folder = tmp_path_factory.mktemp('predictors')
    return {'latent': weights_file(folder / 'latent.safetensors', latent_size=8),
            'forward': weights_file(folder / 'forward.safetensors', num_context=1, latent_size=8),
            'keyframes': weights_file(folder / 'keyframes.safetensors', num_context=3),
            'plain': weights_file(folder / 'plain.safetensors')}


@pytest.fixture(scope='module')
def services(client, files):
    """Start nodes for each kind of weights, and one that uses a robot mask."""
    started = {name: Service(client, name, weights=path) for name, path in files.items()}
    started['masked'] = Service(client, 'masked', weights=files['plain'], robot_mask='all')
    yield started
    for service in started.values():
        assert service.end() == 0


def pictures(response):
    return np.array([decode_image(s.image, 'subgoal').astype(int) for s in response.subgoals])


def differ(a, b):
    """Return the mean absolute difference of two pictures, from 0 to 255."""
    return np.abs(a - b).mean()


def test_weights_with_keyframes_are_asked_like_others_and_say_what_is_unlike_them(services):
    response = services['keyframes'].answer(recursion_depth=2, **WITH_GOAL)
    assert response.message.startswith('bidirectional, 2 subgoals, maps of cup, box; start and ')
    assert response.message.count('unlike every demonstration') == 1
    dark = {name: encode_image(picture // 9, STAMP, 'eye')
            for name, picture in zip(('start', 'goal'), PICTURES)}
    assert 'unlike' not in services['keyframes'].answer(**WITH_GOAL | dark).message


def test_samples_and_levels_are_told_apart_and_repeat_from_the_seed(services):
    for name, mode, levels, fields in (('latent', 'bidirectional', [2, 1], WITH_GOAL),
                                       ('forward', 'forward', [1, 2], ALONE)):
        service = services[name]
        response = service.answer(num_samples=3, recursion_depth=2, seed=4, **fields)
        assert list(response.sample) == [0, 0, 1, 1, 2, 2]
        assert list(response.level) == levels * 3
        seen = pictures(response)
        assert all(differ(seen[i], seen[j]) > 3 for i in range(6) for j in range(i))
        assert response.message.startswith(f'{mode}, 6 subgoals, maps of cup, box')
        doubtful = np.any([one.undecided for one in decode_subgoals(response, NAMES)], 0)
        told = response.message.partition('undecided about ')[2].partition(':')[0]
        assert told == ', '.join(name for name, doubt in zip(NAMES, doubtful) if doubt)
        for subgoal in response.subgoals:
            assert subgoal.header.stamp == STAMP and subgoal.header.frame_id == 'eye'
            assert tuple(subgoal.object_names) == NAMES
            assert len(subgoal.object_maps) == len(subgoal.expected_pixels) == 2
        again = service.answer(num_samples=3, recursion_depth=2, seed=4, mode=mode, **fields)
        assert again.subgoals == response.subgoals
        other = service.answer(num_samples=3, recursion_depth=2, seed=5, **fields)
        assert differ(pictures(other), seen) > 3
        # Published for planners: the first sample's earliest.
        service.subgoal.wait(10, lambda m, first=other.subgoals[0]: m == first)


def test_a_mode_is_that_of_the_weights_or_refused(services):
    latent, forward = services['latent'], services['forward']
    ahead = forward.answer(**ALONE)
    assert forward.answer(mode='forward', **WITH_GOAL).subgoals == ahead.subgoals
    no_objects = forward.answer(start=START)
    assert 'no object maps: start_objects are empty' in no_objects.message
    assert (pictures(no_objects) == pictures(ahead)).all()
    for service, fields, words in (
            (latent, ALONE, ['goal', '/latent/goal/image']),
            (forward, WITH_GOAL, ['goal', 'forward', 'weights:=', 'leave goal']),
            (latent, ALONE | {'mode': 'forward'}, ['-p weights:=FILE, trained for forward']),
            (forward, WITH_GOAL | {'mode': 'bidirectional'}, ['trained for bidirectional']),
            (latent, WITH_GOAL | {'mode': 'backward'}, ['backward', 'bidirectional, forward'])):
        message = service.refusal(**fields)
        assert all(word in message for word in words), message


def test_answers_are_as_large_as_the_pictures_and_those_of_the_predictor_itself(services, files):
    service, sent = services['latent'], enlarged_pictures(96)
    shown = {name: Newest(service.client_node, Image, f'/latent/subgoal/{name}', LATCHED)
             for name in ('image', 'overlay')}
    places = 3 * np.array([[[8, 9], [20, 21]], [[12, 13], [24, 17]]], np.float32)
    response = service.answer(
        **dict(zip(('start', 'goal'), (encode_image(one, STAMP, 'eye') for one in sent))),
        **dict(zip(('start_objects', 'goal_objects'), map(objects, places))),
        num_samples=2, recursion_depth=2, seed=4)
    found = SubgoalPredictor.load(files['latent']).predict(*sent, *places, 2, 2, 4)
    for one, direct in zip(decode_subgoals(response, NAMES), found, strict=True):
        assert direct.image.shape == (96, 96, 3) and direct.object_maps.shape == (2, 32, 32)
        for name in ('image', 'object_maps', 'expected_pixels'):
            assert np.array_equal(getattr(one, name), getattr(direct, name))
    shown['image'].wait(10, lambda m: m == response.subgoals[0].image)
    shown['overlay'].wait(10, lambda m: m.width == m.height == 288)
    # An answer with too many pixels for a message is of the size that the network sees.
    large = dict(zip(('start', 'goal'), (
        encode_image(one, STAMP, 'eye') for one in enlarged_pictures(960))))
    assert [one.image.width for one in service.answer(**large).subgoals] == [960]
    shown['overlay'].wait(10, lambda m: m.width == m.height == 640)
    many = service.answer(num_samples=20, **large).subgoals
    assert [(one.image.width, one.image.height) for one in many] == 20 * [(32, 32)]


def test_maps_are_answered_as_asked_for_and_drawn_once_someone_looks(services, client):
    service = services['plain']
    floats, = service.answer(**WITH_GOAL).subgoals
    bytes_, = service.answer(map_encoding='mono8', **WITH_GOAL).subgoals
    none, = service.answer(map_encoding='none', **WITH_GOAL).subgoals
    assert [one.encoding for one in bytes_.object_maps] == 2 * ['mono8']
    assert none.object_maps == [] and tuple(none.object_names) == NAMES
    assert floats.expected_pixels == bytes_.expected_pixels == none.expected_pixels
    for sent, exact in zip(bytes_.object_maps, floats.object_maps, strict=True):
        exact = decode_map(exact, 'map')
        np.testing.assert_allclose(decode_map(sent, 'map'), exact, atol=0.02 * exact.max())
    message = service.refusal(map_encoding='jpeg', **WITH_GOAL)
    assert "map_encoding 'jpeg' is unknown; valid: 32FC1, mono8, none" in message
    # What is published for planners has its maps, whatever the last client wanted.
    service.subgoal.wait(10, lambda m: m == floats)
    overlay = Newest(client, Image, '/plain/subgoal/overlay', LATCHED)
    overlay.wait(10, lambda m: m.header.stamp == STAMP)


def enlarged_pictures(side):
    return [cv2.resize(one, (side, side), interpolation=cv2.INTER_LINEAR) for one in PICTURES]


def test_a_refusal_that_repeats_is_logged_once_until_a_request_is_answered(services, capfd):
    plain = services['plain']
    for _ in range(2):
        for _ in range(3):
            plain.refusal(mode='forward', **WITH_GOAL)
        plain.answer(**WITH_GOAL)
    assert ''.join(capfd.readouterr()).count('predict_subgoal refused') == 2


def test_a_picture_whose_robot_mask_is_missing_is_refused(services):
    masked = services['masked']
    masked.answer(start=START, goal=GOAL)  # what a request brings along stays as it is
    images = masked.client_node.create_publisher(Image, '/masked/camera/image_raw', STREAM)

    def refused():
        images.publish(START)
        message = masked.ask(goal=GOAL).message
        return 'camera/robot_mask' in message and '2.500000000 s' in message
    assert until(refused)


def test_a_request_right_after_the_start_waits_until_a_camera_is_found(
        client, files, monkeypatch):
    monkeypatch.setattr(requests, 'DISCOVERY_S', 60.0)
    service = Service(client, 'early', weights=files['plain'])
    try:
        answer = service.client.call_async(PredictSubgoal.Request(goal=GOAL))
        assert not until(answer.done, 0.1)
        with Client('early_eye') as eye:
            images = eye.create_publisher(Image, '/early/camera/image_raw', STREAM)
            assert until(lambda: images.publish(START) or answer.done(), 60)
        assert answer.result().success, answer.result().message
    finally:
        assert service.end() == 0


def test_the_command_waits_for_the_first_picture_as_long_as_its_timeout(
        client, files, monkeypatch, tmp_path, capsys):
    monkeypatch.setattr(requests, 'DISCOVERY_S', 0.0)
    service = Service(client, 'dark', weights=files['plain'])
    cv2.imwrite(str(tmp_path / 'goal.png'), PICTURES[1])
    words = ['call', '--namespace', '/dark', '--goal', str(tmp_path / 'goal.png'),
             '--out', str(tmp_path / 'answer.png'), '--timeout']
    codes = []
    try:
        assert main([*words, '6']) == 1
        assert 'nothing has come on /dark/camera/image_raw' in capsys.readouterr().err
        asking = threading.Thread(target=lambda: codes.append(main([*words, '60'])))
        asking.start()
        assert not until(lambda: codes, 2.0)
        with Client('dark_eye') as eye:
            images = eye.create_publisher(Image, '/dark/camera/image_raw', STREAM)
            assert until(lambda: images.publish(START) or codes, 60)
        asking.join()
        assert codes == [0] and (tmp_path / 'answer.png').exists()
    finally:
        assert service.end() == 0


def test_pictures_of_two_cameras_are_refused_unless_one_is_sent_along(services):
    service = services['plain']
    with Client('left_eye') as left, Client('right_eye') as right:
        for camera in (left, right):
            camera.create_publisher(Image, '/plain/camera/image_raw', STREAM)
        words = '2 nodes publish on /plain/camera/image_raw, /left_eye, /right_eye'
        assert until(lambda: words in service.refusal(goal=GOAL))
        service.answer(**WITH_GOAL)


def test_many_requests_at_once_get_their_own_answer_and_beyond_the_queue_busy(services):
    latent = services['latent']
    alone = [pictures(latent.answer(seed=seed, **WITH_GOAL)) for seed in range(8)]
    futures = [latent.client.call_async(PredictSubgoal.Request(seed=seed, **WITH_GOAL))
               for seed in range(8)]
    for future, expected in zip(futures, alone, strict=True):
        assert until(future.done, 60)
        assert future.result().success, future.result().message
        assert differ(pictures(future.result()), expected) < 0.1
    request = PredictSubgoal.Request(num_samples=6, recursion_depth=3, **WITH_GOAL)
    futures = [latent.client.call_async(request) for _ in range(100)]
    assert all(until(future.done, 120) for future in futures)
    refused = [f.result().message for f in futures if not f.result().success]
    assert 0 < len(refused) <= 100 - 64
    assert set(refused) == {'busy: 64 requests are waiting, which is the most that may; ask again'}
    latent.answer(**WITH_GOAL)


def test_each_bound_is_named_and_what_is_refused_touches_nothing(services):
    latent = services['latent']
    before = latent.answer(**WITH_GOAL).subgoals
    thirty = objects(30 * [(8, 9)], [f'cup {n}' for n in range(30)])
    for fields, words in (
            ({'num_samples': 101}, ['num_samples is 101', '1 to 100']),
            ({'num_samples': 51, 'recursion_depth': 4},
             ['num_samples x recursion_depth', '51 x 4 = 204', '200']),
            ({'num_samples': 50, 'recursion_depth': 4, 'start_objects': thirty,
              'goal_objects': thirty}, ['x objects', '50 x 4 x 30 = 6000', '2000']),
            ({'start_objects': objects([(8, 9)], ['cup\n\x1b[2J'])}, ['lacks cup\\n'])):
        message = latent.refusal(**{**WITH_GOAL, **fields})
        assert all(word in message for word in words) and message.isprintable(), message
    assert latent.answer(**WITH_GOAL).subgoals == before


@pytest.mark.errors('no such weights file')
def test_a_node_answers_while_it_is_active_alone_by_the_weights_of_that_time(
        client, files, tmp_path):
    mine = tmp_path / 'mine.safetensors'
    mine.write_bytes(files['plain'].read_bytes())
    digest = stored_digest(mine)
    card = Newest(client, String, '/managed/predictor_node/model_card', LATCHED)
    service = Service(client, 'managed', weights=mine, autostart=False)
    states = Lifecycle(client, '/managed/predictor_node')
    try:
        assert states.now() == State.PRIMARY_STATE_UNCONFIGURED
        assert 'configure, then activate' in service.refusal(**WITH_GOAL)
        assert not states.to('activate'), 'a transition that the state does not have is answered'
        assert states.set('weights', tmp_path / 'none.safetensors') == ''
        assert not states.to('configure')
        assert states.now() == State.PRIMARY_STATE_UNCONFIGURED
        assert states.set('weights', mine) == ''
        assert states.to('configure') and states.now() == State.PRIMARY_STATE_INACTIVE
        weights_file(mine, latent_size=8)  # a newer file is not what was loaded
        assert ('ros2 lifecycle set /managed/predictor_node activate'
                in service.refusal(**WITH_GOAL))
        assert states.to('activate')
        text = card.wait(20).data
        assert text.startswith('# mine.safetensors') and 'No model card' in text
        assert digest in text and str(tmp_path) not in text
        before = pictures(service.answer(**WITH_GOAL))
        request = PredictSubgoal.Request(recursion_depth=8, **WITH_GOAL)
        waiting = [service.client.call_async(request) for _ in range(40)]
        assert until(waiting[0].done, 60)
        reason = states.set('weights', files['latent'])
        assert 'weights' in reason and 'deactivate, then' in reason and 'cleanup' in reason
        assert states.to('deactivate') and 'inactive' in service.refusal(**WITH_GOAL)
        assert all(until(future.done, 60) for future in waiting), 'who waits is answered'
        assert waiting[0].result().success
        refused = [one.result().message for one in waiting if not one.result().success]
        assert all('activate it' in message for message in refused)
        assert 'predictor_node cleanup' in states.set('weights', files['latent'])
        assert states.to('activate')
        assert np.array_equal(before, pictures(service.answer(**WITH_GOAL)))
        assert states.to('deactivate') and states.to('cleanup')
        assert 'no weights' in service.refusal(**WITH_GOAL)
        assert states.set('weights', files['latent']) == ''
        assert states.to('configure') and states.to('activate')
        assert len(service.answer(num_samples=3, **WITH_GOAL).subgoals) == 3, 'these have z'
        assert states.to(Transition.TRANSITION_ACTIVE_SHUTDOWN)
        assert states.now() == State.PRIMARY_STATE_FINALIZED
        assert 'start it again' in service.refusal(**WITH_GOAL)
    finally:
        assert service.end() == 0
