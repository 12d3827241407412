# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Serves predict_subgoal: decode, call SubgoalPredictor, encode."""

from dataclasses import dataclass
from pathlib import Path
import sys
import time

from builtin_interfaces.msg import Time
from geometry_msgs.msg import Point
import numpy as np
from rclpy.callback_groups import MutuallyExclusiveCallbackGroup
from rclpy.node import Node
from sensor_msgs.msg import Image
from tap_msgs.msg import ObjectStates, Subgoal
from tap_msgs.srv import PredictSubgoal
from tap_ros.errors import ConfigError, ImageError, TapError, WeightsError
from tap_ros.nodes.image_messages import (
    decode_image,
    encode_image,
    encode_map,
    is_empty,
    resize_pixels,
)
from tap_ros.nodes.object_messages import decode_objects, match_objects
from tap_ros.nodes.observations import Observations
from tap_ros.nodes.parameters import check_device, Parameters
from tap_ros.nodes.run import run_node
from tap_ros.nodes.topics import CAMERA_FRAME, LATCHED, STREAM
from tap_ros.pictures import overlay
from tap_ros.prediction.predictor import SubgoalPredictor

DEFAULT_WEIGHTS = Path(__file__).parents[1] / 'weights' / 'predictor_push.safetensors'
OVERLAY_SCALE = 4  # pixels of subgoal/overlay per pixel of the picture
MAX_SAMPLES = 100
MAX_DEPTH = 8


@dataclass(frozen=True)
class View:
    """A picture that came with a request or from a topic, ready for the predictor."""

    image: np.ndarray  # (H, W, 3) uint8
    names: tuple  # K object names
    pixels: np.ndarray  # (K, 2) float32 (u, v)
    stamp: Time
    frame_id: str


class PredictorNode(Node):
    """Offers the service only once the weights are loaded, checked and warmed up."""

    def __init__(self):
        super().__init__('predictor_node')
        self.params = declare_parameters(self)
        self._predictor = load_predictor(self.params['weights'], self.params['device'])
        self._camera = Observations('image', 'objects')
        self._camera.subscribe(
            self, {'image': (Image, 'camera/image_raw'), 'objects': (ObjectStates, 'objects')},
            STREAM)
        self._goal = Observations('image', 'objects')
        self._goal.subscribe(
            self, {'image': (Image, 'goal/image'), 'objects': (ObjectStates, 'goal/objects')},
            LATCHED)
        self._subgoal = self.create_publisher(Subgoal, 'subgoal', LATCHED)
        self._picture = self.create_publisher(Image, 'subgoal/image', LATCHED)
        self._overlay = self.create_publisher(Image, 'subgoal/overlay', LATCHED)
        # Its own group: images keep coming in while the network works.
        self.create_service(PredictSubgoal, 'predict_subgoal', self._on_request,
                            callback_group=MutuallyExclusiveCallbackGroup())
        height, width = self._predictor.image_size
        self.get_logger().info(
            f'ready: {width}x{height} pixels, {self.params["device"]}, {self.params["weights"]}')

    def close(self):
        """Do nothing: there is nothing to end."""

    def _on_request(self, request, response):
        try:
            self._predict(request, response)
        except TapError as error:
            self.get_logger().warning(f'predict_subgoal refused: {error}')
            response = PredictSubgoal.Response(success=False, message=str(error))
        return response

    def _predict(self, request, response):
        num_samples = check_count(request.num_samples, 'num_samples', MAX_SAMPLES)
        depth = check_count(request.recursion_depth, 'recursion_depth', MAX_DEPTH)
        start = self._view(request.start, request.start_objects, 'start', self._camera)
        goal = self._view(request.goal, request.goal_objects, 'goal', self._goal)
        names, start_pixels, goal_pixels = start.names, None, None
        if start.names and goal.names:
            start_pixels = start.pixels
            goal_pixels = match_objects(
                names, goal.names, goal.pixels, 'start_objects', 'goal_objects')
        else:
            names = ()
        begin = time.perf_counter()
        subgoals = self._predictor.predict(
            start.image, goal.image, start_pixels, goal_pixels, num_samples=num_samples,
            recursion_depth=depth, seed=request.seed)
        response.model_time_ms = (time.perf_counter() - begin) * 1e3
        response.subgoals = [
            encode_subgoal(subgoal, names, start.stamp, start.frame_id) for subgoal in subgoals]
        response.success = True
        response.message = f'{len(subgoals)} subgoals, ' + (
            f'maps of {", ".join(names)}' if names
            else 'no object maps, as the objects of start or goal are unknown')
        if len(subgoals) < num_samples * depth:
            response.message += '; weights without a latent variable give one sample only'
        self._subgoal.publish(response.subgoals[0])
        self._picture.publish(response.subgoals[0].image)
        picture = overlay(start.image, subgoals[0].object_maps, OVERLAY_SCALE, start_pixels,
                          goal_pixels)
        self._overlay.publish(encode_image(picture, start.stamp, start.frame_id))

    def _view(self, image, objects, name, newest):
        """Decode a picture and its objects; take the newest ones if it was left empty."""
        if is_empty(image):
            found = newest.newest('image')
            if found is None:
                topic = {'start': 'camera/image_raw', 'goal': 'goal/image'}[name]
                raise ImageError(
                    f'{name}: the request has none and nothing has come on '
                    f'{self.resolve_topic_name(topic)}; publish one there (the simulator does at '
                    'sim/reset), or send it along')
            image = found['image']
            objects = objects if objects.objects else found.get('objects', objects)
        size = self._predictor.image_size
        picture = decode_image(image, name, size, resize=self.params['resize_images'])
        names, pixels = decode_objects(objects, f'{name}_objects')
        pixels = resize_pixels(pixels, (image.height, image.width), size)
        return View(picture, names, pixels, image.header.stamp,
                    image.header.frame_id or CAMERA_FRAME)


