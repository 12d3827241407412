# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Serves predict_subgoal: decode, call SubgoalPredictor, encode."""

from dataclasses import dataclass
import sys
import time

from builtin_interfaces.msg import Time
import numpy as np
from rclpy.callback_groups import MutuallyExclusiveCallbackGroup
from rclpy.node import Node
from sensor_msgs.msg import Image
from tap_msgs.msg import ObjectStates, Subgoal
from tap_msgs.srv import PredictSubgoal
from tap_ros.errors import ImageError, TapError
from tap_ros.nodes.image_messages import decode_image, encode_image, is_empty, resize_pixels
from tap_ros.nodes.object_messages import decode_objects, match_objects
from tap_ros.nodes.observations import Observations
from tap_ros.nodes.predictor_setup import (
    check_count,
    choose_mode,
    declare_parameters,
    load_predictors,
    MAX_DEPTH,
    MAX_SAMPLES,
)
from tap_ros.nodes.run import run_node
from tap_ros.nodes.subgoal_messages import encode_subgoal
from tap_ros.nodes.topics import CAMERA_FRAME, LATCHED, STREAM, to_nanoseconds
from tap_ros.pictures import overlay

TOPICS = {  # what stands in for the fields that a request leaves empty
    'start': {'image': (Image, 'camera/image_raw'), 'objects': (ObjectStates, 'objects')},
    'goal': {'image': (Image, 'goal/image'), 'objects': (ObjectStates, 'goal/objects')}}
OVERLAY_SCALE = 4  # pixels of subgoal/overlay per pixel of the picture
OBJECTS_TIMEOUT = 0.1  # s that the objects of the newest picture may come after it


@dataclass(frozen=True)
class View:
    """A picture that came with a request or from a topic, ready for the predictor."""

    image: np.ndarray  # (H, W, 3) uint8
    names: tuple  # K object names
    pixels: np.ndarray  # (K, 2) float32 (u, v)
    lacking: str  # why there are no objects; empty if there are
    stamp: Time
    frame_id: str


