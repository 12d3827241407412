# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What each of the shipped predictors is made with: options of `collect` and of `train`."""

from dataclasses import dataclass
from pathlib import Path
import shlex

FRESH_SEED, FRESH_EPISODES = 900_000, 100  # of the scenes that weights are scored in

# Pictures that must be made up, of a gripper where it was not yet, do not come by warping.
_GRIPPING = ('--method genmin-wo-gan+progress --outer-power 1 --batch-size 24 --decoder shared '
             '--skips --new-pixels --goal-picture last --no-colour --brightness 0')


@dataclass(frozen=True)
class Recipe:
    """
    How one predictor is made.

    :param name: of the weights, as `SubgoalPredictor.load` takes it.
    :param task: of its scenes.
    :param collections: options of `collect` beside the task, by names of folders.
    :param train: options of `train` beside recordings and folder.
    """

    name: str
    task: str
    collections: dict[str, str]
    train: str

    def fresh(self, folder: str | Path) -> Path:
        """Return the folder of the recording of scenes that it never saw."""
        return Path(folder, f'fresh_{self.task}')

    def commands(self, bags: str | Path, runs: str | Path) -> list[list[str]]:
        """
        Return the words behind `python -m tap_ros` of each step, in order.

        :param bags: folder of recordings; runs: of trainings.
        :return: list: one or several that collect, one of fresh scenes, and that of the training.
        """
        collect = ['collect', '--task', self.task]
        folders = [str(Path(bags, name)) for name in self.collections]
        return [
            *([*collect, *shlex.split(options), '--out', folder]
              for folder, options in zip(folders, self.collections.values())),
            [*collect, '--episodes', str(FRESH_EPISODES), '--seed', str(FRESH_SEED),
             '--out', str(self.fresh(bags))],
            ['train', '--recordings', *folders, '--out', str(Path(runs, self.name)),
             *shlex.split(self.train)]]


# With the arm elsewhere in half of the goal pictures, one decoder learns faster than three.
_PUSHING = ('--method genmin-wo-gan+progress --outer-power 1 --progress-margin 0.5 '
            '--start-crop 0.3 --batch-size 24 --decoder shared --skips --goal-picture mixed')
# Where objects stand close together, genmin over progress copies the start.
_PUSHING_BY_COPYING = ('--method genmin-wo-gan+relative --outer-power 1 --start-crop {} '
                       '--batch-size 24 --decoder shared --skips --goal-picture mixed')

RECIPES = {recipe.name: recipe for recipe in (
    Recipe('push2', 'push2', {
        'push2': '--episodes 2000', 'push2_random': '--episodes 3500 --appearance random'},
        f'{_PUSHING} --steps 10000'),
    # These begin with the push2 that is installed, not with the one made just before.
    Recipe('order2', 'order2', {'order2': '--episodes 700'},
           f'{_PUSHING_BY_COPYING.format(0.3)} --initial-weights push2 --steps 2500'),
    # Begins anywhere in the first 0.6: a second subgoal is predicted from where the first one was.
    Recipe('order3', 'order3', {'order3': '--episodes 700'},
           f'{_PUSHING_BY_COPYING.format(0.6)} --initial-weights push3 --steps 4000'),
    Recipe('push3', 'push3', {'push3': '--episodes 600'},
           f'{_PUSHING} --initial-weights push2 --steps 3000'),
    Recipe('stack2', 'stack2', {'stack2': '--episodes 1000'}, f'{_GRIPPING} --steps 4000'),
    Recipe('stack3', 'stack3', {'stack3': '--episodes 1000'}, f'{_GRIPPING} --steps 4000'),
    Recipe('grasp', 'grasp', {'grasp': '--episodes 3000'}, f'{_GRIPPING} --steps 4000'),
    Recipe('pick_place', 'pick_place', {'pick_place': '--episodes 3000'},
           f'{_GRIPPING} --steps 10000'),
    Recipe('pick_place_vae', 'pick_place', {'pick_place': '--episodes 3000'},
           _GRIPPING.replace('genmin-wo-gan+progress', 'genmin-vae')
           + ' --margin 0 --kl-weight 2e-5 --free-nats 4 --steps 4000'),
    Recipe('grasp_forward', 'grasp', {'grasp': '--episodes 3000'},
           _GRIPPING.replace('genmin-wo-gan+progress', 'genmin4-wo-gan')
           + ' --mode forward --steps 4000'),
)}
