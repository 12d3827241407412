# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Serves predict_subgoal: decode, predict what waits together, encode."""

from collections import deque
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path
import time
from typing import Any

import cv2
import numpy as np
from rclpy.node import Node
from sensor_msgs.msg import Image
from tap_msgs.msg import Subgoal
from tap_msgs.srv import PredictSubgoal
from tap_ros.base.errors import ConfigError, TapError
from tap_ros.images.drawing import overlay
from tap_ros.images.pixels import resize_pixels
from tap_ros.images.robot_mask import trained_robot_mask
from tap_ros.messages.subgoals import Subgoal as PredictedSubgoal
from tap_ros.nodes.predictor import requests
from tap_ros.nodes.predictor.request_queue import Busy, RequestQueue
from tap_ros.prediction.protocol import load_predictor, Predictor, predictor_files, Request
from tap_ros.ros.calls import log_error, reason
from tap_ros.ros.diagnostics import Diagnostics
from tap_ros.ros.lifecycle import LifecycleBase
from tap_ros.ros.parameters import check_device, Parameters
from tap_ros.ros.polling import DeferredService
from tap_ros.ros.robot_view import warn_if_unlike
from tap_ros.ros.subscriptions import steady_timer
from tap_ros.ros.topics import (
    camera_topics,
    encode_image,
    encode_subgoal,
    goal_topics,
    LATCHED,
)
from tap_ros.weights import DEFAULT_PREDICTOR, PREDICTORS

Send = Callable[[PredictSubgoal.Response], object]
Found = tuple[list[PredictedSubgoal], float]  # of one request, and ms that the network took

# Pixels that subgoal/overlay has on its longer side: at least, about, and at most.
OVERLAY_SIDE, LARGEST_OVERLAY = 256, 640
SHOW_PERIOD = 0.1  # s between two checks for a subgoal to publish


