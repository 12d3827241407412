# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Serves predict_subgoal: decode, predict what waits together, encode."""

from collections import deque
from collections.abc import Callable, Mapping
from functools import partial
import math
import os
from pathlib import Path
import sys
import threading
import time
import traceback
from typing import Any, TYPE_CHECKING

from rclpy.clock import Clock, ClockType
from sensor_msgs.msg import Image
from tap_msgs.msg import Subgoal
from tap_msgs.srv import PredictSubgoal
from tap_ros.errors import ConfigError, TapError
from tap_ros.images.drawing import overlay
from tap_ros.nodes.deferred_service import create_late_service, take_waiting
from tap_ros.nodes.diagnostics import Diagnostics
from tap_ros.nodes.lifecycle import ManagedNode
from tap_ros.nodes.predictor.requests import encode_answer, request_topics, RequestReader, Task
from tap_ros.nodes.predictor.settings import (
    declare_parameters,
    load_predictors,
    MAX_ROWS,
    MAX_TOGETHER,
    MAX_WAITING,
    unlike_training,
)
from tap_ros.nodes.ros_messages import encode_image
from tap_ros.nodes.run import run_node
from tap_ros.nodes.topics import LATCHED
from tap_ros.prediction.request_queue import Busy, RequestQueue, THREAD_NAME
from tap_ros.text import escaped
from tap_ros.weights import find_predictor

if TYPE_CHECKING:
    from tap_ros.messages.subgoals import Subgoal as PredictedSubgoal
    from tap_ros.prediction.predictor import SubgoalPredictor

Found = tuple[list['PredictedSubgoal'], float]  # of one request, and ms that the network took
Predictors = dict[str, 'SubgoalPredictor']  # by mode

OVERLAY_SCALE = 4  # pixels of subgoal/overlay per pixel of the picture
SHOW_PERIOD = 0.1  # s between two looks for a subgoal to publish
STALE_S = 2.0  # diagnostics call an input stale that has been silent for so long
CLOSE_TIMEOUT = 5.0  # s that the batch in progress has to end


