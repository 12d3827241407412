# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""predict_subgoal in all its modes, asked over DDS of real nodes with small untrained networks."""


from lively import lively_network
import numpy as np
from processes import Client, NodeProcess
import pytest
from sensor_msgs.msg import Image
from tap_msgs.msg import ObjectStates, Subgoal
from tap_msgs.srv import PredictSubgoal
from tap_ros.contract import ROBOT_MASK_ARM
from tap_ros.messages.images import decode_image
from tap_ros.nodes.clients import call, Newest, wait_for_future
from tap_ros.nodes.ros_messages import encode_image, encode_objects
from tap_ros.nodes.topics import LATCHED, SERVICE_QOS, STREAM, to_stamp
from tap_ros.training.weights import save_weights

pytestmark = pytest.mark.slow
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
    save_weights(path, network, 'predictor', network.config, {})
    return path


class Service:
    """A node in a namespace of its own, so that several can live side by side, and its client."""

    def __init__(self, node, name, folder, **parameters):
        self.name, self.node = name, node
        self.process = NodeProcess('predictor_node', folder / f'{name}.log', parameters,
                                   ['-r', f'__ns:=/{name}'])
        self.client = node.create_client(PredictSubgoal, f'/{name}/predict_subgoal')
        self.subgoal = Newest(node, Subgoal, f'/{name}/subgoal', LATCHED)

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

    def publish(self, topic, message):
        publisher = self.node.create_publisher(type(message), f'/{self.name}/{topic}', LATCHED)
        publisher.publish(message)
        return publisher


@pytest.fixture(scope='module')
def services(tmp_path_factory):
    """Start nodes with both modes, forward only, and without z."""
    folder = tmp_path_factory.mktemp('predictors')
    between = weights_file(folder / 'between.safetensors', latent_size=8)
    forward = weights_file(folder / 'forward.safetensors', num_context=1, latent_size=8)
    plain = weights_file(folder / 'plain.safetensors')
    started = {}
    with Client() as node:
        try:
            for name, files in (('both', {'weights': between, 'forward_weights': forward}),
                                ('forward', {'weights': forward}), ('plain', {'weights': plain}),
                                ('masked', {'weights': plain, 'robot_mask': 'all'})):
                started[name] = Service(node, name, folder, **files)
            for service in started.values():
                service.process.wait_for('ready', 120)
                assert service.client.wait_for_service(30)
            yield started
            for service in started.values():
                assert service.process.end() == 0, service.process.text
                assert 'Traceback' not in service.process.text
        finally:
            for service in started.values():
                service.process.kill()


def pictures(response):
    return np.array([decode_image(s.image, 'subgoal').astype(int) for s in response.subgoals])


def differ(a, b):
    """Return the mean absolute difference of two pictures, from 0 to 255."""
    return np.abs(a - b).mean()


@pytest.mark.parametrize('mode', ['bidirectional', 'forward'])
def test_samples_and_levels_are_told_apart(services, mode):
    both = services['both']
    response = both.answer(mode=mode, num_samples=3, recursion_depth=2, seed=4, **WITH_GOAL)
    assert list(response.sample) == [0, 0, 1, 1, 2, 2]
    assert list(response.level) == ([2, 1] if mode == 'bidirectional' else [1, 2]) * 3
    seen = pictures(response)
    assert all(differ(seen[i], seen[j]) > 3 for i in range(6) for j in range(i))
    assert response.message.startswith(f'{mode}, 6 subgoals, maps of cup, box')
    for subgoal in response.subgoals:
        assert subgoal.header.stamp == STAMP and subgoal.header.frame_id == 'eye'
        assert tuple(subgoal.object_names) == NAMES
        assert len(subgoal.object_maps) == len(subgoal.expected_pixels) == 2
    again = both.answer(mode=mode, num_samples=3, recursion_depth=2, seed=4, **WITH_GOAL)
    assert again.subgoals == response.subgoals
    other = both.answer(mode=mode, num_samples=3, recursion_depth=2, seed=5, **WITH_GOAL)
    assert differ(pictures(other), seen) > 3
    published = both.subgoal.wait(10, lambda m: m == other.subgoals[0])
    assert published.image == other.subgoals[0].image  # the first sample's earliest


def test_an_empty_mode_is_what_the_weights_are_for(services):
    both, forward = services['both'], services['forward']
    asked = both.answer(mode='bidirectional', **WITH_GOAL)
    assert both.answer(**WITH_GOAL).subgoals == asked.subgoals
    assert asked.message.startswith('bidirectional, 1 subgoal,')
    ahead = both.answer(mode='forward', **ALONE)
    assert forward.answer(**ALONE).subgoals == ahead.subgoals  # the same weights
    assert forward.answer(mode='forward', **ALONE).subgoals == ahead.subgoals
    assert differ(pictures(ahead), pictures(asked)) > 3


