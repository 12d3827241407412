# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Cameras as people have them: 640x480, compressed, best effort; heard by real nodes over DDS."""

from contextlib import contextmanager
import io
import time

from lively import lively_network
import numpy as np
from PIL import Image as Picture
from processes import Client, until
import pytest
from rclpy.parameter import Parameter
from rclpy.qos import qos_profile_sensor_data, QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import CompressedImage, Image
from tap_msgs.msg import ObjectStates
from tap_ros.errors import ConfigError, ImageError
from tap_ros.images.crop import Crop, TrainedCrop
from tap_ros.messages.images import decode_image
from tap_ros.messages.stamps import to_nanoseconds
from tap_ros.nodes.observations import Observations, OnDemandObservations
from tap_ros.nodes.planner.planner_inputs import PlannerInputs
from tap_ros.nodes.planner.settings import declare_parameters
from tap_ros.nodes.ros_messages import encode_image, encode_joints, encode_objects
from tap_ros.nodes.subscriptions import AdaptiveSubscription, subscribe
from tap_ros.nodes.topics import LATCHED, STREAM, to_stamp
from tap_ros.prediction.predictor import SubgoalPredictor
from tap_ros.recording.messages import encode
from tap_ros.recording.reader import iter_episodes
from tap_ros.recording.reading import trained_reading
from tap_ros.recording.writer import BagWriter
from tap_ros.training.weights import save_weights
from test_predictor_node import Service

pytestmark = pytest.mark.slow
STAMP = to_stamp(2_500_000_000)
PIXELS = np.array([(200.0, 100.0), (320.0, 240.0)])  # in pictures of 640x480
TRAINING = {'settings': {'crop': 'centre', 'size': 32}, 'camera_size': [480, 640]}


def positions(names, pixels, stamp=STAMP):
    return encode_objects(names, pixels, [[0, 0, 0, 0, 0, 0, 1]] * len(names), stamp, 'world',
                          ObjectStates.SOURCE_TRACKED)


def photograph(seed):
    """Return a picture of 640x480 pixels with much in it."""
    coarse = np.random.default_rng(seed).integers(0, 256, (12, 16, 3), np.uint8)
    return np.array(Picture.fromarray(coarse).resize((640, 480), Picture.Resampling.BICUBIC))


START, GOAL = photograph(0), photograph(1)


def jpeg(picture):
    buffer = io.BytesIO()
    Picture.fromarray(picture).save(buffer, 'JPEG', quality=90)
    message = CompressedImage(format='rgb8; jpeg compressed bgr8')
    message.header.stamp, message.header.frame_id = STAMP, 'eye'
    message.data = buffer.getvalue()
    return message


@pytest.fixture(scope='module')
def weights(tmp_path_factory):
    path = tmp_path_factory.mktemp('weights') / 'cut.safetensors'
    network = lively_network()
    save_weights(path, network, 'predictor', network.config, TRAINING)
    return path


@contextmanager
def running(client, name, overrides=None, **parameters):
    """Start a predictor node of its own namespace, and end it."""
    service = Service(client, name, **parameters, **(overrides or {}))
    try:
        yield service
    finally:
        service.end()