class PredictorNode(ManagedNode):
    """
    Offers the service only once the weights are loaded, checked and warmed up.

    Without autostart it offers the service at once, and refuses requests until it is active. The
    executor takes and checks the requests; one thread predicts what waits together, and sends the
    answers.
    """

    reloaded = 'weights', 'forward_weights'

    def __init__(self) -> None:
        super().__init__('predictor_node')
        self.params = declare_parameters(self)
        self._queue: RequestQueue[Task, Found] | None = None
        self._predictors: Predictors = {}
        self.autostart('configure')
        topics = request_topics(self.params)
        self._diagnostics = Diagnostics(self, {
            **dict.fromkeys((name for _, name in topics['start'].values()), STALE_S),
            **dict.fromkeys((name for _, name in topics['goal'].values()), math.inf)},
            queue=lambda: len(self._queue or ()), idle=self.why_not)
        self._reader = RequestReader(
            self, self.params, self._predictors, self._diagnostics.received)
        self._subgoal = self.create_publisher(Subgoal, 'subgoal', LATCHED)
        self._picture = self.create_publisher(Image, 'subgoal/image', LATCHED)
        self._overlay = self.create_publisher(Image, 'subgoal/overlay', LATCHED)
        # Until it is published.
        self._unshown: deque[tuple[Task, PredictedSubgoal, Subgoal]] = deque(maxlen=1)
        # Apart from the answers, which need not wait for it.
        self.create_timer(SHOW_PERIOD, self._look_around,
                          clock=Clock(clock_type=ClockType.STEADY_TIME))
        self._service = create_late_service(
            self, PredictSubgoal, 'predict_subgoal', self._on_request)
        self.autostart('activate')

    def close(self) -> None:
        """Answer all that wait, and let the batch in progress end."""
        if self._queue is not None:
            self._queue.close(CLOSE_TIMEOUT)
        take_waiting(self._service)  # they are told that the node is ending
        self._show()

    # Weights

    def load(self, changed: Mapping[str, Any]) -> tuple['RequestQueue[Task, Found]', Predictors]:
        """Load weights; return what answers with them."""
        weights, forward = self._names(changed)
        predictors: Predictors = {}

        def prepare() -> Callable[[list[Task]], list[Found]]:
            # Here, since OpenMP is slow where two threads have begun parallel work on few cores.
            predictors.update(load_predictors(weights, forward, self.params['device']))
            return partial(predict, predictors)

        queue = RequestQueue(
            prepare, lambda task: task.rows, MAX_WAITING, MAX_TOGETHER, MAX_ROWS)
        return queue, predictors

    def use(self, loaded: tuple['RequestQueue[Task, Found]', Predictors]) -> None:
        """Answer with other weights."""
        self.unload()
        self._queue, predictors = loaded
        self._predictors.update(predictors)
        unlike = unlike_training(self._predictors, self.params['robot_mask'])
        if unlike:
            self.get_logger().warning(unlike)

    def unload(self) -> None:
        """Let the weights go, once the batch in progress has ended."""
        if self._queue is not None:
            self._queue.close(CLOSE_TIMEOUT, 'the weights are no longer in use; ask again')
        self._queue = None
        self._predictors.clear()

    def described(self) -> str:
        """Name the modes, the sizes of pictures, the device and the files."""
        sizes = [f'{mode} {predictor.image_size[1]}x{predictor.image_size[0]} pixels'
                 for mode, predictor in self._predictors.items()]
        return ', '.join([*sizes, self.params['device'], *filter(None, self._names({}))])

    def files(self, changed: Mapping[str, Any]) -> list[Path]:
        """Return the files of the weights."""
        return [find_predictor(name) for name in self._names(changed) if name]

    def _names(self, changed: Mapping[str, Any]) -> list[str]:
        """Return the weights as the parameters name them, '' for forward ones that are none."""
        return [changed.get(name, self.params[name]) for name in self.reloaded]

    # In the executor: what comes, and what people see

    def _on_request(self, request: PredictSubgoal.Request, send: Callable[[Any], object]) -> None:
        """Check a request, and let it wait or refuse it."""
        begin = time.perf_counter()
        try:
            if not self.active or self._queue is None:
                raise ConfigError(self.why_not())
            task = self._reader.read(request)
            self._queue.put(task, lambda found: self._answer(task, found, send, begin))
        except Exception as error:
            self._send(send, self._refusal(error))

    def _look_around(self) -> None:
        """Show what is new, and take what has come, whose age and rate diagnostics tell."""
        self._show()
        self._reader.pull()

    def _show(self) -> None:
        """Publish the newest subgoal for planners and people, if there is one that is not yet."""
        if not self._unshown:
            return
        task, subgoal, message = self._unshown.pop()
        question = task.question
        try:
            self._subgoal.publish(message)
            self._picture.publish(message.image)
            picture = overlay(question.start, subgoal.object_maps, OVERLAY_SCALE,
                              question.start_pixels, question.goal_pixels)
            self._overlay.publish(encode_image(picture, task.stamp, task.frame_id))
        except Exception as error:
            self._log_unexpected(error, 'subgoal')

    # In the thread of the queue

    def _answer(self, task: Task, found: Found | Exception, send: Callable[[Any], object],
                begin: float) -> None:
        """Send the answer to a task that came at `begin`: found by _predict, or an exception."""
        try:
            if isinstance(found, Exception):
                raise found
            response = encode_answer(task, *found)
            # Where to go first: the earliest subgoal of the first sample.
            shown = task, found[0][0], response.subgoals[0]
        except Exception as error:
            self._send(send, self._refusal(error))
            return
        self._send(send, response)
        self._diagnostics.took(1e3 * (time.perf_counter() - begin), 'predict_subgoal')
        self._unshown.append(shown)

    # In either

    def _refusal(self, error: Exception) -> PredictSubgoal.Response:
        """Return the response that says what was wrong, and log it."""
        if isinstance(error, Busy):
            self.get_logger().warning(f'predict_subgoal: {error}', throttle_duration_sec=1.0)
        elif isinstance(error, TapError):
            self.get_logger().warning(f'predict_subgoal refused: {error}')
        else:
            self._log_unexpected(error, 'predict_subgoal')
            error = f'internal error: {type(error).__name__}: {escaped(error)}'
        return PredictSubgoal.Response(success=False, message=str(error))

    def _log_unexpected(self, error: Exception, what: str) -> None:
        """Log an error that is none of ours, with where it came from."""
        self._diagnostics.error(error)
        for line in ''.join(traceback.format_exception(error)).splitlines():
            self.get_logger().error(f'{what}: {escaped(line)}')

    def _send(self, send: Callable[[Any], object], response: PredictSubgoal.Response) -> None:
        """Send a response; its client may have gone."""
        try:
            send(response)
        except Exception as error:
            self.get_logger().error(
                f'predict_subgoal: an answer cannot be sent: {escaped(error)}')


def predict(predictors: Predictors, tasks: list[Task]) -> list[Found]:
    """
    Predict Tasks together.

    :param predictors: {mode: SubgoalPredictor}, with every mode of the tasks.
    :param tasks: N Tasks.
    :return: N times (subgoals, ms that the network took).
    """
    answers: list[Found] = [([], 0.0)] * len(tasks)
    for mode, predictor in predictors.items():
        chosen = [index for index, task in enumerate(tasks) if task.mode == mode]
        if not chosen:
            continue
        begin = time.perf_counter()
        found = predictor.predict_together([tasks[index].question for index in chosen])
        elapsed_ms = (time.perf_counter() - begin) * 1e3
        for index, subgoals in zip(chosen, found):
            answers[index] = subgoals, elapsed_ms
    return answers


def main(args: list[str] | None = None) -> int:
    """Run the node; the answer is the exit code of the process."""
    code = run_node(PredictorNode, 'predictor_node', args)
    if any(thread.name == THREAD_NAME for thread in threading.enumerate()):
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(code)  # Python would abort if it ended while that thread is in C++
    return code


if __name__ == '__main__':
    sys.exit(main())
