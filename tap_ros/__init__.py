# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Time-agnostic prediction as a subgoal service for robots, with ROS 2.

The names of __all__ can be imported from here: `from tap_ros import SubgoalPredictor`.
"""

from importlib import import_module
import os
import signal
import sys

from tap_ros.base.contract import NODE_CLASSES, VERSION
from tap_ros.base.interrupts import leave_at_once

__version__ = VERSION

# There an interrupt would come out as any error of what is imported. Commands and nodes handle it
# themselves as soon as they run.
if sys.argv[:1] == ['-m']:
    _program = sys.orig_argv[sys.orig_argv.index('-m') + 1] if '-m' in sys.orig_argv else ''
    _ours = _program.partition('.')[0] in ('tap_ros', 'sim_bridge', 'experiments')
else:
    _ours = os.path.basename(sys.argv[0]) in NODE_CLASSES  # lib/tap_ros/sim_node
if _ours and signal.getsignal(signal.SIGINT) is signal.default_int_handler:
    signal.signal(signal.SIGINT, leave_at_once)

# Nodes, commands and their workers compute with one thread each, unless the user chose: threads
# that wait for one another at every operator are many times slower on cores that are busy with
# something else (docs/speed.md). The planner shares out whole batches instead. Set before torch
# and OpenCV are imported; processes that are started from here inherit it.
if _ours:
    for _variable in ('OMP_NUM_THREADS', 'OPENCV_FOR_THREADS_NUM'):
        os.environ.setdefault(_variable, '1')
# More threads, where they are chosen, spin for a fifth of the usual time before they sleep.
if 'OMP_WAIT_POLICY' not in os.environ:
    os.environ.setdefault('GOMP_SPINCOUNT', '60000')

# A container that runs with any user id has no home, or one that cannot be written.
_home = os.path.expanduser('~')
if not os.access(_home, os.W_OK):
    _folder = f"{os.environ.get('TMPDIR', '/tmp')}/tap_ros-{os.getuid()}"
    os.environ.setdefault('TAP_ROS_CACHE', f'{_folder}/cache')
    if 'ROS_HOME' not in os.environ:
        os.environ.setdefault('ROS_LOG_DIR', f'{_folder}/log')
    if _home == '~':  # other libraries look for one, too
        os.environ['HOME'] = _folder

# What users need, also for parts of their own; each is imported when it is asked for, so that
# nodes stay light.
_EXPORTS = {
    'Arm': 'tap_ros.robots.arm',
    'arm_from_urdf': 'tap_ros.robots.from_urdf',
    'Camera': 'sim_bridge.world.camera',
    'carry_out': 'sim_bridge.tasks.motions',
    'Client': 'tap_ros.ros.client',
    'EpisodeWriter': 'tap_ros.recording.writer',
    'ForwardModel': 'tap_ros.planning.protocols',
    'get_arm': 'tap_ros.robots.arm',
    'GymWorld': 'sim_bridge.gym_world',
    'iter_episodes': 'tap_ros.recording.reader',
    'load_plugin': 'tap_ros.base.plugins',
    'load_predictor': 'tap_ros.prediction.protocol',
    'Memory': 'tap_ros.planning.visual_mpc',
    'Mount': 'tap_ros.robots.arm',
    'Observation': 'sim_bridge.world.protocol',
    'open_recordings': 'tap_ros.recording.cache',
    'Predictor': 'tap_ros.prediction.protocol',
    'Problem': 'tap_ros.planning.protocols',
    'random_shape': 'sim_bridge.world.scene',
    'Scene': 'tap_ros.planning.visual_mpc',
    'SearchConfig': 'tap_ros.planning.protocols',
    'Simulator': 'sim_bridge.simulator',
    'Solution': 'tap_ros.planning.protocols',
    'Solver': 'tap_ros.planning.protocols',
    'Subgoal': 'tap_ros.messages.subgoals',
    'SubgoalPredictor': 'tap_ros.prediction.predictor',
    'TapError': 'tap_ros.base.errors',
    'Task': 'sim_bridge.tasks.tasks',
    'TaskScene': 'sim_bridge.tasks.tasks',
    'Tracked': 'tap_ros.tracking.protocols',
    'Tracker': 'tap_ros.tracking.protocols',
    'train': 'tap_ros.apps.train',
    'trained_crop': 'tap_ros.images.crop',
    'VisualMPC': 'tap_ros.planning.visual_mpc',
    'VisualMPCConfig': 'tap_ros.planning.mpc_config',
    'World': 'sim_bridge.world.protocol',
}
__all__ = list(_EXPORTS)


def __getattr__(name: str) -> object:
    if name not in _EXPORTS:
        raise AttributeError(f'module {__name__!r} has no attribute {name!r}')
    return getattr(import_module(_EXPORTS[name]), name)


def __dir__() -> list[str]:
    return [*globals(), *_EXPORTS]
