# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Requests of predict_subgoal and their limits, topics that replace empty fields, responses."""

from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from itertools import compress
import math
import time
from typing import Any

from builtin_interfaces.msg import Time
import numpy as np
from rclpy.node import Node
from sensor_msgs.msg import Image
from std_msgs.msg import Header
from tap_msgs.msg import ObjectStates
from tap_msgs.srv import PredictSubgoal
from tap_ros.base.contract import (
    CAMERA_FRAME,
    MAP_ENCODING,
    MAP_ENCODINGS,
    MAX_PICTURE_BYTES,
    MODES,
)
from tap_ros.base.errors import ConfigError, ImageError, TapError
from tap_ros.base.text import escaped, listing
from tap_ros.images.pixels import check_image
from tap_ros.messages.images import decode_image, is_empty
from tap_ros.messages.objects import check_found, decode_cut_objects, match_objects
from tap_ros.messages.stamps import to_nanoseconds
from tap_ros.messages.subgoals import Subgoal
from tap_ros.prediction.protocol import Predictor, Request
from tap_ros.ros.observations import Observations
from tap_ros.ros.parameters import Parameters
from tap_ros.ros.polling import PollOnlyGroup
from tap_ros.ros.requests import WAITING
from tap_ros.ros.robot_view import RobotView
from tap_ros.ros.subscriptions import publishers_of, rivals
from tap_ros.ros.topics import camera_topics, encode_subgoal, goal_topics, LATCHED, STREAM

MAX_SAMPLES = 100
MAX_DEPTH = 8
MAX_SUBGOALS = 200  # of one answer: samples x depth
MAX_MAPS = 2000  # of one answer: samples x depth x objects; of 64x64 pixels these are 31 MiB
MAX_WAITING = 64  # requests
# Fewer than a client's queue of 10: every client receives the answers of all, and takes its own.
MAX_TOGETHER = 8  # requests in one batch
MAX_ROWS = 64  # samples x objects in one batch, unless one request alone has more
DISCOVERY_S = 3.0  # from the start of a node until it has found a camera that was there before
OBJECTS_TIMEOUT = 0.1  # s that objects and mask of the newest picture may come after it


@dataclass(frozen=True)
class RequestedView:
    """A picture of a request or a topic, ready for the predictor."""

    image: np.ndarray  # (H, W, 3) uint8
    names: tuple[str, ...]  # K object names
    pixels: np.ndarray  # (K, 2) float32 (u, v)
    no_objects: str  # why there are none; empty if there are
    header: Header  # of the picture


@dataclass(frozen=True)
class PendingRequest:
    """A request, checked and decoded."""

    mode: str
    request: Request
    names: tuple[str, ...]  # K object names; none where a picture lacks objects
    no_maps: str  # why there are none; empty if there are
    stamp: Time  # of the start picture
    frame_id: str
    map_encoding: str

    @property
    def rows(self) -> int:
        """Return its share of a batch: about one for each map that is predicted."""
        return self.request.num_samples * max(len(self.names), 1)


