# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Requests of predict_subgoal and what stands in for their empty fields; their answers."""

from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import Any, TYPE_CHECKING

from builtin_interfaces.msg import Time
import numpy as np
from sensor_msgs.msg import Image
from tap_msgs.msg import ObjectStates
from tap_msgs.srv import PredictSubgoal
from tap_ros.contract import CAMERA_FRAME
from tap_ros.errors import ImageError, TapError
from tap_ros.images.crop import TrainedCrop
from tap_ros.images.pixels import check_image, resize_image, resize_pixels
from tap_ros.messages.images import decode_image, is_empty
from tap_ros.messages.objects import decode_cut_objects, match_objects
from tap_ros.messages.stamps import to_nanoseconds
from tap_ros.messages.subgoals import Subgoal
from tap_ros.nodes.camera_topic import camera_topic
from tap_ros.nodes.on_demand import PulledObservations
from tap_ros.nodes.parameters import Parameters
from tap_ros.nodes.predictor.settings import (
    check_count,
    check_work,
    choose_mode,
    MAX_DEPTH,
    MAX_SAMPLES,
)
from tap_ros.nodes.robot_view import CAMERA_MASK, GOAL_MASK, RobotView
from tap_ros.nodes.ros_messages import encode_subgoal
from tap_ros.nodes.topics import LATCHED, STREAM
from tap_ros.prediction.predictor import Question, SubgoalPredictor
from tap_ros.text import listing

if TYPE_CHECKING:
    from rclpy.node import Node

OBJECTS_TIMEOUT = 0.1  # s that objects and mask of the newest picture may come after it


def request_topics(params: Parameters) -> dict[str, dict[str, tuple[type, str]]]:
    """
    Return what stands in for the fields that a request leaves empty.

    :return: for 'start' and 'goal' {short name: (message type, topic name)}, with the robot masks
        when they are used.
    """
    topics = {
        'start': {'image': camera_topic(params), 'objects': (ObjectStates, 'objects')},
        'goal': {'image': (Image, 'goal/image'), 'objects': (ObjectStates, 'goal/objects')}}
    if params['robot_mask'] != 'none':
        topics = {'start': topics['start'] | CAMERA_MASK, 'goal': topics['goal'] | GOAL_MASK}
    return topics


@dataclass(frozen=True)
class View:
    """A picture that came with a request or from a topic, ready for the predictor."""

    image: np.ndarray  # (H, W, 3) uint8
    names: tuple[str, ...]  # K object names
    pixels: np.ndarray  # (K, 2) float32 (u, v)
    lacking: str  # why there are no objects; empty if there are
    stamp: Time
    frame_id: str


@dataclass(frozen=True)
class Task:
    """A request, checked and decoded."""

    mode: str
    question: Question
    names: tuple[str, ...]  # K object names; none where a picture lacks objects
    lacking: str  # why there are none; empty if there are
    stamp: Time  # of the start picture
    frame_id: str

    @property
    def rows(self) -> int:
        """Return how much of a batch it takes: about one for each map that is carried."""
        return self.question.num_samples * max(len(self.names), 1)


