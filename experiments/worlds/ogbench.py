# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
OGBench's scene, demonstrated by its authors' oracles: cube, drawer, window and button.

It can be recorded, not planned in.
"""

from importlib import import_module

import numpy as np
from sim_bridge.demonstrations import demonstrate
from sim_bridge.world.camera import Camera, Renderer
from sim_bridge.world.gap import Gap
from tap_ros.base.errors import ConfigError, SceneError

TASKS = ('button', 'cube', 'drawer', 'window')
FOVY = 45.0  # degrees, of its camera in front
DRAWS = 1000  # targets that are drawn until one is of the task


class OGBench:
    """
    What `collect` needs of a world: a thing on a table with a drawer, a window and two buttons.

    :param task: what the oracle moves, one of TASKS.
    :param image_size: width and height of the pictures in pixels.
    :raises ConfigError: if OGBench is not installed.
    :raises SceneError: for an unknown task.
    """

    steps = 2  # of demonstrations

    def __init__(self, task='cube', image_size=64):
        if task not in TASKS:
            raise SceneError(f'task {task!r} is unknown; valid: {", ".join(TASKS)}')
        self.task_name = task
        self.env, self.oracle = _make_env(task)
        self.step_ns = round(1e9 * self.env._control_timestep)
        self.reach, self.scale = self.env._arm_sampling_bounds, self.env.action_high[:3]
        self._info = {}
        self.env.reset(seed=0)  # it makes the model
        self.camera_matrix = Camera(image_size, image_size, fovy=FOVY).K
        self._renderer = Renderer(self.env._model, image_size, image_size)
        self._gap = Gap(self.env._model, 'ur5e/')

    demonstrate = demonstrate

    def distances(self):
        """Return nothing: goals are not told."""
        return np.empty(0)

    def begin(self, seed):
        """Begin the scene of a seed, with drawer and window unlocked."""
        env = self.env
        env.reset(seed=seed)
        for _ in range(DRAWS):
            env._cur_button_states[:] = 1
            env._apply_button_states()
            seen, self._info = env.set_new_target()
            if env._target_task == self.task_name:
                break
        self.oracle.reset(seen, self._info)
        # It draws where to go in the end from numpy's own generator.
        self.oracle._final_pos = env.np_random.uniform(*self.reach)
        self.oracle._final_yaw = env.np_random.uniform(-np.pi, np.pi)

    def act(self, command):
        """Take a step: (5,) of motion, turn and gripper, each in [-1, 1]."""
        *_, self._info = self.env.step(command)

    def command(self):
        """Return what the oracle commands now."""
        return np.asarray(self.oracle.select_action(None, self._info), np.float64)

    def hand(self):
        """Return where the fingertips are, (3,) m."""
        return np.array(self._info['proprio/effector_pos'])

    def movable(self):
        """Return where that is which the oracle moves, m."""
        kind, number = self.task_name, self.env._target_button
        return np.array(self._info[{
            'button': f'privileged/button_{number}_pos', 'cube': 'privileged/block_0_pos'}.get(
                kind, f'privileged/{kind}_pos')])

    def gap(self):
        """Return how far the robot is from that, m."""
        return self._gap(self.env._data, {
            'button': f'button_{self.env._target_button}', 'cube': 'object_0',
            'drawer': 'drawer_link', 'window': 'windowb_a'}[self.task_name])

    def picture(self):
        """Return what a camera in front of the robot sees."""
        self._renderer.update_scene(self.env._data, 'front')
        return self._renderer.render()

    def succeeds(self):
        """Return whether what the oracle moves is where it shall be."""
        cubes, buttons, drawer, window = self.env._compute_successes()
        return bool({'button': buttons[self.env._target_button], 'cube': cubes[0],
                     'drawer': drawer, 'window': window}[self.task_name])

    def close(self):
        """Free the renderer and the environment."""
        self._renderer.close()
        self.env.close()


def _make_env(task):
    """Return the environment, and the oracle of a task."""
    try:
        from ogbench.manipspace.envs.scene_env import SceneEnv
        from ogbench.manipspace.oracles import markov
    except ModuleNotFoundError as error:
        raise ConfigError(
            'world ogbench: OGBench is not installed; type `pip install --no-deps -r '
            'requirements-worlds.txt` in the folder of tap_ros') from error
    env = SceneEnv('scene', mode='data_collection', terminate_at_goal=False,
                   visualize_info=False)
    oracle = getattr(import_module(f'{markov.__name__}.{task}_markov'),
                     f'{task.title()}MarkovOracle')
    return env, oracle(env=env, max_step=10 ** 9)
