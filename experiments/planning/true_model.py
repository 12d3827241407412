# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The simulator in place of the forward model: what planning loses by predicting."""

import mujoco
import mujoco.rollout
import numpy as np
from sim_bridge.simulator import clip_moves, OBJECT_QPOS_START, ramp_controls, SUBSTEPS
import torch


class TrueModel:
    """
    A MapModel that carries maps by the true physics, from the state that the simulator is in.

    The planner sees no difference: a map is put on the table grid where the object truly gets to.

    :param model: ForwardModel; its geometry is used, none of its networks.
    :param simulator: Simulator.
    :param objects: indices of the objects that are planned for; None: all.
    """

    def __init__(self, model, simulator, objects=None):
        self.image_size, self.device = model.image_size, model.device
        self.table_points, self.pixel_table = model.table_points, model.pixel_table
        self.seed_maps, self.gripper_after = model.seed_maps, model.gripper_after
        self._objects, self._simulator = objects, simulator
        self._rollout = mujoco.rollout.Rollout(nthread=0)

    def begin(self, image, gripper, arm_hidden=False):
        """Return the simulator's model and state, in place of features; nothing is looked at."""
        simulator = self._simulator
        return simulator.model, simulator.state(), simulator.target.copy()

    def carried_maps(self, start, gripper, maps, actions, /, every=1):
        """
        Yield the maps (N, K, n, n) after every so many steps, as ForwardModel does.

        :param start: from begin; actions (N, horizon, 4).
        :param gripper: is not looked at, all sequences begin where the simulator's gripper is.
        """
        model, state, target = start
        actions, same = torch.unique(actions, dim=0, return_inverse=True)
        steps = actions.cpu().double().numpy()
        steps[..., :3] = clip_moves(steps[..., :3])
        controls, _ = ramp_controls(target, steps)
        states, _ = self._rollout.rollout(
            model, mujoco.MjData(model), np.tile(state, (len(steps), 1)), controls)
        for t in range(every, steps.shape[1] + 1, every):
            poses = states[:, t * SUBSTEPS - 1, 1 + OBJECT_QPOS_START:1 + model.nq]
            places = poses.reshape(len(steps), -1, 7)[..., :3]
            if self._objects is not None:
                places = places[:, self._objects]
            pixels = self._simulator.camera.project(places).astype(np.float32)  # (N, K, 2)
            reached = self.seed_maps(torch.from_numpy(pixels).to(self.device).view(-1, 2))
            yield reached.view(*pixels.shape[:2], *maps.shape[-2:])[same]
