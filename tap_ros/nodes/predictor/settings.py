# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Parameters and weights of predictor_node, and the limits of a request."""

from rclpy.node import Node
from tap_msgs.srv import PredictSubgoal
from tap_ros.errors import ConfigError
from tap_ros.messages.images import is_empty
from tap_ros.nodes.lifecycle import declare_autostart
from tap_ros.nodes.parameters import declare_device, declare_transport, Parameters
from tap_ros.nodes.robot_view import declare_robot_mask
from tap_ros.prediction.methods import MODES
from tap_ros.text import escaped
from tap_ros.weights import DEFAULT_PREDICTOR, PREDICTORS

MAX_SAMPLES = 100
MAX_DEPTH = 8
MAX_SUBGOALS = 200  # of one answer: samples x depth
MAX_MAPS = 2000  # of one answer: samples x depth x objects; of 64x64 pixels these are 31 MiB
MAX_WAITING = 64  # requests
# Fewer than a client's queue of 10: every client receives the answers of all, and takes its own.
MAX_TOGETHER = 8  # requests in one batch
MAX_ROWS = 64  # samples x objects in one batch, unless one request alone has more


def declare_parameters(node: Node) -> Parameters:
    """Declare the parameters of the node."""
    parameters = Parameters(node)
    declare_autostart(parameters)
    shipped = ', '.join(PREDICTORS)
    parameters.declare('weights', DEFAULT_PREDICTOR,
                       f'A subgoal predictor: shipped weights ({shipped}), a file '
                       '(.safetensors), or NAME:ARGUMENT of another one, such as '
                       'nearest_keyframe:bags/push2. Can be changed while the node is '
                       'unconfigured.',
                       read_only=False)
    declare_device(parameters)
    declare_transport(parameters)
    declare_robot_mask(parameters)
    return parameters


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
    for name, value, highest in (('num_samples', num_samples, MAX_SAMPLES),
                                 ('recursion_depth', depth, MAX_DEPTH)):
        if value > highest:
            raise ConfigError(f'{name} is {value}; expected 1 to {highest}, or 0 for 1')
    subgoals = num_samples * depth
    if subgoals > MAX_SUBGOALS:
        raise ConfigError(
            f'num_samples x recursion_depth is {num_samples} x {depth} = {subgoals}; '
            f'at most {MAX_SUBGOALS} subgoals are predicted for one request')
    if subgoals * num_objects > MAX_MAPS:
        raise ConfigError(
            f'num_samples x recursion_depth x objects is {num_samples} x {depth} x {num_objects} '
            f'= {subgoals * num_objects}; at most {MAX_MAPS} maps are predicted for one request')
