# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Which trainings the paper's results need, at which scale, and in which order.

'small' is for two CPU cores, 'full' is the paper's for one large GPU.
"""

from dataclasses import dataclass, field, replace
from pathlib import Path
import shlex

from tap_ros.errors import ConfigError
from tap_ros.prediction.methods import parse_method
from tap_ros.prediction.training_config import TrainingConfig

SINGLE = ('grasp', 'pick_place', 'push2')  # the tasks of Table 1
EPOCHS, PRETRAIN_EPOCHS = 200, 10  # of the paper (appendix C)
# Three objects alone make it forget what the order of two looks like.
TRAINED_ON = {'push3': ('push2', 'push3')}
LONGER = {'push3': 2.4}  # times the steps


@dataclass(frozen=True)
class Scale:
    """
    How large everything is.

    :param episodes: task to how many to collect.
    :param steps: length of a training, but see LONGER; 0: the paper's epochs.
    :param settings: of every training, beside the method's own.
    """

    episodes: dict
    steps: int = 0
    settings: dict = field(default_factory=dict)


SCALES = {
    'small': Scale(
        episodes={'push2': 3000, 'grasp': 3000, 'pick_place': 3000, 'push3': 1500},
        steps=1500,
        settings={'base_width': 16, 'batch_size': 32, 'threads': 1}),
    'full': Scale(
        episodes={'push2': 55000, 'grasp': 50000, 'pick_place': 75000, 'push3': 55000},
        settings={'base_width': 32, 'batch_size': 64, 'learning_rate': 1e-4,
                  'discriminator_rate': 1e-4, 'precision': 'bfloat16', 'compile': True,
                  'save_every': 5000}),
}

# The paper's rows: every frame between the inputs is a target, the error is its own mean.
_PAPER = {'margin': 0, 'outer_power': 1.0, 'goal_picture': 'last'}
# Choosing by the error relative to copying needs both, see docs/paper_map.md.
_RELATIVE = {**_PAPER, 'margin': 3, 'outer_power': 0.5}
# With the default of 1e-4 samples hardly differed: z is worth less than 0.005 of error here.
_VAE = {'kl_weight': 1e-5}
VARIANTS = {
    '': {},
    # What each part of that does: all but the selection error, and all but the root.
    '+root': {'margin': 3, 'outer_power': 0.5},
    '+mean': {'outer_power': 1.0},
    # Against leaving out what is small and uncertain, see losses.weighted_l1_error.
    '+changed': {'changed_weight': 2.0},
    # For use: goal pictures with the arm elsewhere too, as people photograph goals.
    '+mixed': {'goal_picture': 'mixed'},
}


def label(method, variant='', recursion=1):
    """
    Name a method in results: genmin+root is a variant, genmin-r2 was trained for recursion.

    :param method: as for training.
    :param variant: one of VARIANTS.
    :param recursion: levels of Eq. 3 in training.
    :return: for example 'genmin+relative+mean'.
    """
    return method + variant + (f'-r{recursion}' if recursion > 1 else '')


@dataclass(frozen=True)
class PaperRun:
    """
    One training and its evaluation.

    :param task: of sim_bridge.tasks.
    :param mode: 'bidirectional' or 'forward'.
    :param method: see prediction.methods.
    :param new_pixels: whether the network may paint; if not, it has object maps.
    :param scale: name in SCALES.
    :param seed: of the training.
    :param recursion: levels of Eq. 3.
    :param variant: one of VARIANTS, other settings than the method's own.
    :param episodes: how many to collect instead of the scale's; 0: those.
    :param steps: length of the training instead of the scale's; 0: that.
    """

    task: str
    mode: str
    method: str
    new_pixels: bool = True
    scale: str = 'small'
    seed: int = 0
    recursion: int = 1
    variant: str = ''
    episodes: int = 0
    steps: int = 0

    @property
    def name(self):
        """Name of the run's folder and of its file of results."""
        return (f'{self.task}-{self.mode}-{self.method}{self.variant}'
                + ('' if self.new_pixels else '-warp')
                + (f'-r{self.recursion}' if self.recursion > 1 else '') + f'-s{self.seed}')

    @property
    def label(self):
        """Name of the method in results."""
        return label(self.method, self.variant, self.recursion)

    @property
    def num_episodes(self):
        """How many episodes to collect."""
        return self.episodes or SCALES[self.scale].episodes[self.task]

    @property
    def training_tasks(self):
        """The tasks whose recordings it is trained on, its own last."""
        return TRAINED_ON.get(self.task, (self.task,))

    @property
    def num_steps(self):
        """Length of the training."""
        usual = round(SCALES[self.scale].steps * LONGER.get(self.task, 1))
        return self.steps or usual or self._steps_of(EPOCHS)

    @property
    def before(self):
        """The run whose weights this one begins with: three objects with those for two."""
        return replace(self, task='push2') if self.task == 'push3' else None

    @property
    def command(self):
        """The command that makes this run."""
        names = [run.name for run in (self.before, self) if run]
        words = ['python', '-m', 'tap_ros', 'paper', '--scale', self.scale, '--only', *names]
        for option, value in (('--seeds', self.seed), ('--episodes', self.episodes),
                              ('--steps', self.steps)):
            words += [option, str(value)] if value else []
        return shlex.join(words)

    def config(self, recordings, runs):
        """
        Say how to train.

        :param recordings: folder with a recording for each task.
        :param runs: folder of all runs.
        :return: TrainingConfig.
        """
        settings = dict(SCALES[self.scale].settings)
        if parse_method(self.method).selection == 'relative_to_copying':
            settings |= _RELATIVE
        else:
            settings |= _PAPER
        if parse_method(self.method).vae:
            settings |= _VAE
        settings |= VARIANTS[self.variant]
        if self.before:
            settings['initial_weights'] = str(
                self.before.folder(runs) / 'predictor.safetensors')
        elif not SCALES[self.scale].steps:
            settings['pretrain_steps'] = self._steps_of(PRETRAIN_EPOCHS)
        return TrainingConfig(
            recordings=tuple(str(Path(recordings) / task) for task in self.training_tasks),
            out=str(self.folder(runs)), mode=self.mode, method=self.method,
            new_pixels=self.new_pixels, seed=self.seed,
            recursion=self.recursion, steps=self.num_steps, **settings)

    def folder(self, runs):
        """Return the Path of this run's folder in the folder of all runs."""
        return Path(runs) / self.scale / self.name

    def _steps_of(self, epochs):
        """Turn passes over the episodes into steps."""
        batch_size = SCALES[self.scale].settings['batch_size']
        episodes = sum(replace(self, task=task).num_episodes for task in self.training_tasks)
        return max(1, round(epochs * episodes / batch_size))


