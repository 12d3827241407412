# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""A task that another package adds in a few lines: scenes, pictures, success, a recording."""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from sim_bridge.collect import collect, CollectConfig
from sim_bridge.simulator import Simulator
from sim_bridge.tasks.tasks import carry_out, Task, task_names, TaskScene
from sim_bridge.world.scene import random_shape
from tap_ros import plugins
from tap_ros.recording.reader import iter_episodes


@dataclass(frozen=True)
class Visit(Task):
    """Move the gripper to the left of the table; the object stays."""

    kind: ClassVar[str] = 'visit'

    def draw(self, rng, spread):
        pose = np.array([[*rng.uniform(-0.1, 0.1, 2), 0.0]])
        return TaskScene((random_shape(rng),), pose, pose, np.array([0.3, 0.3, 0.1]), (0,))

    def succeeds(self, table):
        return table.target[0] < -0.3

    def demonstrate(self, table, scene, first, rng, how):
        plans = (np.array([[-0.08, 0, 0, 0]]) for _ in range(self.num_frames))
        return carry_out(table, self.succeeds, first, plans, how.num_frames or self.num_frames)


def test_another_package_adds_a_task_in_a_few_lines(tmp_path, monkeypatch):
    monkeypatch.setattr(plugins, 'visit', Visit('visit', 1, 10, stream=99), raising=False)
    monkeypatch.setitem(plugins.BUILT_IN['tap_ros.tasks'], 'visit', 'tap_ros.plugins:visit')
    assert 'visit' in task_names()
    simulator = Simulator('visit')
    simulator.reset(0)
    assert simulator.outcome() == 'failure' and simulator.distances() < 1e-3
    simulator.close()
    # In this process: another one does not know what a test adds.
    monkeypatch.setattr('sim_bridge.collect.run_tasks', lambda tasks, *_: (
        (task, lambda task=task: task.function(*task.args)) for task in tasks))
    collect(tmp_path / 'bag', CollectConfig(task='visit', episodes=1), progress=False)
    episode, = iter_episodes(tmp_path / 'bag')
    assert (episode.task, episode.outcome, len(episode.frames)) == ('visit', 'success', 10)