def declare_parameters(node):
    """Declare the parameters of the node."""
    parameters = Parameters(node)
    parameters.declare('weights', str(DEFAULT_WEIGHTS),
                       'File of weights (.safetensors) of a subgoal predictor.')
    parameters.declare('device', 'cpu', 'Where the network runs, as torch names it: cpu, cuda.',
                       choices=['cpu', 'cuda'])
    parameters.declare('resize_images', False,
                       'Resize pictures of another size than the weights are made for, instead of '
                       'refusing them; answers have the size of the weights.', read_only=False)
    return parameters


def load_predictor(path, device):
    """
    Load weights, and predict once, so that the first request is as fast as the others.

    :raises WeightsError: when the file cannot be used or predicts nonsense.
    :raises ConfigError: when the device is not there.
    """
    check_device(device)
    predictor = SubgoalPredictor.load(path, device=device)
    height, width = predictor.image_size
    picture = np.full((height, width, 3), 128, np.uint8)
    pixels = np.array([[width / 4, height / 4], [width / 2, height / 2]], np.float32)
    subgoal, = predictor.predict(picture, picture, pixels, pixels)
    if not np.allclose(subgoal.object_maps.sum((1, 2)), 1, atol=1e-3):
        raise WeightsError(
            f'{path}: predicts object maps that do not sum to 1; the weights are damaged or were '
            'not trained, train them again')
    return predictor


def check_count(value, name, highest):
    """Return a count of a request, 1 for 0; raise ConfigError above the highest."""
    if value > highest:
        raise ConfigError(f'{name} is {value}; expected 1 to {highest}, or 0 for 1')
    return value or 1


def encode_subgoal(subgoal, names, stamp, frame_id):
    """Turn a Subgoal of the predictor into a message."""
    message = Subgoal(
        image=encode_image(subgoal.image, stamp, frame_id), object_names=list(names),
        object_maps=[encode_map(values, stamp, frame_id) for values in subgoal.object_maps],
        expected_pixels=[Point(x=float(u), y=float(v)) for u, v in subgoal.expected_pixels])
    message.header.stamp = stamp
    message.header.frame_id = frame_id
    return message


def main(args=None):
    """Run the node; the answer is the exit code of the process."""
    return run_node(PredictorNode, 'predictor_node', args, num_threads=3)


if __name__ == '__main__':
    sys.exit(main())
