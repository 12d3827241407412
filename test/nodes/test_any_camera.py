# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Cameras as people have them: 640x480, compressed, best effort; heard by real nodes over DDS."""

import time

import cv2
from lively import lively_network
import numpy as np
from processes import Client, until
import pytest
from rclpy.qos import qos_profile_sensor_data, QoSProfile
from sensor_msgs.msg import CompressedImage
from tap_msgs.msg import ObjectStates
from tap_ros.errors import ImageError
from tap_ros.images.crop import Crop, TrainedCrop
from tap_ros.messages.images import decode_image
from tap_ros.messages.stamps import to_nanoseconds
from tap_ros.nodes.observations import Observations
from tap_ros.nodes.planner.planner_inputs import PlannerInputs
from tap_ros.nodes.planner.settings import declare_parameters
from tap_ros.nodes.ros_messages import encode_image
from tap_ros.nodes.topics import LATCHED, to_stamp
from tap_ros.prediction.predictor import SubgoalPredictor
from tap_ros.training.weights import save_weights
from test_predictor_node import objects, Service, STAMP

pytestmark = pytest.mark.slow
PIXELS = np.array([(200.0, 100.0), (320.0, 240.0)])  # in pictures of 640x480
TRAINING = {'settings': {'crop': 'centre', 'size': 32}, 'camera_size': [480, 640]}


START, GOAL = (cv2.resize(coarse, (640, 480), interpolation=cv2.INTER_CUBIC) for coarse in
               np.random.default_rng(0).integers(0, 256, (2, 12, 16, 3), np.uint8))


def jpeg(picture):
    data = cv2.imencode('.jpg', picture[..., ::-1])[1].tobytes()
    message = CompressedImage(format='rgb8; jpeg compressed bgr8', data=data)
    message.header.stamp, message.header.frame_id = STAMP, 'eye'
    return message


@pytest.fixture(scope='module')
def weights(tmp_path_factory):
    path = tmp_path_factory.mktemp('weights') / 'cut.safetensors'
    network = lively_network()
    save_weights(path, network, 'predictor', network.config, TRAINING)
    return path


def test_a_large_best_effort_camera_is_heard_and_cut_as_in_training(client, weights, capfd):
    start, goal = jpeg(START), jpeg(GOAL)
    places, goal_places = objects(PIXELS), objects(PIXELS[::-1])
    service = Service(client, 'compressed', weights=weights, image_transport='compressed')
    try:
        volatile = QoSProfile(depth=1)  # of a goal, as `ros2 topic pub` has it
        answer = service.until('maps of', [
            (service.publisher(type(message), topic, qos), message)
            for message, topic, qos in (
                (start, 'camera/image_raw/compressed', qos_profile_sensor_data),
                (places, 'objects', qos_profile_sensor_data),
                (goal, 'goal/image/compressed', volatile),
                (goal_places, 'goal/objects', volatile))])
        assert 'taken best_effort and volatile, as it is published' in capfd.readouterr().err
        picture = encode_image(START, STAMP, 'eye')
        beside = objects([(20.0, 200.0)], ('cup',))
        message = service.refusal(
            start=picture, goal=picture, start_objects=beside, goal_objects=beside)
        assert ('start_objects: cup not in the part of the picture that the weights see, 480x480 '
                'pixels from (80, 0) on') in message
        # Pictures that are cut already are taken as they are.
        small = encode_image(np.ascontiguousarray(START[:32, :32]), STAMP, 'eye')
        service.answer(start=small, goal=small)
    finally:
        service.end()
    predictor = SubgoalPredictor.load(weights)
    cut = predictor.camera_crop.of((480, 640), 'goal')
    pixels = cut.pixels(PIXELS.astype(np.float32), (480, 640))
    expected, = predictor.predict(*(cut.image(decode_image(one)) for one in (start, goal)),
                                  pixels, pixels[::-1].copy())
    found = decode_image(answer.subgoals[0].image, 'subgoal').astype(int)
    assert np.abs(found - expected.image).max() <= 1
    assert to_nanoseconds(answer.subgoals[0].header.stamp) == to_nanoseconds(STAMP)


def test_what_was_latched_before_does_not_come_back(client):
    """A goal by hand, volatile, is not undone when its publisher has left."""
    old, new = (objects([(u, 8.0)], ('cup',), to_stamp(u * 10**9)) for u in (3, 5))
    kept = client.create_publisher(ObjectStates, 'goal/objects', LATCHED)
    kept.publish(old)
    asked, observed = (Observations('objects', latched=True) for _ in range(2))
    for observations, on_demand in ((asked, True), (observed, False)):
        observations.subscribe(client, {'objects': (ObjectStates, 'goal/objects')}, LATCHED,
                               on_demand=on_demand)

    def newest():
        return [found['objects'].objects[0].u if (found := each.newest('objects')) else None
                for each in (asked, observed)]

    assert until(lambda: newest() == [3, 3])
    by_hand = client.create_publisher(ObjectStates, 'goal/objects', QoSProfile(depth=1))
    assert until(lambda: by_hand.publish(new) or newest() == [5, 5], pause=0.2)
    client.destroy_publisher(by_hand)
    # Longer than it takes to look at what is offered.
    assert not until(lambda: newest() != [5, 5], 2, pause=0.1)


def test_the_planner_sees_the_part_that_its_model_was_trained_on():
    crop = TrainedCrop(Crop('centre', 64), (480, 640), (64, 64))
    with Client('planner') as node:
        inputs = PlannerInputs(node, declare_parameters(node), lambda: crop, lambda name: None)
        cut = crop.crop.image(START)
        # Pixels of a goal picture that is cut already are those of the part.
        for picture, pixels in ((START, PIXELS), (cut, (PIXELS - [80, 0] + 0.5) * 64 / 480 - 0.5)):
            np.testing.assert_array_equal(inputs.cut(picture, 'goal'), cut)
            names, found = inputs.decode_positions(
                objects(pixels), 'goal_objects', picture.shape[:2])
            assert names == ('cup', 'box')
            np.testing.assert_allclose(found, (PIXELS - [80, 0] + 0.5) * 64 / 480 - 0.5, atol=1e-5)
        # Another camera shows the table elsewhere.
        other = to_stamp(9 * 10**9)
        inputs.sensors.put('image', encode_image(
            np.ascontiguousarray(START[:240, :320]), other, 'eye'))
        inputs.sensors.put('objects', objects(PIXELS, names, other))
        inputs.sensors.attach('joints', 9 * 10**9, np.zeros(4, np.float32), time.monotonic())
        with pytest.raises(ImageError, match='320x240 pixels; the forward model was trained on '
                                             'those of 640x480'):
            inputs.look()
