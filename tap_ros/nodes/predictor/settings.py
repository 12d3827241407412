# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Parameters, weights and requests of predictor_node: what is checked before it predicts."""

from collections.abc import Collection, Mapping
from typing import TYPE_CHECKING

from tap_ros.errors import ConfigError
from tap_ros.messages.images import is_empty
from tap_ros.nodes.camera_topic import declare_transport
from tap_ros.nodes.lifecycle import declare_autostart
from tap_ros.nodes.parameters import check_device, Parameters
from tap_ros.nodes.robot_view import declare_robot_mask
from tap_ros.prediction.methods import MODES
from tap_ros.prediction.predictor import SubgoalPredictor
from tap_ros.text import escaped
from tap_ros.training.robot_mask import trained_robot_mask
from tap_ros.weights import DEFAULT_PREDICTOR, PREDICTORS

if TYPE_CHECKING:
    from rclpy.node import Node
    from tap_msgs.srv import PredictSubgoal

MAX_SAMPLES = 100
MAX_DEPTH = 8
MAX_SUBGOALS = 200  # of one answer: samples x depth
MAX_MAPS = 2000  # of one answer: samples x depth x objects; of 64x64 pixels these are 31 MiB
MAX_WAITING = 64  # requests
# Fewer than a client's queue of 10: every client receives the answers of all, and takes its own.
MAX_TOGETHER = 8  # requests in one batch
MAX_ROWS = 64  # samples x objects in one batch, unless one request alone has more
HOW_TO_GET = {  # weights for each mode
    'bidirectional': 'start it with -p weights:=FILE, trained for start and goal',
    'forward': 'start it with -p forward_weights:=FILE, trained for the start alone'}


def declare_parameters(node: 'Node') -> Parameters:
    """Declare the parameters of the node."""
    parameters = Parameters(node)
    declare_autostart(parameters)
    shipped = ', '.join(PREDICTORS)
    parameters.declare('weights', DEFAULT_PREDICTOR,
                       f'Weights of a subgoal predictor: shipped ones ({shipped}), or a file '
                       '(.safetensors); what they were trained for, bidirectional or forward, is '
                       'what the node can. Can be changed while the node is inactive.',
                       read_only=False)
    parameters.declare('forward_weights', '',
                       'Weights of a forward predictor, if the node shall answer forward '
                       'requests beside bidirectional ones; empty: none. Likewise.',
                       read_only=False)
    parameters.declare('device', 'cpu', 'Where the network runs, as torch names it: cpu, cuda.',
                       choices=['cpu', 'cuda'])
    parameters.declare('resize_images', False,
                       'Resize pictures of another size than the weights are made for, instead of '
                       'refusing them; answers have the size of the weights.', read_only=False)
    declare_transport(parameters)
    declare_robot_mask(parameters)
    return parameters


def load_predictors(weights: str, forward_weights: str,
                    device: str) -> dict[str, SubgoalPredictor]:
    """
    Load what the node serves.

    :param weights: file of weights for either mode.
    :param forward_weights: file of forward weights, or '' for none.
    :param device: 'cpu' or 'cuda'.
    :return: {mode: SubgoalPredictor}, with one mode or both.
    :raises WeightsError: when a file cannot be used or predicts nonsense.
    :raises ConfigError: when the device is not there, or no file is needed for what both are for.
    """
    check_device(device)
    predictor = SubgoalPredictor.load(weights, device)
    predictors = {predictor.mode: predictor}
    if forward_weights:
        if predictor.mode == 'forward':
            raise ConfigError(f'parameter forward_weights: {weights}, given as weights, is for '
                              'forward prediction already; leave one of them out')
        forward = SubgoalPredictor.load(forward_weights, device)
        if forward.mode != 'forward':
            raise ConfigError(f'parameter forward_weights: {forward_weights} needs start and '
                              'goal; give weights trained for the start alone, or give these as '
                              'weights')
        predictors['forward'] = forward
    return predictors


def unlike_training(predictors: Mapping[str, SubgoalPredictor], robot_mask: str) -> str:
    """
    Say for which weights the pictures are unlike those of their training, '' for none.

    :param predictors: {mode: SubgoalPredictor}.
    :param robot_mask: parameter of the node.
    """
    for mode, predictor in predictors.items():
        trained, share = trained_robot_mask(predictor.training)
        fitting = [*(['none'] if share < 1 else []), *([trained] if share > 0 else [])]
        if robot_mask not in fitting:
            return (f'parameter robot_mask is {robot_mask}, but the {mode} weights were trained '
                    f'on start and goal pictures as with {" or ".join(fitting)}; predictions may '
                    'be worse')
    return ''


def choose_mode(request: 'PredictSubgoal.Request', modes: Collection[str]) -> str:
    """
    Choose how to predict.

    :param request: PredictSubgoal request.
    :param modes: the modes that the node has weights for.
    :return: one of them.
    :raises ConfigError: when the request names no mode or one without weights, or names none
        and sends a goal that would be of no use.
    """
    if request.mode:
        if request.mode not in MODES:
            raise ConfigError(
                f"mode '{escaped(request.mode, 40)}' is unknown; valid: {', '.join(MODES)}, "
                'or empty for what the weights are for')
        if request.mode not in modes:
            raise ConfigError(f'mode {request.mode}: this node has no weights for it; '
                              f'{HOW_TO_GET[request.mode]}')
        return request.mode
    if 'bidirectional' in modes:
        return 'bidirectional'
    if not is_empty(request.goal) or request.goal_objects.objects:
        raise ConfigError(
            'goal: this node has forward weights only, which do not use it; leave goal and '
            f'goal_objects empty, or {HOW_TO_GET["bidirectional"]}')
    return 'forward'


def check_count(value: int, name: str, highest: int) -> int:
    """Return a count of a request, 1 for 0; raise ConfigError above the highest."""
    if value > highest:
        raise ConfigError(f'{name} is {value}; expected 1 to {highest}, or 0 for 1')
    return value or 1


def check_work(num_samples: int, depth: int, num_objects: int) -> None:
    """Raise ConfigError when one answer would take too long or be too large."""
    if num_samples * depth > MAX_SUBGOALS:
        raise ConfigError(
            f'num_samples x recursion_depth is {num_samples} x {depth} = {num_samples * depth}; '
            f'at most {MAX_SUBGOALS} subgoals are predicted for one request')
    maps = num_samples * depth * num_objects
    if maps > MAX_MAPS:
        raise ConfigError(
            f'num_samples x recursion_depth x objects is {num_samples} x {depth} x {num_objects} '
            f'= {maps}; at most {MAX_MAPS} maps are predicted for one request')
