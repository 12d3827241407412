# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Parameters, weights and requests of visual_mpc_node: what is checked before anything moves."""

from dataclasses import dataclass

import numpy as np
from rclpy.node import Node
from tap_msgs.action import ReachGoal
from tap_ros.base.contract import (
    CLIMB_LIMIT,
    GOAL_TOLERANCE,
    MOVE_LIMIT,
    SPEED_LIMIT,
    step_budget,
    WORKSPACE_HIGH,
    WORKSPACE_LOW,
    WORLD_FRAME,
)
from tap_ros.base.errors import ConfigError, TapError
from tap_ros.base.text import escaped
from tap_ros.planning.action_sequences import Limits
from tap_ros.planning.mpc_config import PRESETS, SWITCHES, with_preset
from tap_ros.planning.reach import ReachConfig
from tap_ros.planning.visual_mpc import Scene, VisualMPC
from tap_ros.robots.arm import get_arm
from tap_ros.ros.parameters import check_device, Parameters, setting
from tap_ros.weights import find_forward_model, FORWARD_MODELS

MODES = ('subgoal', 'direct')
WORKSPACE_X, WORKSPACE_Y = tuple(zip(WORKSPACE_LOW, WORKSPACE_HIGH))[:2]  # m
ROOM = 0.05  # m, along x and y
MAX_BUDGET = 1000
MAX_CHOICE = 64  # plans to choose among samples, of up to a second each on two cores


@dataclass(frozen=True)
class PlannerParameters:
    """
    Parameters that this node alone has.

    :param preset: Settings of the planner: what does best, the same with more samples, or what the
        paper says.
    :param solver: What searches the actions: the cross-entropy method (cem), the improved one
        (icem), or a solver of another package.
    :param arm_hidden: The arm is not in the pictures.
    :param stamp_with_now: Stamp commands with the time of sending, as MoveIt Servo wants them,
        instead of the stamp of the image that they answer.
    :param command_frame: Frame of the commands, for their header.
    :param max_step_xy: Largest |dx| and |dy| of a command in metres, 0.32 m/s at most; the planner
        knows it, from the next goal on.
    :param max_step_z: Largest |dz| of a command in metres, 0.6 m/s at most; the planner
        knows it, from the next goal on.
    :param x_min: Where the fingertips may go, m in the frame world, least x. Commands do not lead
        farther, at once; the planner knows it from the next goal on. By default the arm's own
        reach from its usual mount, as are x_max, y_min and y_max.
    :param x_max: Greatest x, m.
    :param y_min: Least y, m.
    :param y_max: Greatest y, m.
    :param goal_tolerance: A goal is reached at this mean distance of the objects, in pixels of the
        forward model's pictures, a subgoal where the mean expected distance to its maps is so much
        above the least possible.
    :param switch: When to go on from a subgoal: when it is reached, or its share of the budget
        spent; or (half) then alone, as in the paper.
    :param subgoal_rounds: How often a goal in subgoal mode asks for subgoals: again, from what is
        seen then, when those of a round are passed.
    :param max_silence: The arm is stopped when the picture, the objects or the joints have been
        silent for so many seconds, or when the last command is so old. Has to be longer than the
        time from one picture to the next.
    :param command_timeout: Seconds after its arrival within which a command may begin; told to the
        arm on arm/command_timeout.
    :param max_age: Seconds; what was received longer ago is not acted upon. A plan ends in time
        for that, if need be with fewer samples; in lock-step nothing ages.
    :param image_timeout: Seconds without a usable observation after which a goal is aborted.
    :param predictor_timeout: Seconds to wait for a subgoal.
    """

    preset: str = setting('default', choices=tuple(PRESETS))
    solver: str = setting('cem', plugins='tap_ros.solvers')
    arm_hidden: bool = False
    stamp_with_now: bool = False
    command_frame: str = WORLD_FRAME
    max_step_xy: float = setting(MOVE_LIMIT, between=(0.001, MOVE_LIMIT), read_only=False)
    max_step_z: float = setting(CLIMB_LIMIT, between=(0.02, CLIMB_LIMIT), read_only=False)
    x_min: float = setting(WORKSPACE_LOW[0], between=WORKSPACE_X, read_only=False)
    x_max: float = setting(WORKSPACE_HIGH[0], between=WORKSPACE_X, read_only=False)
    y_min: float = setting(WORKSPACE_LOW[1], between=WORKSPACE_Y, read_only=False)
    y_max: float = setting(WORKSPACE_HIGH[1], between=WORKSPACE_Y, read_only=False)
    goal_tolerance: float = setting(GOAL_TOLERANCE, between=(0.0, 64.0), read_only=False)
    switch: str = setting('reached', choices=SWITCHES, read_only=False)
    subgoal_rounds: int = setting(1, between=(1, 16), read_only=False)
    max_silence: float = setting(0.35, between=(0.05, 60.0), read_only=False)
    command_timeout: float = setting(0.5, between=(0.01, 60.0))
    max_age: float = setting(3.0, between=(0.1, 600.0), read_only=False)
    image_timeout: float = setting(5.0, between=(0.1, 600.0), read_only=False)
    predictor_timeout: float = setting(20.0, between=(0.1, 600.0), read_only=False)