class PredictorNode(LifecycleBase):
    """
    Offers the service only once the weights are loaded, checked and warmed up.

    Without autostart it offers the service at once, and refuses requests until it is active. One
    thread takes and checks the requests that have come, predicts what goes together, and sends the
    answers: two would wait for each other, and for Python's lock after every operator. While it
    predicts, nobody is answered.
    """

    def __init__(self, **options: Any) -> None:
        super().__init__('predictor_node', **options)
        self.params = declare_parameters(self)
        self._predictor: Predictor | None = None
        self._refused = ''  # why the last request was, if it was
        self._queue: RequestQueue[requests.PendingRequest, Found] | None = None
        self.autostart('configure')
        goal = goal_topics(self.params['robot_mask'])
        self._diagnostics = Diagnostics(
            self, [name for _, name in camera_topics(self.params).values()],
            [name for _, name in goal.values()],
            queue=lambda: len(self._queue or ()), idle=self.why_not)
        self._reader = requests.RequestReader(self, self.params, self._diagnostics.received)
        self._subgoal = self.create_publisher(Subgoal, 'subgoal', LATCHED)
        self._picture = self.create_publisher(Image, 'subgoal/image', LATCHED)
        self._overlay = self.create_publisher(Image, 'subgoal/overlay', LATCHED)
        # The newest subgoal until it is published, by a timer: the answer does not wait for it.
        self._unshown: deque[tuple[requests.PendingRequest, PredictedSubgoal]] = deque(maxlen=1)
        self._undrawn: tuple[requests.PendingRequest, PredictedSubgoal] | None = None
        steady_timer(self, SHOW_PERIOD, self._on_timer)
        self._service = DeferredService(
            self, PredictSubgoal, 'predict_subgoal', self._on_request, self._answer_batch)
        self.autostart('activate')
        self._service.start()

    def close(self) -> None:
        """Refuse all waiting requests, and let the running batch end."""
        if self._queue is not None:
            self._queue.close()
        self._service.close()  # what waits is refused: the node is ending
        self._show()

    # Lifecycle

    def load(self) -> str:
        """Load the weights; return what is known of them."""
        check_device(self.params['device'])
        # In a thread that ends, as it may run the network: OpenMP is slow where two threads have
        # begun parallel work on few cores.
        with ThreadPoolExecutor(1) as thread:
            self._predictor = thread.submit(
                load_predictor, self.params['weights'], self.params['device']).result()
        self._queue = RequestQueue(
            partial(predict, self._predictor), lambda task: task.rows, requests.MAX_WAITING,
            requests.MAX_TOGETHER, requests.MAX_ROWS)
        mode, (height, width) = self._predictor.mode, self._predictor.image_size
        trained, share = trained_robot_mask(self._predictor.training)
        warn_if_unlike(self, self.params['robot_mask'], ['none'] * (share < 1)
                       + [trained] * (share > 0), f'{mode} predictor')
        return f'{mode} {width}x{height} pixels, {self.params["device"]}, {self.params["weights"]}'

    def unload(self) -> None:
        """Release the weights, once the running batch has ended."""
        if self._queue is not None:
            self._queue.close('the weights are no longer in use; ask again')
        self._queue = self._predictor = None

    def files(self) -> list[Path]:
        """Return the file of the weights."""
        return predictor_files(self.params['weights'])

    # In the executor

    def _on_timer(self) -> None:
        """Publish a new subgoal, and take messages so that diagnostics have their age and rate."""
        self._show()
        self._reader.poll()

    def _show(self) -> None:
        """Publish the newest subgoal if it is not published yet; drawn once someone looks."""
        try:
            if self._unshown:
                task, subgoal = self._undrawn = self._unshown.pop()
                message = encode_subgoal(subgoal, task.names, task.stamp, task.frame_id)
                self._subgoal.publish(message)
                self._picture.publish(message.image)
            if self._undrawn is not None and self._overlay.get_subscription_count():
                (task, subgoal), self._undrawn = self._undrawn, None
                self._overlay.publish(encode_image(
                    draw(task.request, subgoal.object_maps), task.stamp, task.frame_id))
        except Exception as error:
            self._diagnostics.error(error)
            log_error(self, 'subgoal', error)

    # In the thread of the service

    def _on_request(self, request: PredictSubgoal.Request, send: Send) -> None:
        """Check a request and put it into the queue, or refuse it."""
        begin, queue, predictor = time.perf_counter(), self._queue, self._predictor
        try:
            if not self.active or queue is None or predictor is None:
                raise ConfigError(self.why_not())
            task = self._reader.read(request, predictor)
            queue.put(task, lambda found: self._answer(task, found, send, begin))
        except Exception as error:
            self._refuse(send, error)

    def _answer_batch(self) -> bool:
        queue = self._queue
        return queue is not None and queue.answer_batch()

    def _answer(self, task: requests.PendingRequest, found: Found | Exception, send: Send,
                begin: float) -> None:
        """Send the response to a task that came at time `begin`."""
        try:
            if isinstance(found, Exception):
                raise found
            response = requests.encode_answer(task, *found)
            # Where to go first: the earliest subgoal of the first sample.
            shown = task, found[0][0]
        except Exception as error:
            self._refuse(send, error)
            return
        send(response)
        self._refused = ''
        self._diagnostics.took(1e3 * (time.perf_counter() - begin), 'predict_subgoal')
        self._unshown.append(shown)

    # In any of them

    def _refuse(self, send: Send, error: Exception) -> None:
        """Send the response that names an error, and log it."""
        if isinstance(error, Busy):
            self.get_logger().warning(f'predict_subgoal: {error}', throttle_duration_sec=1.0)
        elif isinstance(error, TapError):
            if self._refused != str(error):  # whoever asks again and again is told each time
                self._refused = str(error)
                self.get_logger().warning(f'predict_subgoal refused: {error}')
        else:
            self._diagnostics.error(error)
        send(PredictSubgoal.Response(
            success=False, message=reason(self, 'predict_subgoal', error)))


def predict(predictor: Predictor, tasks: list[requests.PendingRequest]) -> list[Found]:
    """Predict a batch; return subgoals and ms for each PendingRequest."""
    begin = time.perf_counter()
    found = predictor.predict_together([task.request for task in tasks])
    elapsed_ms = (time.perf_counter() - begin) * 1e3
    return [(subgoals, elapsed_ms) for subgoals in found]


def draw(request: Request, object_maps: np.ndarray) -> np.ndarray:
    """Draw object maps over the start picture of a request, and marks where the objects were."""
    start, share = request.start, min(1, LARGEST_OVERLAY / max(request.start.shape))
    size = tuple(max(1, round(share * side)) for side in start.shape[:2])
    marks = [None if picture is None or pixels is None else resize_pixels(
        pixels, picture.shape[:2], size) for picture, pixels in (
            (start, request.start_pixels), (request.goal, request.goal_pixels))]
    if share < 1:
        start = np.asarray(cv2.resize(start, size[::-1], interpolation=cv2.INTER_AREA))
    return overlay(start, object_maps, max(1, round(OVERLAY_SIDE / max(size))), *marks)


def declare_parameters(node: Node) -> Parameters:
    """Declare the parameters of the node."""
    parameters = Parameters(node)
    parameters.declare_shared('autostart', 'device', 'image_transport', 'robot_mask')
    shipped = ', '.join(PREDICTORS)
    parameters.declare('weights', DEFAULT_PREDICTOR,
                       f'A subgoal predictor: shipped weights ({shipped}), a file '
                       '(.safetensors), or NAME:ARGUMENT of another one, such as '
                       'nearest_keyframe:bags/push2. Can be changed while the node is '
                       'unconfigured.',
                       read_only=False)
    return parameters