def paper_runs(scale, seeds=(0,), episodes=0, steps=0):
    """
    List all runs of a scale, the most important first.

    :param scale: name in SCALES.
    :param seeds: of the trainings; all runs of the first seed come before those of the second.
    :param episodes: how many to collect of each task instead of the scale's; 0: those.
    :param steps: length of each training instead of the scale's; 0: that.
    :return: list of PaperRun.
    :raises ConfigError: for an unknown scale.
    """
    if scale not in SCALES:
        raise ConfigError(f'scale: expected one of {", ".join(SCALES)}, got {scale!r}')
    rows = []

    def add(tasks, methods, mode='bidirectional', **options):
        rows.extend(PaperRun(task, mode, method, scale=scale, episodes=episodes, steps=steps,
                             **options) for task in tasks for method in methods)

    # App. E: bottlenecks, with warped pixels only.
    add(['push2'], ['genmin+relative', 'fix', 'genmin'], new_pixels=False)
    # For planning with two and three objects.
    add(['push3'], ['genmin+relative', 'fix', 'genmin'], new_pixels=False)
    # Table 1, and ours beside it.
    add(SINGLE, ['fix', 'genmin', 'genmin-wo-gan', 'min', 'genmin+relative'])
    add(['push2', 'grasp', 'pick_place'], ['genmin-vae-gan'])
    add(['pick_place', 'grasp', 'push2'], ['genmin', 'fix'], variant='+changed')
    # Fig. 4.
    for methods in (['genmin4', 'fix0.50', 'min', 'genmin0.5', 'genmin10'],
                    ['fix0.25', 'fix0.75', 'fix1.00']):
        add(['grasp'], methods, mode='forward', variant='+changed')
    add(['grasp'], ['genmin4', 'fix0.50', 'min'], mode='forward')
    add(['pick_place'], ['genmin-vae-gan'], variant='+changed')
    # Fixed-time prediction at other match-steps.
    add(['push2'], ['fix0.75', 'fix0.25'], new_pixels=False)
    # What the parts of genmin+relative are worth.
    add(['push2'], ['genmin', 'fix'], new_pixels=False, variant='+root')
    add(['push2'], ['genmin+relative'], new_pixels=False, variant='+mean')
    add(['push2'], ['min'], new_pixels=False)
    # Goal pictures with the arm elsewhere, too.
    add(['push2'], ['genmin+relative'], new_pixels=False, variant='+mixed')
    # The rest of Fig. 4.
    add(['grasp'], ['genmin2', 'genmin7', 'genmin30'], mode='forward', variant='+changed')
    add(['grasp'], ['fix0.75', 'genmin0.5', 'genmin10', 'fix0.25', 'fix1.00', 'genmin2', 'genmin7',
                    'genmin30'], mode='forward')
    return [replace(run, seed=seed) for seed in seeds for run in rows]