def declare_parameters(node: Node) -> Parameters:
    """Declare the parameters of the node."""
    parameters = Parameters(node)
    parameters.declare_shared(
        'autostart', 'device', 'image_transport', 'robot_mask', 'joint_prefix', 'control_period')
    parameters.declare('weights', 'push',
                       'A forward model: the shipped one, by its name or a task '
                       f'({", ".join(FORWARD_MODELS)}), or a file (.safetensors). Can be '
                       'changed while the node is unconfigured.',
                       read_only=False)
    parameters.declare_arm()
    arm = get_arm(parameters['arm'])
    low, high = np.clip((arm.low, arm.high), WORKSPACE_LOW, WORKSPACE_HIGH).tolist()
    parameters.declare_fields(PlannerParameters, x_min=low[0], x_max=high[0], y_min=low[1],
                              y_max=high[1])
    return parameters


def load_planner(parameters: Parameters) -> VisualMPC:
    """
    Load weights, and plan once, so that the first command comes as fast as the others.

    :param parameters: of the node.
    :raises WeightsError: when the file cannot be used.
    :raises ConfigError: when the device is not available, or the solver cannot plan.
    """
    check_device(parameters['device'])
    config = with_preset(
        parameters['preset'], solver=parameters['solver'],
        arm_hidden=parameters['arm_hidden'] or parameters['robot_mask'] == 'all')
    mpc = VisualMPC.load(find_forward_model(parameters['weights']), config, parameters['device'])
    height, width = mpc.image_size
    pixels = np.array([[width / 4, height / 4], [width / 2, height / 2]], np.float32)
    scene = Scene(np.full((height, width, 3), 128, np.uint8), np.zeros(4, np.float32), pixels)
    try:
        mpc.plan(scene, mpc.goal(pixels))
    except TapError:
        raise
    except Exception as error:
        raise ConfigError(
            f'solver {parameters["solver"]}: cannot plan: {type(error).__name__}: '
            f'{escaped(error, 200)}; choose another, or mend the package that it is of') from error
    return mpc


def step_limits(parameters: Parameters) -> Limits:
    """
    Return how far the arm may move by one command, and where; never faster than SPEED_LIMIT.

    :raises ConfigError: for a workspace without room.
    """
    move, _, climb = (parameters['control_period'] * speed for speed in SPEED_LIMIT)
    for low, high in (('x_min', 'x_max'), ('y_min', 'y_max')):
        if parameters[high] - parameters[low] < ROOM:
            raise ConfigError(
                f'parameters {low} and {high}: {parameters[low]:g} to {parameters[high]:g} m '
                f'leaves less than {ROOM:g} m to move in; correct them')
    return Limits(min(parameters['max_step_xy'], move), min(parameters['max_step_z'], climb),
                  (parameters['x_min'], parameters['y_min']),
                  (parameters['x_max'], parameters['y_max']))


def reach_config(parameters: Parameters, request: ReachGoal.Goal) -> ReachConfig:
    """Return the settings of the control loop for one goal."""
    return ReachConfig(
        request.step_budget, parameters['switch'], parameters['goal_tolerance'],
        step_limits(parameters),
        parameters['max_age'], parameters['image_timeout'], rounds=parameters['subgoal_rounds'])


def check_period(parameters: Parameters, told: float) -> None:
    """
    Raise ConfigError if the arm takes another time for a command than it is planned with.

    :param told: seconds, the newest on arm/control_period.
    """
    period = parameters['control_period']
    if not abs(told / period - 1) < 0.01:
        raise ConfigError(f'parameter control_period is {period:g} s, but by arm/control_period '
                          f'the arm takes {told:g} s for a command; start this node with '
                          f'-p control_period:={told:g}')


def check_request(request: ReachGoal.Goal) -> str:
    """
    Check what can be checked of a goal alone, and return its mode, the default filled in.

    :raises ConfigError: for an unknown mode, a budget or seed out of range, or more samples than
        can be weighed.
    """
    if request.seed < 0:
        raise ConfigError(f'seed is {request.seed}; expected 0 or more')
    mode = request.mode or 'subgoal'
    if mode not in MODES:
        raise ConfigError(f'mode is {escaped(repr(mode), 60)}; valid modes: {", ".join(MODES)}')
    if request.step_budget > MAX_BUDGET:
        raise ConfigError(f'step_budget is {request.step_budget}; expected 1 to {MAX_BUDGET}, or '
                          f'0 for {step_budget(2)}, with three objects {step_budget(3)}')
    samples, depth = request.num_samples or 1, request.recursion_depth or 1
    if mode == 'subgoal' and samples > 1 and samples * (depth + 1) > MAX_CHOICE:
        raise ConfigError(
            f'num_samples x (recursion_depth + 1) is {samples} x {depth + 1} = '
            f'{samples * (depth + 1)}; at most {MAX_CHOICE} plans are made to choose a sample')
    return mode