def test_going_forward_needs_no_goal_and_uses_none(services):
    both = services['both']
    ahead = both.answer(mode='forward', **ALONE)
    assert both.answer(mode='forward', **WITH_GOAL).subgoals == ahead.subgoals
    no_objects = both.answer(mode='forward', start=START)
    assert 'no object maps: start_objects are empty' in no_objects.message
    assert (pictures(no_objects) == pictures(ahead)).all()
    message = both.refusal(**ALONE)
    for words in ('goal', '/both/goal/image', 'mode forward'):
        assert words in message
    # A sender of a goal expects it to matter.
    message = services['forward'].refusal(**WITH_GOAL)
    for words in ('goal', 'forward weights only', 'weights:=', 'leave goal'):
        assert words in message


def test_a_mode_without_weights_says_how_to_get_it(services):
    assert '-p forward_weights:=' in services['plain'].refusal(mode='forward', **ALONE)
    assert '-p weights:=' in services['forward'].refusal(mode='bidirectional', **WITH_GOAL)
    message = services['both'].refusal(mode='backward', **WITH_GOAL)
    for words in ('mode', 'backward', 'bidirectional, forward'):
        assert words in message


def test_weights_without_z_give_one_sample_and_say_so(services):
    plain = services['plain']
    response = plain.answer(num_samples=5, recursion_depth=2, **WITH_GOAL)
    assert list(response.sample) == [0, 0] and list(response.level) == [2, 1]
    assert 'one sample instead of 5' in response.message
    assert 'latent variable' in response.message
    single = plain.answer(recursion_depth=2, **WITH_GOAL)
    assert single.subgoals == response.subgoals and 'latent' not in single.message
    many = services['both'].answer(num_samples=5, **WITH_GOAL)
    assert len(many.subgoals) == 5 and 'latent' not in many.message


def test_why_there_are_no_maps_is_said_of_each_picture(services):
    plain = services['plain']
    response = plain.answer(start=START, goal=GOAL, start_objects=START_OBJECTS)
    assert response.message.endswith('no object maps: goal_objects are empty')
    publishers = [plain.publish('goal/image', GOAL)]

    def reason(words):
        """Ask until what was published has come."""
        for _ in range(50):
            response = plain.ask(**ALONE)
            if words in response.message:
                break
        assert words in response.message
        assert response.success
        return response

    reason('no object maps: nothing has come on /plain/goal/objects')
    publishers += [plain.publish('goal/objects', objects(
        [(12, 13), (24, 17)], stamp=to_stamp(1_250_000_000)))]
    response = reason('/plain/goal/objects has the stamp 1.250000000 s')
    assert 'the picture on /plain/goal/image 2.500000000 s' in response.message
    assert 'start' not in response.message
    publishers += [plain.publish('goal/objects', GOAL_OBJECTS)]
    response = reason('maps of cup, box')
    assert response.subgoals == plain.answer(**WITH_GOAL).subgoals


def test_the_robot_is_taken_out_of_the_newest_picture(services):
    masked = services['masked']
    assert 'robot_mask is all, but the bidirectional weights' in masked.process.text
    scene, goal = PICTURES
    mask = np.zeros((32, 32), np.uint8)
    mask[5:20, 8:24] = ROBOT_MASK_ARM
    robot = np.where(mask[..., None] > 0, 255 - scene, scene)
    expected, differing = (
        pictures(masked.answer(start=encode_image(picture, STAMP, 'eye'), goal=GOAL))
        for picture in (scene, robot))  # what a request brings along stays as it is
    assert differ(expected, differing) > 1
    images = masked.node.create_publisher(Image, '/masked/camera/image_raw', STREAM)
    masks = masked.node.create_publisher(Image, '/masked/camera/robot_mask', STREAM)

    def publish(picture, hidden, stamp):
        images.publish(encode_image(picture, to_stamp(stamp), 'eye'))
        if hidden is not None:
            message = Image(height=32, width=32, step=32, encoding='mono8', data=hidden.tobytes())
            message.header.stamp = to_stamp(stamp)
            masks.publish(message)

    stamp, response = 10**9, None
    for _ in range(100):  # until it is discovered
        stamp += 10**8
        publish(scene, mask * 0, stamp)
        response = masked.ask(goal=GOAL)
        if response.success:
            break
    assert response.success, response.message
    assert (pictures(response) == expected).all()
    publish(robot, mask, stamp + 10**8)
    publish(robot, mask, stamp + 2 * 10**8)
    for _ in range(100):
        response = masked.answer(goal=GOAL)
        if response.subgoals[0].header.stamp == to_stamp(stamp + 2 * 10**8):
            break
    assert (pictures(response) == expected).all()
    publish(robot, None, stamp + 3 * 10**8)
    for _ in range(100):
        response = masked.ask(goal=GOAL)
        if not response.success:
            break
    assert '/masked/camera/robot_mask' in response.message
    assert f'{(stamp + 3 * 10**8) / 1e9:.9f} s' in response.message


