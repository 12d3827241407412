# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The simulator as forward model: what planning loses by predicting."""

from collections.abc import Iterator
from pathlib import Path
from typing import Self

import mujoco
import mujoco.rollout
import numpy as np
from sim_bridge.simulator import Simulator
from sim_bridge.world.protocol import clip_moves
from sim_bridge.world.table import objects_in, ramp_controls, SUBSTEPS
from tap_ros.base.errors import ConfigError
from tap_ros.planning.forward_model import LearnedForwardModel
from tap_ros.planning.table import Table
import torch

Start = tuple[mujoco.MjModel, np.ndarray, np.ndarray]  # model, state, target


class TrueModel:
    """
    A protocols.ForwardModel that carries maps by the true physics, from where the simulator is.

    The planner sees no difference: a map is put on the table grid where the object truly gets to.

    :param table: Table, such as that of a learned model.
    """

    def __init__(self, table: Table, simulator: Simulator) -> None:
        self.table, self._simulator = table, simulator
        self._rollout = mujoco.rollout.Rollout(nthread=0)

    @classmethod
    def load(cls, path: str | Path, device: torch.device | str = 'cpu',
             simulator: Simulator | None = None) -> Self:
        """
        Take the table of a learned model's weights.

        :raises ConfigError: without a simulator, that is, other than in an experiment.
        """
        if simulator is None:
            raise ConfigError("forward model 'true': needs a simulator to roll out in; make "
                              'TrueModel(table, simulator)')
        return cls(LearnedForwardModel.load(path, device).table, simulator)

    def begin(self, image: torch.Tensor, gripper: torch.Tensor,
              arm_hidden: bool = False) -> Start:
        """Return the simulator's model and state, in place of features; nothing is looked at."""
        simulator = self._simulator
        return simulator.model, simulator.state(), simulator.target.copy()

    def carried_maps(self, start: Start, gripper: torch.Tensor | None, maps: torch.Tensor,
                     actions: torch.Tensor, /, every: int = 1) -> Iterator[torch.Tensor]:
        """
        Yield the maps (N, K, n, n) after every so many steps.

        :param start: from begin.
        :param gripper: is not looked at, all sequences begin where the simulator's gripper is.
        :param maps: (K, n, n); only their shape counts.
        :param actions: (N, T, 4): dx, dy, dz in metres, and opening; T a multiple of `every`.
        """
        model, state, target = start
        actions, same = torch.unique(actions, dim=0, return_inverse=True)
        steps = actions.cpu().double().numpy()
        steps[..., :3] = clip_moves(steps[..., :3])
        controls, _ = ramp_controls(target, steps)
        states, _ = self._rollout.rollout(
            model, mujoco.MjData(model), np.tile(state, (len(steps), 1)), controls)
        for t in range(every, steps.shape[1] + 1, every):
            places = objects_in(states[:, t * SUBSTEPS - 1], model)[..., :3]
            pixels = self._simulator.camera.project(places).astype(np.float32)  # (N, K, 2)
            reached = self.table.seed_maps(
                torch.from_numpy(pixels).to(self.table.device).view(-1, 2))
            yield reached.view(*pixels.shape[:2], *maps.shape[-2:])[same]