@pytest.mark.parametrize('transport', ['raw', 'compressed'])
def test_a_large_best_effort_camera_is_heard_and_cut_as_in_training(
        client, weights, tmp_path, capfd, transport):
    start, topic = (jpeg(START), 'camera/image_raw/compressed') if transport == 'compressed' else (
        encode_image(START, STAMP, 'eye'), 'camera/image_raw')
    goal = encode_image(GOAL, STAMP, 'eye')
    objects, goal_objects = (
        positions(('cup', 'box'), pixels) for pixels in (PIXELS, PIXELS[::-1]))
    with running(client, transport, weights=weights, image_transport=transport) as service:
        volatile = QoSProfile(depth=1)  # of a goal, as `ros2 topic pub` has it
        sends = [
            (service.publisher(type(start), topic, qos_profile_sensor_data), start),
            (service.publisher(ObjectStates, 'objects', qos_profile_sensor_data), objects),
            (service.publisher(Image, 'goal/image', volatile), goal),
            (service.publisher(ObjectStates, 'goal/objects', volatile), goal_objects)]
        answer = service.until('maps of', sends)
        assert 'taken best_effort and volatile, as it is published' in capfd.readouterr().err
    # What was recorded is read as the same picture, so the answer is that of the recording.
    with BagWriter(tmp_path / 'bag') as writer:
        kind = f'sensor_msgs/msg/{type(start).__name__}'
        if transport == 'compressed':
            fields = {'format': start.format, 'data': np.frombuffer(start.data, np.uint8)}
        else:
            fields = {'height': 480, 'width': 640, 'encoding': 'rgb8', 'step': 1920,
                      'data': START}
        writer.write_raw(f'/{topic}', kind, encode(kind, {
            'header': {'stamp': {'sec': 2}}, **fields}), 2)
    (episode,) = iter_episodes(tmp_path / 'bag', trained_reading(TRAINING))
    predictor = SubgoalPredictor.load(weights)
    live = predictor.camera_crop.of((480, 640), 'start').image(decode_image(start, 'start'))
    assert np.array_equal(episode.frames[0], live)
    cut = predictor.camera_crop.of((480, 640), 'goal')
    pixels = cut.pixels(PIXELS.astype(np.float32), (480, 640))
    (expected,) = predictor.predict(
        episode.frames[0], cut.image(GOAL), pixels, pixels[::-1].copy())
    found = decode_image(answer.subgoals[0].image, 'subgoal').astype(int)
    assert np.abs(found - expected.image).max() <= 1
    assert to_nanoseconds(answer.subgoals[0].header.stamp) == to_nanoseconds(STAMP)


def test_what_was_latched_before_does_not_come_back(client):
    """A goal by hand, volatile, is not undone when its publisher has left."""
    old, new = (positions(('cup',), [(u, 8.0)], to_stamp(u * 10**9)) for u in (3, 5))
    kept = client.create_publisher(ObjectStates, 'goal/objects', LATCHED)
    kept.publish(old)
    types = {'objects': (ObjectStates, 'goal/objects')}
    pulled = OnDemandObservations(client, types, LATCHED, True)
    observed = Observations('objects', latched=True)
    observed.subscribe(client, types, LATCHED)

    def newest():
        return [found['objects'].objects[0].u if (found := each.newest('objects')) else None
                for each in (pulled, observed)]

    assert until(lambda: newest() == [3, 3])
    by_hand = client.create_publisher(ObjectStates, 'goal/objects', QoSProfile(depth=1))
    assert until(lambda: by_hand.publish(new) or newest() == [5, 5], pause=0.2)
    client.destroy_publisher(by_hand)
    # Longer than it takes to look at what is offered.
    assert not until(lambda: newest() != [5, 5], 2, pause=0.1)


def test_overrides_change_that_subscription_alone_and_wrong_ones_are_named(client):
    topic = client.resolve_topic_name('camera/image_raw')
    name = f'qos_overrides.{topic}.subscription.reliability'
    with Client('overridden', parameter_overrides=[Parameter(name, value='best_effort')]) as node:
        made = subscribe(node, Image, 'camera/image_raw', print, STREAM)
        assert made.qos_profile.reliability == ReliabilityPolicy.BEST_EFFORT
        heard = AdaptiveSubscription(node, Image, 'camera/image_raw', print, STREAM)
        assert heard.subscription.qos_profile.reliability == ReliabilityPolicy.BEST_EFFORT
    assert STREAM.reliability == ReliabilityPolicy.RELIABLE, 'others share it'
    for wrong in ('besteffort', 7):
        with Client('wrong', parameter_overrides=[Parameter(name, value=wrong)]) as node:
            with pytest.raises(ConfigError, match='qos_overrides.*reliable, best_effort'):
                subscribe(node, Image, 'camera/image_raw', print, STREAM)