class PredictorNode(Node):
    """Offers the service only once the weights are loaded, checked and warmed up."""

    def __init__(self):
        super().__init__('predictor_node')
        self.params = declare_parameters(self)
        self._predictors = load_predictors(
            self.params['weights'], self.params['forward_weights'], self.params['device'])
        self._newest = {name: Observations(*topics) for name, topics in TOPICS.items()}
        self._newest['start'].subscribe(self, TOPICS['start'], STREAM)
        self._newest['goal'].subscribe(self, TOPICS['goal'], LATCHED)
        self._subgoal = self.create_publisher(Subgoal, 'subgoal', LATCHED)
        self._picture = self.create_publisher(Image, 'subgoal/image', LATCHED)
        self._overlay = self.create_publisher(Image, 'subgoal/overlay', LATCHED)
        # Its own group: images keep coming in while the network works.
        self.create_service(PredictSubgoal, 'predict_subgoal', self._on_request,
                            callback_group=MutuallyExclusiveCallbackGroup())
        sizes = [f'{mode} {predictor.image_size[1]}x{predictor.image_size[0]} pixels'
                 for mode, predictor in self._predictors.items()]
        files = [path for path in (self.params['weights'], self.params['forward_weights']) if path]
        self.get_logger().info(
            f'ready: {", ".join(sizes)}, {self.params["device"]}, {", ".join(files)}')

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
        mode = choose_mode(request, self._predictors)
        predictor = self._predictors[mode]
        start = self._view('start', request.start, request.start_objects, predictor.image_size)
        goal = None
        if mode == 'bidirectional':
            goal = self._view('goal', request.goal, request.goal_objects, predictor.image_size)
        views = [view for view in (start, goal) if view]
        lacking = '; '.join(view.lacking for view in views if view.lacking)
        names = () if lacking else start.names
        start_pixels = start.pixels if names else None
        goal_pixels = match_objects(
            names, goal.names, goal.pixels, 'start_objects', 'goal_objects'
        ) if names and goal else None
        begin = time.perf_counter()
        subgoals = predictor.predict(
            start.image, goal and goal.image, start_pixels, goal_pixels, num_samples=num_samples,
            recursion_depth=depth, seed=request.seed)
        response.model_time_ms = (time.perf_counter() - begin) * 1e3
        response.subgoals = [
            encode_subgoal(subgoal, names, start.stamp, start.frame_id) for subgoal in subgoals]
        response.sample = [subgoal.sample for subgoal in subgoals]
        response.level = [subgoal.level for subgoal in subgoals]
        response.success = True
        response.message = (
            f'{mode}, {len(subgoals)} subgoal{"s" * (len(subgoals) > 1)}, '
            + (f'no object maps: {lacking}' if lacking else f'maps of {", ".join(names)}'))
        if len(subgoals) < num_samples * depth:
            response.message += (f'; one sample instead of {num_samples}, as these weights have '
                                 'no latent variable and all samples would be the same')
        # For planners and people: where to go first, the earliest subgoal of the first sample.
        self._subgoal.publish(response.subgoals[0])
        self._picture.publish(response.subgoals[0].image)
        picture = overlay(start.image, subgoals[0].object_maps, OVERLAY_SCALE, start_pixels,
                          goal_pixels)
        self._overlay.publish(encode_image(picture, start.stamp, start.frame_id))

    def _view(self, name, image, objects, size):
        """Decode a picture and its objects; take the newest ones if it was left empty."""
        lacking = '' if objects.objects else f'{name}_objects are empty'
        if is_empty(image):
            found = self._find(name)
            image = found['image']
            if not objects.objects:
                objects = found.get('objects', objects)
                lacking = '' if objects.objects else self._explain(name, found)
        picture = decode_image(image, name, size, resize=self.params['resize_images'])
        names, pixels = decode_objects(objects, f'{name}_objects')
        pixels = resize_pixels(pixels, (image.height, image.width), size)
        return View(picture, names, pixels, lacking, image.header.stamp,
                    image.header.frame_id or CAMERA_FRAME)

    def _find(self, name):
        """Return the newest picture, and its objects if there are any with its stamp."""
        newest = self._newest[name]
        found = newest.newest('image')
        if found is None:
            advice = ''
            if name == 'goal' and 'forward' in self._predictors:
                advice = '; or ask for mode forward, which needs no goal'
            raise ImageError(
                f'{name}: the request has none and nothing has come on '
                f'{self._topic(name, "image")}; publish one there (the simulator does at '
                f'sim/reset), or send it along{advice}')
        if 'objects' not in found and not newest.missing(['objects']):
            stamp = to_nanoseconds(found['image'].header.stamp)
            found = newest.wait(
                ('image', 'objects'), OBJECTS_TIMEOUT, after_ns=stamp - 1) or found
        return found

    def _explain(self, name, found):
        """Say why what was found has no objects."""
        topic, newest = self._topic(name, 'objects'), self._newest[name].newest('objects')
        if 'objects' in found:
            return f'the list on {topic} is empty'
        if newest is None:
            return f'nothing has come on {topic}'
        stamps = [f'{to_nanoseconds(message.header.stamp) / 1e9:.9f} s'
                  for message in (newest['objects'], found['image'])]
        return (f'the newest on {topic} has the stamp {stamps[0]}, the picture on '
                f'{self._topic(name, "image")} {stamps[1]}; publish both with the same')

    def _topic(self, name, what):
        """Return the full name of a topic, for messages."""
        return self.resolve_topic_name(TOPICS[name][what][1])


def main(args=None):
    """Run the node; the answer is the exit code of the process."""
    return run_node(PredictorNode, 'predictor_node', args, num_threads=3)


if __name__ == '__main__':
    sys.exit(main())