class RequestReader:
    """
    Checks and decodes requests.

    :param node: rclpy Node; the topics that replace empty fields are subscribed to.
    :param params: its Parameters.
    :param on_message: called with the topic name for each message that is taken.
    """

    def __init__(self, node: Node, params: Parameters,
                 on_message: Callable[[str], object]) -> None:
        self._node, self._robot = node, RobotView(params['robot_mask'])
        self._cameras = [topic for name, (_, topic) in camera_topics(params).items()
                         if name != 'objects']
        self._discovered = time.monotonic() + DISCOVERY_S
        self._newest = {}
        for name, types, qos in (('start', camera_topics(params), STREAM),
                                 ('goal', goal_topics(params['robot_mask']), LATCHED)):
            self._newest[name] = Observations(*types, latched=name == 'goal')
            self._newest[name].subscribe(node, types, qos, PollOnlyGroup(), on_message)

    def poll(self) -> None:
        """Take what has arrived, and remember what the camera sees behind the robot."""
        start = self._newest['start']
        for observations in self._newest.values():
            observations.poll()
        if self._robot.used and (found := start.newest('image', 'mask')) is not None:
            with suppress(TapError):  # a request for this picture is refused with it
                self._robot.see(found.messages['image'], found.messages['mask'], start.jumps)

    def read(self, request: PredictSubgoal.Request, predictor: Predictor) -> PendingRequest:
        """
        Check and decode a request.

        :raises TapError: naming what cannot be used, or which limit is exceeded.
        """
        num_samples, depth = request.num_samples or 1, request.recursion_depth or 1
        check_work(num_samples, depth, 0)
        check_mode(request, predictor.mode)
        if request.map_encoding not in ('', *MAP_ENCODINGS):
            raise ConfigError(f"map_encoding '{escaped(request.map_encoding, 40)}' is unknown; "
                              f"valid: {', '.join(MAP_ENCODINGS)}, or empty for the first")
        pixels = MAX_PICTURE_BYTES // (3 * num_samples * depth)
        start = self._view('start', request.start, request.start_objects, predictor, pixels)
        goal = (self._view('goal', request.goal, request.goal_objects, predictor, pixels)
                if predictor.mode == 'bidirectional' else None)
        no_maps = '; '.join(view.no_objects for view in (start, goal) if view and view.no_objects)
        names = () if no_maps else start.names
        check_work(num_samples, depth, len(names))
        goal_pixels = match_objects(
            names, goal.names, goal.pixels, 'start_objects', 'goal_objects'
        ) if names and goal else None
        return PendingRequest(
            predictor.mode, Request(
                start.image, goal.image if goal else None, start.pixels if names else None,
                goal_pixels, num_samples, depth, request.seed),
            names, no_maps, start.header.stamp, start.header.frame_id or CAMERA_FRAME,
            request.map_encoding or MAP_ENCODING)

    def _view(self, name: str, image: Image, objects: ObjectStates, predictor: Predictor,
              most_pixels: int) -> RequestedView:
        """
        Decode a picture and its objects; take the newest ones if it was left empty.

        It is made smaller here if the answer would have more pixels, or the predictor takes no
        larger ones.
        """
        no_objects = '' if objects.objects else f'{name}_objects are empty'
        found = self._find(name) if is_empty(image) else {'image': image}
        if is_empty(image) and not objects.objects:
            objects = found.get('objects', objects)
            no_objects = '' if objects.objects else self._why_no_objects(name, found)
        if name == 'start' and 'mask' in found:
            picture = self._robot.see(found['image'], found['mask'], self._newest[name].jumps)
        else:
            picture = decode_image(found['image'], name)
            if 'mask' in found:
                picture = self._robot.fill_goal(picture, found['mask'])
        crop, size = predictor.camera_crop, picture.shape[:2]
        cut = crop.of(size, name)
        if getattr(predictor, 'full_size', False):
            full = crop.unscaled(size, name)
            cut = full if math.prod(full.cut_size(size)) <= most_pixels else cut
        picture = cut.image(picture)
        check_image(picture, name, None if crop.is_cut(picture.shape[:2]) else crop.size)
        check_found(objects, f'{name}_objects')
        return RequestedView(
            picture, *decode_cut_objects(objects, f'{name}_objects', size, cut),
            no_objects, found['image'].header)

    def _find(self, name: str) -> dict[str, Any]:
        """
        Return the newest picture, and its objects and robot mask if there are any with its stamp.

        :raises ImageError: for a start picture without the mask that it needs.
        """
        newest, start = self._newest[name], name == 'start'
        if start and (cameras := rivals(publishers_of(self._node, *self._cameras))):
            raise ImageError(f'start: {cameras}; leave one of them, or send a picture along')
        found = newest.wait(['image'], self._discovered - time.monotonic())
        if found is None:
            raise ImageError(
                f'{WAITING}: {name}: the request has none and nothing has come on '
                f'{newest.names(["image"], explained=True)}; publish one there '
                '(the simulator does at sim/reset), or send it along')
        needed = ['image']
        for topic in ['mask'] * self._robot.used + ['objects']:
            if topic not in found.messages and (
                    topic == 'mask' and start or not newest.missing([topic])):
                found = newest.wait(
                    (*needed, topic), OBJECTS_TIMEOUT, found.stamp_ns - 1) or found
            if topic in found.messages:
                needed.append(topic)
        if self._robot.used and start and 'mask' not in found.messages:
            raise ImageError(
                'start: no robot mask with the stamp of the picture, '
                f'{found.stamp_ns / 1e9:.9f} s, has come on '
                f'{newest.names(["mask"])}; publish it, or start the node with robot_mask none')
        return found.messages

    def _why_no_objects(self, name: str, found: Mapping[str, Any]) -> str:
        """Return why a picture that was found has no objects."""
        observations = self._newest[name]
        topic, newest = observations.names(['objects']), observations.newest('objects')
        if 'objects' in found:
            return f'the list on {topic} is empty'
        if newest is None:
            return f'nothing has come on {observations.names(["objects"], explained=True)}'
        return (f'the newest on {topic} has the stamp {newest.stamp_ns / 1e9:.9f} s, the picture '
                f'on {observations.names(["image"])} '
                f'{to_nanoseconds(found["image"].header.stamp) / 1e9:.9f} s; publish both with '
                'the same')