def test_many_requests_at_once_all_get_their_own_answer(services):
    both = services['both']
    client = both.node.create_client(
        PredictSubgoal, '/both/predict_subgoal', qos_profile=SERVICE_QOS)
    assert client.wait_for_service(30)
    modes = ('bidirectional', 'forward')
    alone = [pictures(both.answer(mode=mode, seed=seed, **WITH_GOAL))
             for seed in range(8) for mode in modes]
    futures = [client.call_async(PredictSubgoal.Request(mode=mode, seed=seed, **WITH_GOAL))
               for seed in range(8) for mode in modes]
    for future, expected in zip(futures, alone, strict=True):
        assert wait_for_future(future, 60)
        assert future.result().success, future.result().message
        assert differ(pictures(future.result()), expected) < 0.1


def test_beyond_the_queue_requests_are_told_that_the_node_is_busy(services):
    both = services['both']
    client = both.node.create_client(
        PredictSubgoal, '/both/predict_subgoal', qos_profile=SERVICE_QOS)
    assert client.wait_for_service(30)
    request = PredictSubgoal.Request(
        mode='forward', num_samples=6, recursion_depth=8, **WITH_GOAL)
    futures = [client.call_async(request) for _ in range(150)]
    assert all(wait_for_future(future, 120) for future in futures)
    refused = [f.result().message for f in futures if not f.result().success]
    assert 0 < len(refused) <= 150 - 64
    assert set(refused) == {
        'busy: 64 requests are waiting, which is the most that may; ask again'}
    both.answer(**WITH_GOAL)


def test_each_bound_is_named_and_what_is_refused_touches_nothing(services):
    both = services['both']
    before = both.answer(**WITH_GOAL).subgoals
    crowd = [f'cup {n}' for n in range(10_000)]
    thirty = objects(30 * [(8, 9)], crowd[:30])
    forged = 'cup\n[INFO] [0.0] [predictor_node]: all is well\x1b[2J'
    large = encode_image(np.zeros((1, 12 * 2**20, 3), np.uint8), STAMP, 'eye')
    for fields, words in (
            ({'start_objects': objects(10_000 * [(8, 9)], crowd), 'recursion_depth': 8},
             ['start_objects', '10000 objects', '32']),
            ({'num_samples': 51, 'recursion_depth': 4},
             ['num_samples x recursion_depth', '51 x 4 = 204', '200']),
            ({'num_samples': 50, 'recursion_depth': 4, 'start_objects': thirty,
              'goal_objects': thirty}, ['x objects', '50 x 4 x 30 = 6000', '2000']),
            ({'start': large}, ['start', '37748736 bytes', '33554432']),
            ({'start_objects': objects([(8, 9), (5.4e8, 21)])},
             ['start_objects: box', '(540000000.0, 21.0)', 'outside', '-0.5 to 31.5']),
            ({'goal_objects': objects([(8, 9), (20, -7)])},
             ['goal_objects: box', '(20.0, -7.0)', 'outside', '-0.5 to 31.5']),
            ({'start_objects': objects([(8, 9), (8, 9)], [forged, forged])}, ['cup\\n[INFO]']),
            ({'start_objects': objects([(8, 9)], [forged])}, ['lacks cup\\n[INFO]']),
            ({'mode': forged}, ['cup\\n[INFO]'])):
        message = both.refusal(**{**WITH_GOAL, **fields})
        for word in words:
            assert word in message
        assert message.isprintable()
        assert both.answer(**WITH_GOAL).subgoals == before
    assert '\n[INFO] [0.0]' not in both.process.text and '\x1b[2J' not in both.process.text


@pytest.mark.parametrize('swapped', [False, True])
def test_forward_weights_must_be_that_and_given_once(tmp_path, swapped):
    between = weights_file(tmp_path / 'between.safetensors')
    forward = weights_file(tmp_path / 'forward.safetensors', num_context=1)
    given = {'weights': forward if swapped else between,
             'forward_weights': forward if swapped else between}
    process = NodeProcess('predictor_node', tmp_path / 'log.txt', given)
    try:
        assert process.process.wait(120) == 1
        line, = [line for line in process.text.splitlines() if line.strip()]
        assert '[FATAL]' in line and 'forward_weights' in line
        assert str(forward if swapped else between) in line
    finally:
        process.kill()
