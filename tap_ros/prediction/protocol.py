# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
What a predictor of subgoals is: arrays in, arrays out.

predictor_node, `predict` and planning take any. Another package adds one by the entry point group
tap_ros.predictors: a class with `load(argument, device)`.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast, Protocol

import numpy as np
from tap_ros.base.errors import ConfigError, ImageError
from tap_ros.base.plugins import load_plugin, names
from tap_ros.images.crop import TrainedCrop
from tap_ros.images.pixels import check_image, check_pixels
from tap_ros.messages.subgoals import Subgoal
from tap_ros.weights import find_predictor

GROUP = 'tap_ros.predictors'


@dataclass(frozen=True)
class Request:
    """
    What a predictor is asked.

    :param start: uint8 (H, W, 3).
    :param goal: uint8 (H, W, 3); None in mode 'forward'.
    :param start_pixels: (K, 2) object positions (u, v) in the start picture; None: K = 0.
    :param goal_pixels: (K, 2), of the same objects in the goal picture; None in mode 'forward'.
    :param num_samples: how many to draw; a predictor without random numbers answers one.
    :param recursion_depth: how many subgoals in a row, at least 1.
    :param seed: of what is random.
    """

    start: np.ndarray
    goal: np.ndarray | None = None
    start_pixels: np.ndarray | None = None
    goal_pixels: np.ndarray | None = None
    num_samples: int = 1
    recursion_depth: int = 1
    seed: int = 0


class Predictor(Protocol):
    """
    Predict the bottleneck between a start and a goal picture, or one to come after the start.

    :ivar mode: 'bidirectional', from start and goal, or 'forward', from the start alone.
    :ivar image_size: (height, width) of the pictures it takes, and of its object maps.
    :ivar full_size: whether it takes larger pictures, too, and answers with such.
    :ivar camera_crop: what to make of a camera's pictures before it sees them.
    :ivar training: how it was made, in the form of a weights file; may be empty.
    """

    mode: str
    image_size: tuple[int, int]
    camera_crop: TrainedCrop
    training: Mapping[str, Any]
    full_size: bool = False

    def predict_together(self, requests: Sequence[Request]) -> list[list[Subgoal]]:
        """
        Answer several requests.

        :param requests: their fields are the arguments of predict.
        :return: for each what predict returns.
        :raises ImageError: if a picture has the wrong type or size, or a position is unusable.
        :raises ConfigError: if a count is below 1, or a goal is missing or too much.
        """
        ...

    def predict(self, start: np.ndarray, goal: np.ndarray | None = None,
                start_pixels: np.ndarray | None = None, goal_pixels: np.ndarray | None = None,
                num_samples: int = 1, recursion_depth: int = 1, seed: int = 0) -> list[Subgoal]:
        """
        Predict subgoals.

        :param start: uint8 (H, W, 3) rgb, what is seen now; (H, W) is image_size, or larger and of
            that shape, see full_size.
        :param goal: uint8 (H, W, 3) rgb, what is to be; None in mode 'forward'.
        :param start_pixels: (K, 2) numbers, (u, v) of each object in the start picture; (0, 0) is
            the centre of the top-left pixel. None: no objects.
        :param goal_pixels: (K, 2) numbers, (u, v) of the same objects in the goal picture; None in
            mode 'forward'.
        :param num_samples: how many to draw; a predictor without random numbers answers one.
        :param recursion_depth: how many subgoals in a row, at least 1.
        :param seed: of what is random; the same arguments give the same answer.
        :return: list of Subgoal: sample after sample, of each its subgoals in a row, earliest
            first. Of each `image` uint8 (H, W, 3), as large as the larger one of the pictures,
            `object_maps` float32 (K, h, w) of image_size that each sum to 1, and
            `expected_pixels` float32 (K, 2), (u, v) in `image`.
        :raises ImageError: if a picture has the wrong type or size, or a position is unusable.
        :raises ConfigError: if a count is below 1, or a goal is missing or too much.
        """
        return self.predict_together([Request(
            start, goal, start_pixels, goal_pixels, num_samples, recursion_depth, seed)])[0]


def load_predictor(text: str | Path, device: Any = 'cpu') -> Predictor:
    """
    Load a predictor by name or file, as the parameter weights of predictor_node names it.

    :param text: name of shipped weights, such as 'push2'; a weights file; or NAME:ARGUMENT of
        another predictor, such as 'nearest_keyframe:bags/push2'.
    :param device: torch device or its name.
    :raises WeightsError: if weights are unknown, missing, damaged or for something else.
    :raises TapError: for an argument that the other predictor cannot use.
    """
    name, _, argument = str(text).partition(':')
    if name in names(GROUP):
        return cast(Predictor, load_plugin(GROUP, name).load(argument, device))
    file = find_predictor(text, names(GROUP))
    return cast(Predictor, load_plugin(GROUP, 'tap').load(file, device))


def predictor_files(text: str) -> list[Path]:
    """Return the weights files that a text of load_predictor names; none of other predictors."""
    return [] if text.partition(':')[0] in names(GROUP) else [
        find_predictor(text, names(GROUP))]


def check_request(request: Request, mode: str,
                   image_size: tuple[int, int]) -> tuple[np.ndarray, np.ndarray]:
    """
    Check a request.

    :param mode: of the predictor, 'bidirectional' or 'forward'.
    :param image_size: (height, width) of the pictures that it takes.
    :return: pictures (C, H, W, 3) and positions (C, K, 2): of the start, and of the goal if the
        mode is bidirectional.
    :raises ImageError: if a picture has the wrong type or size, or a position is unusable.
    :raises ConfigError: if a count is below 1, or a goal is missing or too much.
    """
    for name in ('num_samples', 'recursion_depth'):
        if getattr(request, name) < 1:
            raise ConfigError(f'{name}: expected at least 1, got {getattr(request, name)}')
    start, goal = request.start, request.goal
    check_image(start, 'start', image_size)
    start_pixels = check_pixels(request.start_pixels, 'start_pixels')
    if mode == 'forward':
        if goal is not None or request.goal_pixels is not None:
            raise ConfigError('goal: these weights predict forward, from the start alone; '
                              'leave it out, or use weights for 2 context pictures')
        return start[None], start_pixels[None]
    if goal is None:
        raise ConfigError('goal: these weights predict between a start and a goal picture; '
                          'give one, or use weights for 1 context picture')
    check_image(goal, 'goal', image_size)
    goal_pixels = check_pixels(request.goal_pixels, 'goal_pixels')
    if len(start_pixels) != len(goal_pixels):
        raise ImageError(f'goal_pixels: expected {len(start_pixels)} objects as in '
                         f'start_pixels, got {len(goal_pixels)}')
    return np.stack([start, goal]), np.stack([start_pixels, goal_pixels])
