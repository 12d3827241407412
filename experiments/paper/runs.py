# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Which trainings the paper's results need, of what size, and in which order."""

from dataclasses import dataclass, replace
from pathlib import Path

from experiments.paper.methods import method_fields
from experiments.paper.recordings import held_out_share, RECORDINGS, SHIFTED, TIMED
from sim_bridge.tasks.tasks import get_task
from tap_ros.training.predictor_config import TrainingConfig

SINGLE = ('grasp', 'pick_place', 'push2')  # the tasks of Table 1
MAIN_SEEDS = (0, 1, 2)
SCALE = 'small'  # in results: of two CPU cores, where the paper had a GPU
STEPS = 2500  # of a training
_SMALL = {'base_width': 16, 'batch_size': 24, 'threads': 1, 'save_every': 1250}
# As in the paper: every frame between the inputs is a target, the error is its own mean.
_PAPER = {'margin': 0, 'goal_picture': 'last', 'progress_margin': 0.0, 'start_crop': 0.0,
          'decoder': 'separate', 'skips': False}
# An input's neighbours show no progress, so that their preference would be next to nothing.
_PROGRESS = {'margin': 3}
_PROGRESS_PUSHING = {'progress_margin': 0.5}
# A hand on an object is told by its colour; other colours teach that it has none.
_GRIPPING = {'colour': False, 'brightness': 0.0}
# Without free nats samples of pick-and-place hardly differ.
_VAE = {'kl_weight': 2e-5, 'free_nats': 4.0}
_OURS = {'decoder': 'shared', 'skips': True}
OURS = '+skips'
# The paper's network has none of these.
VARIANTS = {
    '': {},
    OURS: _OURS,
    # What the parts of genmin+progress are worth.
    '+skips+margin': {**_OURS, 'margin': 3},
    '+skips+edge': {**_OURS, 'progress_margin': 0.0},
    # Recursion asks for what comes before a subgoal, and a piece that ends there shows it.
    '+skips+pieces': {**_OURS, 'min_crop': 0.3},
    # The VAE as in the paper.
    '+skips+priced': {**_OURS, 'free_nats': 0.0, 'kl_weight': 1e-5},
    # Tried in pushing, where pictures lack the hand: in its own colours, for longer, and with a z
    # that costs nothing at first.
    '+skips+uncoloured': {**_OURS, 'colour': False, 'brightness': 0.0},
    '+skips+uncoloured+long': {**_OURS, 'colour': False, 'brightness': 0.0},
    '+skips+narrow': {**_OURS, 'colour': False, 'brightness': 0.0, 'kl_warmup': 0.4,
                      'posterior_std': 0.1},
    # The same with the VAE of appendix B: z is inferred from the frame that it is to show.
    '+skips+frame': {**_OURS, 'colour': False, 'brightness': 0.0, 'kl_warmup': 0.4,
                     'posterior_std': 0.1, 'free_nats': 0.0, 'kl_weight': 1e-5,
                     'posterior': 'frame', 'num_targets': 3},
    '+skips+long': _OURS,
    # For subgoals that are predicted again from where the first one was reached.
    '+skips+rounds': {**_OURS, 'start_crop': 0.6},
}
# Of results that were made with trial options which are gone: a match that was drawn at random,
# ever less so, and five times the weight on pixels that change.
PAST_VARIANTS = ('+skips+annealed', '+skips+weighted')
LONG = {'+skips+long': 2, '+skips+rounds': 1.6, '+skips+uncoloured+long': 3.2}  # times the steps
# Few episodes, in which the objects stand close together: from fresh weights genmin copied the
# start. All methods begin with the same shipped weights.
FINE_TUNED = {'order2': 'push2', 'order3': 'push3', 'order2_late': 'push2',
              'order3_late': 'push3'}
_FINE_TUNED = {'goal_picture': 'mixed', 'start_crop': 0.3}  # as those were trained


def label(method, variant='', recursion=1):
    """Name a method in results: genmin+skips is a variant, genmin-r2 was trained for recursion."""
    return method + variant + (f'-r{recursion}' if recursion > 1 else '')


@dataclass(frozen=True)
class PaperRun:
    """One training and its evaluation."""

    task: str  # the recording, of recordings.RECORDINGS
    mode: str  # 'bidirectional' or 'forward'
    method: str  # see prediction.methods
    new_pixels: bool = True  # whether the network may paint; if not, it has object maps
    seed: int = 0  # of the training
    recursion: int = 1  # levels of Eq. 3
    variant: str = ''  # one of VARIANTS, other settings than the method's own

    @property
    def name(self):
        """Name of the run's folder and of its file of results."""
        return (f'{self.task}-{self.mode}-{self.method}{self.variant}'
                + ('' if self.new_pixels else '-warp')
                + (f'-r{self.recursion}' if self.recursion > 1 else '') + f'-s{self.seed}')

    @property
    def num_steps(self):
        """Length of the training."""
        return round(STEPS * LONG.get(self.variant, 1))

    @property
    def beginning(self):
        """Name of the shipped weights that it begins with, '' for fresh ones."""
        return FINE_TUNED.get(self.task, '') if self.variant else ''

    @property
    def shifted(self):
        """The recordings that it is scored on besides its own: other looks of the same scenes."""
        return SHIFTED if self.task == 'push2' and self.mode == 'bidirectional' else ()

    @property
    def command(self):
        """The command that makes this run."""
        return f'python -m experiments paper --only {self.name}'

    def config(self, recordings, runs):
        """Return the TrainingConfig, by the folders of recordings and of all runs."""
        pushing = get_task(RECORDINGS[self.task].task).kind == 'push'
        settings = {**_SMALL, **_PAPER, **({} if pushing else _GRIPPING)}
        method = method_fields(self.method)
        if method['selection'] == 'progress':
            settings |= _PROGRESS | (_PROGRESS_PUSHING if pushing else {})
        if method['latent'] == 'vae':
            settings |= _VAE
        if self.task in FINE_TUNED:
            settings |= _FINE_TUNED
        settings |= VARIANTS[self.variant]
        return TrainingConfig(
            recordings=(str(Path(recordings) / self.task),), out=str(self.folder(runs)),
            mode=self.mode, **method, new_pixels=self.new_pixels, seed=self.seed,
            test_fraction=held_out_share(self.task), split='crc32', recursion=self.recursion,
            steps=self.num_steps, initial_weights=self.beginning, **settings)

    def folder(self, runs):
        """Return the Path of this run's folder in the folder of all runs."""
        return Path(runs) / SCALE / self.name


