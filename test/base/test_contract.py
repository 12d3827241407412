# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Simulator, experts, planner, shipped weights and nodes keep to the contract."""

from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from sim_bridge.simulator import Simulator
from sim_bridge.tasks.tasks import get_task, run_episode
from sim_bridge.world.protocol import clip_action
from sim_bridge.world.scene import HALF_HEIGHT
from sim_bridge.world.table import ramp_controls
from tap_ros.base import contract
from tap_ros.planning.action_sequences import Limits, SequenceShape
from tap_ros.planning.forward_model import LearnedForwardModel
from tap_ros.recording.cache import open_recordings
from tap_ros.weights import FORWARD_MODEL, PLANNING_TASKS
import torch

ROOT = Path(__file__).parents[2]


@pytest.fixture
def simulator(request):
    simulator = Simulator(getattr(request, 'param', 'push2'), 64)
    yield simulator
    simulator.close()


def test_the_forward_model_moves_the_gripper_as_the_simulator_does():
    model = LearnedForwardModel.load(FORWARD_MODEL)
    assert model.config.workspace_low == contract.WORKSPACE_LOW
    assert model.config.workspace_high == contract.WORKSPACE_HIGH
    actions = np.random.default_rng(0).normal(0, 0.1, (200, 4))
    start = np.array([0.4, -0.4, 0.1, 0.0])
    _, targets = ramp_controls(start, np.array([clip_action(action) for action in actions]))
    gripper = torch.tensor(start)[None].float()
    for action, target in zip(torch.tensor(actions).float(), targets, strict=True):
        gripper = model.move_gripper(gripper, action[None])
        np.testing.assert_allclose(gripper[0, :3], target[:3], atol=1e-5)
    assert np.abs(targets[:, :2]).max() == contract.WORKSPACE_HIGH[0]  # it has been at the edge


def test_the_sample_recording_keeps_to_the_contract():
    episode = open_recordings(ROOT / 'bags' / 'sample_push2')[0]
    assert set(np.diff(episode.stamps)) == {round(1e9 * contract.CONTROL_PERIOD)}
    assert (np.abs(episode.actions[:, :3]) <= np.array(contract.ACTION_LIMIT) + 1e-6).all()
    places = episode.grippers[:, :3]
    assert (places > np.array(contract.WORKSPACE_LOW) - 0.01).all()
    assert (places < np.array(contract.WORKSPACE_HIGH) + 0.01).all()
    assert np.abs(np.diff(places, axis=0) - episode.actions[:-1, :3]).mean() < 0.005


def test_each_joint_follows_its_part_of_an_action(simulator):
    simulator.reset(3)
    for i, name in enumerate(contract.GRIPPER_JOINTS[:3]):
        before = [simulator.data.joint(joint).qpos.item() for joint in contract.GRIPPER_JOINTS[:3]]
        simulator.step(np.append(0.05 * np.eye(3)[i] * -np.sign(before[i] - 0.07), 0))
        moved = simulator.data.joint(name).qpos.item() - before[i]
        assert abs(moved) == pytest.approx(0.05, abs=0.01)


def pushed(simulator, height):
    """Return how far, in m, an object is moved by the arm that crosses it at a height."""
    place = simulator.reset(3).object_poses[0, :2]
    start = place - [0.13, 0]
    for goal in ([*simulator.target[:2], contract.LIFTED], [*start, contract.LIFTED],
                 [*start, height], [*place, height]):
        while np.abs(gap := goal - simulator.target[:3]).max() > 1e-6:
            seen = simulator.step([*gap, 0])
    return np.linalg.norm(seen.object_poses[0, :2] - place)


def test_the_arm_pushes_where_it_is_low_and_clears_all_objects_above(simulator):
    heights = [contract.WORKSPACE_LOW[2], contract.LOW, 2 * HALF_HEIGHT, contract.CLEAR,
               contract.LIFTED, contract.WORKSPACE_HIGH[2]]
    assert all(lower < higher for lower, higher in pairwise(heights))
    assert pushed(simulator, contract.LOW) > 0.03
    assert pushed(simulator, contract.CLEAR) < 1e-4


@pytest.mark.parametrize('simulator', ('push2', 'grasp'), indirect=True)  # both experts
def test_what_an_expert_commands_is_what_the_arm_does(simulator):
    observations, actions, _ = run_episode(simulator, 1)
    assert (np.abs(actions[:, :3]).max(0) <= np.array(contract.ACTION_LIMIT) + 1e-6).all()
    assert len(observations) <= simulator.task.num_frames


def test_no_plan_asks_for_more_than_the_arm_does():
    for limits in (Limits(), Limits(1.0, 1.0)):
        shape = SequenceShape(limits)
        assert shape.push_limit <= shape.move_limit == contract.MOVE_LIMIT
        assert shape.climb_limit == contract.CLIMB_LIMIT


def test_every_task_has_a_length_and_a_goal_may_take_no_longer_than_an_episode():
    for task in map(get_task, PLANNING_TASKS):
        assert contract.step_budget(task.num_objects) <= task.num_frames


@pytest.mark.parametrize('simulator', PLANNING_TASKS, indirect=True)
def test_the_goal_picture_shows_the_arm_at_the_object_that_is_pushed_last(simulator):
    for seed in range(5):
        simulator.reset(seed)
        goal, last = simulator.goal(), simulator.scene.order[-1]
        gaps = np.linalg.norm(goal.object_poses[:, :2] - goal.gripper[:2], axis=1)
        assert gaps.argmin() == last
