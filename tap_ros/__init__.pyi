# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The names of __all__ for type checkers, which cannot see what __init__.py exports lazily."""

from sim_bridge.simulator import Simulator as Simulator
from sim_bridge.world.protocol import World as World
from tap_ros.apps.train import train as train
from tap_ros.base.errors import TapError as TapError
from tap_ros.planning.protocols import ForwardModel as ForwardModel
from tap_ros.planning.protocols import Solver as Solver
from tap_ros.planning.visual_mpc import VisualMPC as VisualMPC
from tap_ros.prediction.predictor import SubgoalPredictor as SubgoalPredictor
from tap_ros.prediction.protocol import Predictor as Predictor
from tap_ros.recording.cache import open_recordings as open_recordings
from tap_ros.recording.reader import iter_episodes as iter_episodes
from tap_ros.recording.writer import EpisodeWriter as EpisodeWriter
from tap_ros.robots.arm import Arm as Arm
from tap_ros.ros.client import Client as Client