def paper_runs():
    """List all runs, the most important first; further seeds of the main rows come last."""
    rows = []

    def add(tasks, methods, mode='bidirectional', variant='', main=False, **options):
        rows.extend((PaperRun(task, mode, method, variant=variant, **options), main)
                    for task in tasks for method in methods)

    relative = ['genmin-wo-gan+relative']
    l1_rows = ['genmin-wo-gan+progress', 'fix-wo-gan', 'genmin-wo-gan', 'min-wo-gan']
    # App. E: bottlenecks, with warped pixels only.
    add(['push2'], relative + l1_rows, variant=OURS, new_pixels=False, main=True)
    # For planning where the order matters.
    add(['order2', 'order3'], relative + l1_rows[:3], variant=OURS, new_pixels=False)
    add(['order3'], relative, variant='+skips+pieces', new_pixels=False)
    add(['order2', 'order3'], relative + ['fix-wo-gan'], variant='+skips+rounds', new_pixels=False)
    for variant in (OURS, '+skips+rounds'):
        add(['order2_late'], relative + ['fix-wo-gan'], variant=variant, new_pixels=False,
            main=variant != OURS)
    add(['order3_late'], relative + ['fix-wo-gan'], variant='+skips+rounds', new_pixels=False)
    # Table 1 with our network.
    add(SINGLE, l1_rows, variant=OURS, main=True)
    add(['push2'], relative, variant=OURS)
    # Fig. 7, trained as Eq. 3 says.
    add(['pick_place'], l1_rows[:1], variant=OURS, recursion=2)
    add(['pick_place'], l1_rows[:1], variant='+skips+pieces')
    # When the bottleneck happens.
    add(TIMED, relative + ['genmin-wo-gan+progress', 'fix-wo-gan', 'genmin-wo-gan',
                           'fix0.25-wo-gan', 'fix0.75-wo-gan'], variant=OURS, new_pixels=False)
    add(['push2_late'], l1_rows[:2], variant='+skips+long', new_pixels=False)
    # Fig. 4.
    add(['grasp'], ['fix0.25-wo-gan', 'fix0.50-wo-gan', 'fix0.75-wo-gan', 'fix1.00-wo-gan',
                    'genmin4-wo-gan', 'min-wo-gan', 'genmin0.5-wo-gan', 'genmin10-wo-gan',
                    'genmin2-wo-gan', 'genmin7-wo-gan', 'genmin30-wo-gan'],
        mode='forward', variant=OURS)
    # Best of 100.
    add(['pick_place', 'push2', 'grasp'], ['genmin-vae'], variant=OURS)
    add(['pick_place'], ['genmin-vae+progress'], variant=OURS)
    add(['pick_place', 'push2'], ['genmin-vae'], variant='+skips+priced')
    add(['push2'], relative, variant='+skips+uncoloured')
    add(['push2'], ['genmin-wo-gan'], variant='+skips+uncoloured+long')
    add(['push2', 'pick_place'], ['genmin-vae'], variant='+skips+narrow')
    add(['push2', 'pick_place'], ['genmin-vae'], variant='+skips+frame')
    add(['push2'], ['genmin-vae+relative'], variant=OURS, new_pixels=False)
    # Table 1 with the paper's network.
    add(SINGLE, ['fix', 'genmin', 'min', 'genmin-wo-gan', 'genmin-vae-gan'])
    # Three objects, and stacking.
    add(['stack2', 'push3'], l1_rows, variant=OURS)
    add(['push3'], relative + l1_rows[:3], variant=OURS, new_pixels=False)
    # What the parts of genmin+progress are worth.
    add(['push2'], ['genmin-wo-gan+progress', 'genmin-wo-gan', 'fix-wo-gan'], new_pixels=False)
    add(['push2'], ['genmin+progress', 'genmin'], variant=OURS, new_pixels=False)
    add(['push2'], ['genmin-wo-gan'], variant='+skips+margin', new_pixels=False)
    add(['push2'], ['genmin-wo-gan+progress'], variant='+skips+edge', new_pixels=False)
    return [replace(run, seed=seed) for seed in MAIN_SEEDS for run, main in rows
            if main or not seed]
