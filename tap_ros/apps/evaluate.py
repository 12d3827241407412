# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The commands `python -m tap_ros evaluate ...`, planning aside: their options."""

from dataclasses import dataclass
from typing import Annotated, Literal

from tap_ros.base.options import Bags, File, Flag, Folder, one_of, ShippedFile, Topic
from tap_ros.base.plugins import names
from tap_ros.training.split import TEST_FRACTION
from tap_ros.weights import FORWARD_MODEL, PREDICTORS
from tyro import conf


@dataclass(frozen=True)
class Prediction:
    """
    Options of `python -m tap_ros evaluate prediction`.

    :param recordings: bag folders, folders of bag folders, or .mcap files; read as those of the
        training were.
    :param image_topic: the camera's topic; needed where several topics of pictures are in them.
    :param all: take every episode, not only those that training held out.
    :param goal_picture: the episode's last frame, or the goal's own picture where reached, with
        the arm elsewhere.
    :param samples: how many to draw of weights with z.
    :param marks: file of marks (see `mark`) that the matched frames are compared with.
    :param out: write scores.json and pictures.png there.
    """

    weights: Annotated[str, conf.arg(
        metavar='FILE',
        help=f'of a predictor: a file, or shipped ones: {", ".join(PREDICTORS)}; or another '
             'predictor, such as nearest_keyframe:bags/push2, which then has seen those bags.')]
    recordings: Bags
    image_topic: Topic = ''
    all: Flag = False
    goal_picture: Literal['last', 'recorded'] = 'recorded'
    samples: int = 100
    marks: File = ''
    out: Folder = ''


@dataclass(frozen=True)
class Forward:
    """
    Options of `python -m tap_ros evaluate forward`.

    Pictures are filled behind the robot as the weights' training was.

    :param recordings: bag folders; each is scored on its own: by object pixels, else by pictures.
    :param image_topic: the camera's topic; needed where several topics of pictures are in them.
    :param weights: of a forward model.
    :param test_fraction: share of the episodes that training held out, by seed; 1: all.
    :param device: cpu or cuda.
    :param out: write forward_model.json there.
    """

    recordings: Bags
    image_topic: Topic = ''
    weights: ShippedFile = str(FORWARD_MODEL)
    test_fraction: float = TEST_FRACTION
    device: str = 'cpu'
    out: Folder = ''


@dataclass(frozen=True)
class Tracking:
    """
    Options of `python -m tap_ros evaluate tracking`.

    Objects are clicked in the first picture that shows them all. The camera is fitted to the true
    places, where recordings have them.

    :param recordings: bag folders with object pixels; with --labels folders of films.
    :param image_topic: the camera's topic; needed where several topics of pictures are in them.
    :param labels: JSON file of pixels by hand, see tap_ros/evaluation/tracks.py.
    :param tracker: a name of the plugin group tap_ros.trackers.
    :param size: px of the longer side that pictures are scaled down to; 0: as they are.
    :param click: px of a picture 64 wide that clicks are off; 0: exact, and taken as they are.
    :param out: write tracking.json and tracking.png there.
    """

    recordings: Bags
    image_topic: Topic = ''
    labels: File = ''
    tracker: Annotated[str, one_of(names('tap_ros.trackers'))] = 'rigid'
    click: float = 0.0
    size: int = 0
    out: Folder = ''


def prediction(args: Prediction) -> None:
    """Score a predictor, see report.run."""
    from tap_ros.apps import report  # torch takes seconds to import
    report.run(args)


def forward(args: Forward) -> None:
    """Score a forward model, see evaluate_forward.run."""
    from tap_ros.apps import evaluate_forward
    evaluate_forward.run(args)


def tracking(args: Tracking) -> None:
    """Score a tracker, see evaluate_tracking.run."""
    from tap_ros.apps import evaluate_tracking
    evaluate_tracking.run(args)