class RequestReader:
    """
    Check and decode requests.

    :param node: rclpy Node; the topics that stand in for empty fields are subscribed to.
    :param params: its Parameters.
    :param predictors: {mode: SubgoalPredictor}.
    :param on_message: called with the topic name for each message that has come.
    """

    def __init__(self, node: 'Node', params: Parameters,
                 predictors: Mapping[str, SubgoalPredictor],
                 on_message: Callable[[str], object]) -> None:
        self._node, self._params, self._predictors = node, params, predictors
        self._robot = RobotView(params['robot_mask'])
        self._types = request_topics(params)
        self._newest = {
            'start': PulledObservations(
                node, self._types['start'], STREAM, on_message=on_message),
            'goal': PulledObservations(node, self._types['goal'], LATCHED, True, on_message)}

    def pull(self) -> None:
        """Take what has come on the topics, and notice of what the camera sees."""
        for observations in self._newest.values():
            observations.pull()
        if self._robot.used:
            start = self._newest['start']
            found = start.newest('image', 'mask')
            if found is not None:
                with suppress(TapError):  # who asks for a prediction from it is told
                    self._robot.see(found['image'], found['mask'], start.jumps)

    def read(self, request: PredictSubgoal.Request) -> Task:
        """
        Check and decode a request.

        :param request: of tap_msgs/PredictSubgoal.
        :return: its Task.
        :raises TapError: naming what cannot be used, or which bound it is beyond.
        """
        num_samples = check_count(request.num_samples, 'num_samples', MAX_SAMPLES)
        depth = check_count(request.recursion_depth, 'recursion_depth', MAX_DEPTH)
        check_work(num_samples, depth, 0)
        mode = choose_mode(request, self._predictors)
        predictor = self._predictors[mode]
        start = self._view('start', request.start, request.start_objects, predictor.camera_crop)
        goal = None
        if mode == 'bidirectional':
            goal = self._view('goal', request.goal, request.goal_objects, predictor.camera_crop)
        views = [view for view in (start, goal) if view]
        lacking = '; '.join(view.lacking for view in views if view.lacking)
        names = () if lacking else start.names
        check_work(num_samples, depth, len(names))
        start_pixels = start.pixels if names else None
        goal_pixels = match_objects(
            names, goal.names, goal.pixels, 'start_objects', 'goal_objects'
        ) if names and goal else None
        question = Question(start.image, goal.image if goal else None, start_pixels, goal_pixels,
                            num_samples, depth, request.seed)
        return Task(mode, question, names, lacking, start.stamp, start.frame_id)

    def _view(self, name: str, image: Image, objects: ObjectStates, crop: TrainedCrop) -> View:
        """Decode a picture and its objects; take the newest ones if it was left empty."""
        lacking = '' if objects.objects else f'{name}_objects are empty'
        if is_empty(image):
            found = self._find(name)
            image = found['image']
            if not objects.objects:
                objects = found.get('objects', objects)
                lacking = '' if objects.objects else self._explain(name, found)
        picture = decode_image(image, name)
        given_size = picture.shape[:2]
        cut = crop.of(given_size, name)
        picture = cut.image(picture)
        names, pixels = decode_cut_objects(objects, f'{name}_objects', given_size, cut)
        if self._params['resize_images']:
            pixels = resize_pixels(pixels, picture.shape[:2], crop.size)
            picture = resize_image(picture, crop.size)
        check_image(picture, name, crop.size)
        return View(picture, names, pixels, lacking, image.header.stamp,
                    image.header.frame_id or CAMERA_FRAME)

    def _find(self, name: str) -> dict[str, Any]:
        """
        Return the newest picture, and its objects if there are any with its stamp.

        The picture is without the robot where a mask is used; a start picture needs its own.
        """
        newest = self._newest[name]
        found = newest.newest('image')
        if found is None:
            advice = ''
            if name == 'goal' and 'forward' in self._predictors:
                advice = '; or ask for mode forward, which needs no goal'
            raise ImageError(
                f'{name}: the request has none and nothing has come on '
                f'{newest.explained("image", self._topic(name, "image"))}; publish one there '
                '(the simulator does at '
                f'sim/reset), or send it along{advice}')
        needed, stamp = ('image',), to_nanoseconds(found['image'].header.stamp)
        if self._robot.used and (name == 'start' or not newest.missing(['mask'])):
            if 'mask' not in found:
                found = newest.wait(
                    ('image', 'mask'), OBJECTS_TIMEOUT, after_ns=stamp - 1) or found
            if 'mask' in found:
                needed = 'image', 'mask'
            elif name == 'start':
                raise ImageError(
                    f'start: no robot mask with the stamp of the picture, {stamp / 1e9:.9f} s, '
                    f'has come on {self._topic(name, "mask")}; publish it, or start the node '
                    'with robot_mask none')
        if 'objects' not in found and not newest.missing(['objects']):
            stamp = to_nanoseconds(found['image'].header.stamp)
            found = newest.wait(
                (*needed, 'objects'), OBJECTS_TIMEOUT, after_ns=stamp - 1) or found
        if 'mask' in needed:
            image = (self._robot.see(found['image'], found['mask'], newest.jumps)
                     if name == 'start' else
                     self._robot.fill_goal(found['image'], found['mask']))
            found = found | {'image': image}
        return found

    def _explain(self, name: str, found: Mapping[str, Any]) -> str:
        """Say why what was found has no objects."""
        topic, newest = self._topic(name, 'objects'), self._newest[name].newest('objects')
        if 'objects' in found:
            return f'the list on {topic} is empty'
        if newest is None:
            return f'nothing has come on {self._newest[name].explained("objects", topic)}'
        stamps = [f'{to_nanoseconds(message.header.stamp) / 1e9:.9f} s'
                  for message in (newest['objects'], found['image'])]
        return (f'the newest on {topic} has the stamp {stamps[0]}, the picture on '
                f'{self._topic(name, "image")} {stamps[1]}; publish both with the same')

    def _topic(self, name: str, what: str) -> str:
        """Return the full name of a topic, for messages."""
        return self._node.resolve_topic_name(self._types[name][what][1])


def encode_answer(task: Task, subgoals: Sequence[Subgoal],
                  elapsed_ms: float) -> PredictSubgoal.Response:
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
