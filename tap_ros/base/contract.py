# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
The contract between simulator, recordings, planner and nodes: what they share stands here, once.

Constants and functions of them. Nothing is imported, so that setup.py can read this file, too.
"""

# Motion: an action is (dx, dy, dz, opening).
CONTROL_PERIOD = 0.25  # s that one action takes
MOVE_LIMIT = 0.08  # m per control period, |dx| and |dy|
CLIMB_LIMIT = 0.15  # m per control period, |dz|
ACTION_LIMIT = (MOVE_LIMIT, MOVE_LIMIT, CLIMB_LIMIT)
# m/s, of each axis of a command; an arm whose control period is another one is no faster.
SPEED_LIMIT = tuple(limit / CONTROL_PERIOD for limit in ACTION_LIMIT)

# Where the fingertips may be, x, y, z in m; at z = 0 they just clear the table.
WORKSPACE_LOW = (-0.45, -0.45, 0.0)
WORKSPACE_HIGH = (0.45, 0.45, 0.15)

# Heights of the fingertips, m.
LOW = 0.012  # at which the arm pushes
CLEAR = 0.1  # above which no object is touched
LIFTED = 0.13  # at which the arm travels

SUCCESS_DISTANCE = 0.05  # m; an episode succeeds when every object ends nearer to its goal
GOAL_TOLERANCE = 1.0  # px; the planner takes a goal or subgoal for reached within this distance

TABLE = 'mujoco_table'  # the world of the simulator of this package
LOOKS = ('hand', 'arm')  # what its pictures show of the robot: the hand alone, or all of it
DEFAULT_LOOK = 'hand'
CAMERA_SIZE = 256  # px of its pictures where people look at them; networks see smaller ones

WORLD_FRAME = 'world'  # frame of positions and commands
CAMERA_FRAME = 'camera_optical_frame'  # of pictures: z looks ahead, x right, y down (REP 103)

MOST_SIGNALS = 256  # numbers by name of an episode, beside what is known of the robot
# Names of the gripper's state in joint states: metres, and the opening from 0 to 1.
GRIPPER_JOINTS = ('gripper_x', 'gripper_y', 'gripper_z', 'gripper_opening')

MAX_PICTURE_BYTES = 32 * 2**20  # of one picture: rgb8 of 3840x2160 pixels has 24 MiB
PICTURE_ENCODING = 'rgb8'  # in which pictures are sent and recorded
MAP_ENCODING = '32FC1'  # of object maps
MAP_ENCODINGS = (MAP_ENCODING, 'mono8', 'none')  # in which they can be asked for

# Where the robot hides the scene: pictures of the same stamp and size as the camera's.
MASK_ENCODING = 'mono8'
ROBOT_MASK_FREE = 0  # neither robot nor shadow
ROBOT_MASK_HAND = 128  # the hand (gripper) or its shadow
ROBOT_MASK_ARM = 255  # the arm or its shadow
ROBOT_MASKS = ('none', 'arm', 'all')  # what is taken for hidden: nothing, arm, arm and hand
VERSION = '0.1.0'  # of both packages
MODES = ('bidirectional', 'forward')  # of predictors: between start and goal, or after the start

# Module and class of each node, by the name of the node and of its executable.
NODE_CLASSES = {
    'sim_node': 'sim_bridge.ros.sim_node:SimNode',
    'predictor_node': 'tap_ros.nodes.predictor.node:PredictorNode',
    'visual_mpc_node': 'tap_ros.nodes.planner.node:VisualMpcNode',
    'recorder_node': 'tap_ros.nodes.recorder.node:RecorderNode',
    'robot_mask_node': 'tap_ros.nodes.robot_mask.node:RobotMaskNode',
    'tracker_node': 'tap_ros.nodes.tracker.node:TrackerNode',
    'explorer_node': 'tap_ros.apps.explorer.node:ExplorerNode',
}
STATES = SEEN, HIDDEN, UNSURE, LOST = 'seen', 'hidden', 'unsure', 'lost'  # of ObjectStates
OWNED = 'TAP_ROS_OWNED'  # environment variable of a node that ends when its standard input closes


def step_budget(num_objects: int) -> int:
    """Return B of App. F, how many commands a goal may take, by the number of its objects."""
    return 40 if num_objects <= 2 else 75


def object_names(count: int) -> tuple[str, ...]:
    """Return what objects are called that nobody has named, in their order: object_0, object_1."""
    return tuple(f'object_{k}' for k in range(count))