def encode_answer(task: PendingRequest, subgoals: Sequence[Subgoal],
                  elapsed_ms: float) -> PredictSubgoal.Response:
    """Return the response to a PendingRequest."""
    wanted = task.request.num_samples
    message = (f'{task.mode}, {len(subgoals)} subgoal{"s" * (len(subgoals) > 1)}, '
               + (f'no object maps: {task.no_maps}' if task.no_maps
                  else f'maps of {listing(task.names)}'))
    if len(subgoals) < wanted * task.request.recursion_depth:
        message += (f'; one sample instead of {wanted}, as these weights have no latent variable '
                    'and all samples would be the same')
    message += ''.join(f'; {warning}' for warning in {
        subgoal.warning: None for subgoal in subgoals if subgoal.warning})
    undecided = np.any([subgoal.undecided for subgoal in subgoals], 0)
    if undecided.any():
        message += (f'; undecided about {listing(compress(task.names, undecided))}: no single '
                    'place is expected')
    return PredictSubgoal.Response(
        success=True, message=message, model_time_ms=elapsed_ms,
        subgoals=[encode_subgoal(
            subgoal, task.names, task.stamp, task.frame_id, task.map_encoding)
                  for subgoal in subgoals],
        sample=[subgoal.sample for subgoal in subgoals],
        level=[subgoal.level for subgoal in subgoals])


def check_mode(request: PredictSubgoal.Request, mode: str) -> None:
    """
    Raise ConfigError if a request wants another mode than that of the weights.

    :param mode: what the weights are for, 'bidirectional' or 'forward'. A request without a mode
        and with a goal wants the first, since its sender expects the goal to matter.
    """
    if request.mode not in ('', *MODES):
        raise ConfigError(f"mode '{escaped(request.mode, 40)}' is unknown; valid: "
                          f"{', '.join(MODES)}, or empty for what the weights are for")
    if request.mode and request.mode != mode:
        raise ConfigError(f'mode {request.mode}: the weights of this node are for {mode}; start '
                          f'one with -p weights:=FILE, trained for {request.mode}')
    if mode == 'forward' and not request.mode and not (
            is_empty(request.goal) and not request.goal_objects.objects):
        raise ConfigError(
            'goal: the weights of this node are for mode forward, which does not use it; leave '
            'goal and goal_objects empty, or start one with -p weights:=FILE, trained for start '
            'and goal')


def check_work(num_samples: int, depth: int, num_objects: int) -> None:
    """Raise ConfigError if one answer would take too long or be too large."""
    for name, factors, most in (
            ('num_samples', (num_samples,), MAX_SAMPLES), ('recursion_depth', (depth,), MAX_DEPTH),
            ('num_samples x recursion_depth', (num_samples, depth), MAX_SUBGOALS),
            ('num_samples x recursion_depth x objects', (num_samples, depth, num_objects),
             MAX_MAPS)):
        count = math.prod(factors)
        if count > most:
            shown = ' x '.join(map(str, factors)) + f' = {count}' * (len(factors) > 1)
            raise ConfigError(f'{name} is {shown}; expected 1 to {most}')
