# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Serves predict_subgoal: decode, predict what waits together, encode."""

from dataclasses import dataclass
import sys
import time
import traceback

from builtin_interfaces.msg import Time
import numpy as np
from rclpy.node import Node
from sensor_msgs.msg import Image
from tap_msgs.msg import ObjectStates, Subgoal
from tap_msgs.srv import PredictSubgoal
from tap_ros.errors import ImageError, TapError
from tap_ros.nodes.image_messages import decode_image, encode_image, is_empty, resize_pixels
from tap_ros.nodes.late_answers import create_late_service
from tap_ros.nodes.object_messages import decode_objects, match_objects
from tap_ros.nodes.predictor_setup import (
    check_count,
    check_work,
    choose_mode,
    declare_parameters,
    load_predictors,
    MAX_DEPTH,
    MAX_ROWS,
    MAX_SAMPLES,
    MAX_TOGETHER,
    MAX_WAITING,
)
from tap_ros.nodes.pulled import PulledObservations
from tap_ros.nodes.run import run_node
from tap_ros.nodes.subgoal_messages import encode_subgoal
from tap_ros.nodes.topics import CAMERA_FRAME, LATCHED, STREAM, to_nanoseconds
from tap_ros.pictures import overlay
from tap_ros.prediction.predictor import Question
from tap_ros.prediction.request_queue import Busy, RequestQueue
from tap_ros.text import escaped, listing

TOPICS = {  # what stands in for the fields that a request leaves empty
    'start': {'image': (Image, 'camera/image_raw'), 'objects': (ObjectStates, 'objects')},
    'goal': {'image': (Image, 'goal/image'), 'objects': (ObjectStates, 'goal/objects')}}
OVERLAY_SCALE = 4  # pixels of subgoal/overlay per pixel of the picture
SHOW_PERIOD = 0.1  # s between two looks for a subgoal to publish
CLOSE_TIMEOUT = 5.0  # s; longer than any batch takes
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


@dataclass(frozen=True)
class Task:
    """A request, checked and decoded."""

    mode: str
    question: Question
    names: tuple  # K object names; none where a picture lacks objects
    lacking: str  # why there are none; empty if there are
    stamp: Time  # of the start picture
    frame_id: str

    @property
    def rows(self):
        """Return how much of a batch it takes: about one for each map that is carried."""
        return self.question.num_samples * max(len(self.names), 1)