def test_an_object_beside_the_part_that_is_seen_is_named(client, weights):
    beside = positions(('cup',), [(20.0, 200.0)])
    with running(client, 'beside', weights=weights) as service:
        picture = encode_image(START, STAMP, 'eye')
        message = service.refusal(
            start=picture, goal=picture, start_objects=beside, goal_objects=beside)
        assert ('start_objects: cup not in the part of the picture that the weights see, 480x480 '
                'pixels from (80, 0) on') in message
        # Pictures that are cut already are taken as they are.
        small = encode_image(np.ascontiguousarray(START[:32, :32]), STAMP, 'eye')
        service.answer(start=small, goal=small)


def test_who_is_not_heard_because_of_its_quality_of_service_is_named(client, weights):
    override = {'qos_overrides./strict/camera/image_raw.subscription.reliability': 'reliable'}
    with running(client, 'strict', override, weights=weights) as service:
        service.until('nothing has come on /strict/camera/image_raw (no node publishes it)')
        camera = service.publisher(Image, 'camera/image_raw', qos_profile_sensor_data)
        message = encode_image(START, STAMP, 'eye')
        # The middleware knows a publisher before the name of its node.
        answer = service.until(f'its quality of service does not fit, {client.get_name()}',
                               [(camera, message)])
        assert 'qos_overrides./strict/camera/image_raw.subscription.*' in answer.message
        reliable = service.publisher(Image, 'camera/image_raw', STREAM)
        service.until('nothing has come on /strict/goal/image', [(reliable, message)])


@pytest.mark.parametrize('transport', ['raw', 'compressed'])
def test_the_planner_sees_the_part_that_its_model_was_trained_on(client, transport):
    crop = TrainedCrop(Crop('centre', 64), (480, 640), (64, 64))
    with Client('planner', parameter_overrides=[
            Parameter('image_transport', value=transport)]) as node:
        params = declare_parameters(node)
        inputs = PlannerInputs(node, params, lambda: crop, lambda name: None)
        message = jpeg(START) if transport == 'compressed' else encode_image(START, STAMP, 'eye')
        name = inputs._types['image'][1]
        objects = positions(('cup', 'box'), PIXELS)
        joints = encode_joints(np.array([0.1, 0.2, 0.05, 0.5]), STAMP, 'world')
        publishers = [(client.create_publisher(type(one), topic, qos_profile_sensor_data), one)
                      for topic, one in ((name, message), ('objects', objects),
                                         ('joint_states', joints))]

        def look():
            for publisher, one in publishers:
                publisher.publish(one)
            return inputs.look(inputs.topics())[0]

        seen = until(look, pause=0.2)
        assert seen is not None
        shown = decode_image(message, 'start')
        assert np.array_equal(seen.image, crop.crop.image(shown))
        np.testing.assert_allclose(seen.pixels, (PIXELS - [80, 0] + 0.5) * 64 / 480 - 0.5)
        # What it asks the predictor about is the whole picture, raw.
        assert isinstance(inputs.messages['image'], Image)
        assert np.array_equal(decode_image(inputs.messages['image'], 'start'), shown)
        names, pixels = inputs.decode_positions(objects, 'goal_objects', None)
        np.testing.assert_allclose(pixels, seen.pixels)
        # Pixels of a goal picture that is cut already are those of the part.
        small = encode_image(crop.crop.image(shown), STAMP, 'eye')
        np.testing.assert_allclose(inputs.decode_positions(
            positions(names, pixels), 'goal_objects', small)[1], pixels)
        assert np.array_equal(inputs.cut(small, 'goal'), seen.image)
        # Another camera shows the table elsewhere.
        inputs.begin(time.monotonic())
        other = encode_image(np.ascontiguousarray(START[:240, :320]), to_stamp(9 * 10**9), 'eye')
        inputs.sensors.put('image', other)
        inputs.sensors.put('objects', positions(names, PIXELS, to_stamp(9 * 10**9)))
        inputs.sensors.attach('joints', 9 * 10**9, np.zeros(4, np.float32), time.monotonic())
        with pytest.raises(ImageError, match='320x240 pixels; the forward model was trained on '
                                             'those of 640x480'):
            inputs.look(inputs.topics())
