# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Weights of either kind, loaded as whoever uses them would load them."""

from pathlib import Path

from tap_ros.planning.forward_model import LearnedForwardModel
from tap_ros.prediction.predictor import load_network
from tap_ros.training.weights import load_tensors


def check_weights(path: Path) -> dict[str, object]:
    """
    Refuse a file that no part of this package could use.

    :param path: absolute, or with a suffix, so that it is no name of shipped weights.
    :return: what the file says of itself: kind, config, training.
    :raises WeightsError: if it is damaged, no weights file, or neither of a predictor nor of a
        forward model.
    """
    _, about = load_tensors(path)
    if about.get('kind') == 'forward_model':
        LearnedForwardModel.load(path)
    else:
        load_network(path)
    return about
