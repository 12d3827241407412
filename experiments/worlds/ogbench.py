# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
OGBench's scene, demonstrated by its authors' oracles: cube, drawer, window and button.

Also one move of its cube-double and one press of its puzzle: their goals take several, and a
bottleneck is of one. They can be recorded, not planned in, as sim_bridge/ogbench.py can.
"""

from importlib import import_module

import numpy as np
from sim_bridge.demonstrations import demonstrate
from sim_bridge.world.camera import Camera, load_triton, Renderer
from sim_bridge.world.gap import Gap
from tap_ros.base.errors import ConfigError, SceneError

ORACLES = {'button': 'button', 'cube': 'cube', 'drawer': 'drawer', 'window': 'window',
           'cube-double': 'cube', 'puzzle': 'button'}  # of tasks; the last two have own scenes
FOVY = 45.0  # degrees, of its camera in front
DRAWS = 1000  # targets that are drawn until one is of the task


class OGBench:
    """
    What `collect` needs of a world: a thing on a table with a drawer, a window and two buttons.

    :param task: what the oracle moves, one of ORACLES.
    :param image_size: width and height of the pictures in pixels.
    :raises ConfigError: if OGBench is not installed.
    :raises SceneError: for an unknown task.
    """

    steps = 2  # of demonstrations

    def __init__(self, task='cube', image_size=64):
        if task not in ORACLES:
            raise SceneError(f'task {task!r} is unknown; valid: {", ".join(ORACLES)}')
        self.task_name, self._kind = task, ORACLES[task]
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
            if self.task_name == self._kind:
                env._cur_button_states[:] = 1
                env._apply_button_states()
            seen, self._info = env.set_new_target()
            if env._target_task == self._kind:
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
        name = {'button': f'button_{self._number}', 'cube': f'block_{self._number}'}.get(
            self._kind, self._kind)
        return np.array(self._info[f'privileged/{name}_pos'])

    def gap(self):
        """Return how far the robot is from that, m."""
        return self._gap(self.env._data, {
            'button': f'button_{self._number}', 'cube': f'object_{self._number}',
            'drawer': 'drawer_link', 'window': 'windowb_a'}[self._kind])

    @property
    def _number(self):
        """Which of several the oracle moves; 0 of one."""
        return getattr(self.env, f'_target_{"button" if self._kind == "button" else "block"}', 0)

    def picture(self):
        """Return what a camera in front of the robot sees."""
        self._renderer.update_scene(self.env._data, 'front')
        return self._renderer.render()

    def succeeds(self):
        """Return whether what the oracle moves is where it shall be."""
        if self.task_name != self._kind:
            return bool(self.env._compute_successes()[self._number])
        cubes, buttons, drawer, window = self.env._compute_successes()
        return bool({'button': buttons[self._number], 'cube': cubes[0],
                     'drawer': drawer, 'window': window}[self._kind])

    def close(self):
        """Free the renderer and the environment."""
        self._renderer.close()
        self.env.close()


def _make_env(task):
    """Return the environment, and the oracle of a task."""
    load_triton()  # OGBench draws, too
    try:
        from ogbench.manipspace.envs.cube_env import CubeEnv
        from ogbench.manipspace.envs.puzzle_env import PuzzleEnv
        from ogbench.manipspace.envs.scene_env import SceneEnv
        from ogbench.manipspace.oracles import markov
    except ModuleNotFoundError as error:
        raise ConfigError(
            'world ogbench: OGBench is not installed; type `pip install --no-deps -r '
            'requirements-worlds.txt` in the folder of tap_ros') from error
    make, kind = {'cube-double': (CubeEnv, 'double'), 'puzzle': (PuzzleEnv, '3x3')}.get(
        task, (SceneEnv, 'scene'))
    env = make(kind, mode='data_collection', terminate_at_goal=False, visualize_info=False)
    oracle = getattr(import_module(f'{markov.__name__}.{ORACLES[task]}_markov'),
                     f'{ORACLES[task].title()}MarkovOracle')
    return env, oracle(env=env, max_step=10 ** 9)