class PredictorNode(Node):
    """
    Offers the service only once the weights are loaded, checked and warmed up.

    The executor takes and checks the requests; one thread predicts what waits together, and sends
    the answers.
    """

    def __init__(self):
        super().__init__('predictor_node')
        self.params = declare_parameters(self)
        self._queue = RequestQueue(
            self._load, lambda task: task.rows, MAX_WAITING, MAX_TOGETHER, MAX_ROWS)
        self._newest = {'start': PulledObservations(self, TOPICS['start'], STREAM),
                        'goal': PulledObservations(self, TOPICS['goal'], LATCHED)}
        self._subgoal = self.create_publisher(Subgoal, 'subgoal', LATCHED)
        self._picture = self.create_publisher(Image, 'subgoal/image', LATCHED)
        self._overlay = self.create_publisher(Image, 'subgoal/overlay', LATCHED)
        self._unshown = None  # the newest (Task, prediction, message), until it is published
        # Apart from the answers, which need not wait for it.
        self.create_timer(SHOW_PERIOD, self._show)
        create_late_service(self, PredictSubgoal, 'predict_subgoal', self._on_request)
        sizes = [f'{mode} {predictor.image_size[1]}x{predictor.image_size[0]} pixels'
                 for mode, predictor in self._predictors.items()]
        files = [path for path in (self.params['weights'], self.params['forward_weights']) if path]
        self.get_logger().info(
            f'ready: {", ".join(sizes)}, {self.params["device"]}, {", ".join(files)}')

    def close(self):
        """Answer all that wait, and let the batch in progress end."""
        self._queue.close(CLOSE_TIMEOUT)
        self._show()

    # In the executor: what comes, and what people see

    def _on_request(self, request, send):
        """Check a request, and let it wait or refuse it."""
        try:
            task = self._check(request)
            self._queue.put(task, lambda found: self._answer(task, found, send))
        except Exception as error:
            self._send(send, self._refusal(error))

    def _check(self, request):
        """Return the Task of a request."""
        num_samples = check_count(request.num_samples, 'num_samples', MAX_SAMPLES)
        depth = check_count(request.recursion_depth, 'recursion_depth', MAX_DEPTH)
        check_work(num_samples, depth, 0)
        mode = choose_mode(request, self._predictors)
        predictor = self._predictors[mode]
        start = self._view('start', request.start, request.start_objects, predictor.image_size)
        goal = None
        if mode == 'bidirectional':
            goal = self._view('goal', request.goal, request.goal_objects, predictor.image_size)
        views = [view for view in (start, goal) if view]
        lacking = '; '.join(view.lacking for view in views if view.lacking)
        names = () if lacking else start.names
        check_work(num_samples, depth, len(names))
        start_pixels = start.pixels if names else None
        goal_pixels = match_objects(
            names, goal.names, goal.pixels, 'start_objects', 'goal_objects'
        ) if names and goal else None
        question = Question(start.image, goal and goal.image, start_pixels, goal_pixels,
                            num_samples, depth, request.seed)
        return Task(mode, question, names, lacking, start.stamp, start.frame_id)

    def _show(self):
        """Publish the newest subgoal for planners and people, if there is one that is not yet."""
        if self._unshown is None:
            return
        (task, subgoal, message), self._unshown = self._unshown, None
        self._subgoal.publish(message)
        self._picture.publish(message.image)
        question = task.question
        picture = overlay(question.start, subgoal.object_maps, OVERLAY_SCALE,
                          question.start_pixels, question.goal_pixels)
        self._overlay.publish(encode_image(picture, task.stamp, task.frame_id))

    # In the thread of the queue

    def _load(self):
        """Load the weights; return what predicts."""
        # Here, since OpenMP is slow where two threads have begun parallel work on few cores.
        self._predictors = load_predictors(
            self.params['weights'], self.params['forward_weights'], self.params['device'])
        return self._predict

    def _predict(self, tasks):
        """Predict Tasks together; return (subgoals, ms that the network took) for each."""
        answers = [None] * len(tasks)
        for mode, predictor in self._predictors.items():
            chosen = [index for index, task in enumerate(tasks) if task.mode == mode]
            if not chosen:
                continue
            begin = time.perf_counter()
            found = predictor.predict_together([tasks[index].question for index in chosen])
            elapsed_ms = (time.perf_counter() - begin) * 1e3
            for index, subgoals in zip(chosen, found):
                answers[index] = subgoals, elapsed_ms
        return answers

    def _answer(self, task, found, send):
        """Send the answer to one task, found by _predict or an exception."""
        try:
            if isinstance(found, Exception):
                raise found
            response = encode_answer(task, *found)
        except Exception as error:
            self._send(send, self._refusal(error))
            return
        self._send(send, response)
        # Where to go first: the earliest subgoal of the first sample.
        self._unshown = task, found[0][0], response.subgoals[0]

    # In either

    def _refusal(self, error):
        """Return the response that says what was wrong, and log it."""
        if isinstance(error, Busy):
            self.get_logger().warning(f'predict_subgoal: {error}', throttle_duration_sec=1.0)
        elif isinstance(error, TapError):
            self.get_logger().warning(f'predict_subgoal refused: {error}')
        else:
            for line in ''.join(traceback.format_exception(error)).splitlines():
                self.get_logger().error(f'predict_subgoal: {escaped(line)}')
            error = f'internal error: {type(error).__name__}: {escaped(error)}'
        return PredictSubgoal.Response(success=False, message=str(error))

    def _send(self, send, response):
        """Send a response; its client may have gone."""
        try:
            send(response)
        except Exception as error:
            self.get_logger().error(
                f'predict_subgoal: an answer cannot be sent: {escaped(error)}')

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
        given_size = (image.height, image.width)
        names, pixels = decode_objects(objects, f'{name}_objects', given_size)
        pixels = resize_pixels(pixels, given_size, size)
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


def encode_answer(task, subgoals, elapsed_ms):
    """Turn what was predicted for a Task into a response."""
    wanted = task.question.num_samples
    message = (f'{task.mode}, {len(subgoals)} subgoal{"s" * (len(subgoals) > 1)}, '
               + (f'no object maps: {task.lacking}' if task.lacking
                  else f'maps of {listing(task.names)}'))
    if len(subgoals) < wanted * task.question.recursion_depth:
        message += (f'; one sample instead of {wanted}, as these weights have no latent variable '
                    'and all samples would be the same')
    return PredictSubgoal.Response(
        success=True, message=message, model_time_ms=elapsed_ms,
        subgoals=[encode_subgoal(subgoal, task.names, task.stamp, task.frame_id)
                  for subgoal in subgoals],
        sample=[subgoal.sample for subgoal in subgoals],
        level=[subgoal.level for subgoal in subgoals])


def main(args=None):
    """Run the node; the answer is the exit code of the process."""
    return run_node(PredictorNode, 'predictor_node', args)


if __name__ == '__main__':
    sys.exit(main())
