# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The names of __all__ for type checkers, which cannot see what __init__.py exports lazily."""

__version__: str

from sim_bridge.gym_world import GymWorld as GymWorld
from sim_bridge.simulator import Simulator as Simulator
from sim_bridge.tasks.motions import carry_out as carry_out
from sim_bridge.tasks.tasks import Task as Task
from sim_bridge.tasks.tasks import TaskScene as TaskScene
from sim_bridge.world.camera import Camera as Camera
from sim_bridge.world.protocol import Observation as Observation
from sim_bridge.world.protocol import World as World
from sim_bridge.world.scene import random_shape as random_shape
from tap_ros.apps.train import train as train
from tap_ros.base.errors import TapError as TapError
from tap_ros.base.plugins import load_plugin as load_plugin
from tap_ros.images.crop import trained_crop as trained_crop
from tap_ros.messages.subgoals import Subgoal as Subgoal
from tap_ros.planning.mpc_config import VisualMPCConfig as VisualMPCConfig
from tap_ros.planning.protocols import ForwardModel as ForwardModel
from tap_ros.planning.protocols import Problem as Problem
from tap_ros.planning.protocols import SearchConfig as SearchConfig
from tap_ros.planning.protocols import Solution as Solution
from tap_ros.planning.protocols import Solver as Solver
from tap_ros.planning.visual_mpc import Memory as Memory
from tap_ros.planning.visual_mpc import Scene as Scene
from tap_ros.planning.visual_mpc import VisualMPC as VisualMPC
from tap_ros.prediction.predictor import SubgoalPredictor as SubgoalPredictor
from tap_ros.prediction.protocol import load_predictor as load_predictor
from tap_ros.prediction.protocol import Predictor as Predictor
from tap_ros.recording.cache import open_recordings as open_recordings
from tap_ros.recording.reader import iter_episodes as iter_episodes
from tap_ros.recording.writer import EpisodeWriter as EpisodeWriter
from tap_ros.robots.arm import Arm as Arm
from tap_ros.robots.arm import get_arm as get_arm
from tap_ros.robots.arm import Mount as Mount
from tap_ros.robots.from_urdf import arm_from_urdf as arm_from_urdf
from tap_ros.ros.client import Client as Client
from tap_ros.tracking.protocols import Tracked as Tracked
from tap_ros.tracking.protocols import Tracker as Tracker
