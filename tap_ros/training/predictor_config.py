# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The settings of a training of the predictor, and recipes: settings that are known to do."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
import math
from typing import Annotated, Literal

from tap_ros.base.contract import MOST_LEVELS
from tap_ros.base.errors import ConfigError
from tap_ros.base.options import check_different, Folder
from tap_ros.images.robot_mask import RobotMask
from tap_ros.recording.reading import Topics
from tap_ros.training.run_config import RunConfig
from tyro import conf

Mode = Literal['bidirectional', 'forward']  # contract.MODES
Loss = Literal['fix', 'min', 'genmin']
Selection = Literal['absolute', 'relative', 'progress', 'still', 'marks']
Latent = Literal['none', 'vae']
GoalPicture = Literal['last', 'recorded', 'mixed']
Posterior = Literal['video', 'frame']
Precision = Literal['auto', 'float32', 'bfloat16']

_RANGES = {
    'fraction': (1e-6, 1), 'beta': (1e-6, math.inf), 'progress_margin': (0, 0.95),
    'recursion': (1, math.inf), 'label_weight': (0, math.inf), 'kl_weight': (0, math.inf),
    'free_nats': (0, math.inf),
    'kl_warmup': (0, 0.5), 'posterior_std': (0.01, 1), 'margin': (0, math.inf),
    'num_targets': (0, math.inf), 'min_crop': (1e-6, 1), 'start_crop': (0, 0.9),
    'brightness': (0, 0.9), 'fill_context': (0, 1), 'base_width': (1, math.inf),
    'patience': (0, math.inf)}


@dataclass(frozen=True, kw_only=True)
class TrainingConfig(RunConfig):
    """
    All that a training of the predictor is made from; the defaults are the recipe of push2.

    :param mode: 'bidirectional', from start and goal, or 'forward', from the start alone.
    :param loss: 'fix' (Eq. 1), 'min' (Eq. 2) or 'genmin' (Eq. 5).
    :param selection: which error chooses the target of genmin: the 'absolute' one, divided by the
        preference over time, as in the paper; the one 'relative' to copying an input; the
        absolute one with the preference over the 'progress' that pictures show; the
        relative one with a preference for frames that are 'still'; or the absolute one with
        labels learned from 'marks' as a prior. fix with marks has its target at the label.
    :param marks: JSON file of demonstrations whose bottleneck a person has marked, see `mark`.
        Start and goal are then drawn around the label.
    :param mark_name: train on the marks of this name alone, where a demonstration has several.
    :param label_topic: cameras that tell the moment beside the predictor's own, as of the wrist.
    :param label_signals: parts of names of signals that tell it, too, as in `label`.
    :param label_weight: of log w(t) beside the l1 error, with selection marks; w(t) is how likely
        a frame is the label. 0: any of the likeliest frames alike.
    :param keyframes: the network is also given the labelled frames of the three demonstrations
        that are most alike, to copy from, with recursion those of each level; the weights file
        holds such frames of up to 64 demonstrations, and where the objects are in them.
    :param gan: add the GAN's terms (Eq. 7).
    :param latent: 'vae' adds z (Eq. 9, with a GAN Eq. 10).
    :param fraction: share of the episode at which fix has its target.
    :param beta: of the linear preference of genmin in forward prediction; in the paper 2, 4 and 7
        did best.
    :param progress_margin: with selection progress, frames whose progress is within this of that
        of the start or the goal picture are not matched; 0..0.95.
    :param recursion: levels of Eq. 3; 1: none. The GAN's and the VAE's terms stand at the first.
    :param kl_weight: of the KL divergence beside the l1 error on [0, 1].
    :param free_nats: KL divergence up to this, in the mean over the batch, costs nothing; 0, the
        paper: all of it costs, and z may be ignored (posterior collapse). As free bits
        (arXiv:1606.04934), of the whole z.
    :param kl_warmup: share of the training in which the KL divergence costs nothing, and over
        which its weight then rises, so that z is of use before it has a price (as in
        arXiv:1602.02282); 0, the paper: never.
    :param posterior_std: standard deviation of z that the recognition network begins with; one
        well below 1 is little noise, which the predictor need not learn to ignore first.
    :param posterior: z is inferred from the whole 'video' (Eq. 9), or from each 'frame' (appendix
        B, slow: choose a small num_targets).
    :param margin: frames left out of the targets next to each context picture.
    :param num_targets: at most so many random targets an episode and step; 0: all of them.
    :param min_crop: cut episodes to a random piece of at least this share; 1: never.
    :param start_crop: leave out a random beginning of at most this share, so that the start
        picture often shows the arm at work already; 0: never.
    :param goal_picture: the goal picture is the episode's 'last' frame; the 'recorded' goal
        where the episode reached it; or 'mixed', one or the other at random.
    :param colour: permute the colour channels of each episode.
    :param brightness: change each channel's brightness by up to this share.
    :param robot_mask: what the recordings' robot masks take out of targets and errors: 'none'; the
        'arm' with its shadow, so that the hand stays in the picture; or 'all' of the robot. What
        it hides is filled with what is seen there in the nearest frame of the episode.
    :param fill_context: share of the episodes whose start and goal pictures are filled, too, as a
        node with the parameter robot_mask does; 0: the robot stays in all of them.
    :param new_pixels: whether the network may paint; object maps are best without.
    :param base_width: the network's width; 32 in the paper.
    :param decoder: 'separate': three decoders, one an output (appendix C); 'shared': one of
        smaller convolutions for all outputs, faster.
    :param skips: the shared decoder also sees what the encoder's blocks found (U-Net).
    :param initial_weights: begin with these instead of fresh ones: a file, or the name of shipped
        weights; to learn another task from few episodes. Width, decoder, skips, new pixels and
        the size of the pictures are then those of the weights.
    :param precision: 'float32', 'bfloat16' (autocast), or 'auto': bfloat16 on a GPU, and on a CPU
        that has instructions for it. The choice stays for the whole run.
    :param patience: end after so many steps without a smaller error of the held-out episodes,
        relative to copying at the frame that is matched, and keep the weights that had the
        smallest; 0: go on to the last step.
    """

    out: Folder = 'runs/predictor'
    steps: int = 10000
    batch_size: int = 24
    learning_rate: float = 1e-3
    mode: Mode = 'bidirectional'
    loss: Loss = 'genmin'
    selection: Selection = 'progress'
    marks: str = ''
    mark_name: str = ''
    label_topic: Topics = ()
    label_signals: Annotated[tuple[str, ...], conf.arg(
        metavar='PART [PART ...]', help_behavior_hint='(default: none)')] = ()
    label_weight: float = 0.01
    keyframes: bool = False
    gan: bool = False
    latent: Latent = 'none'
    fraction: float = 0.5
    beta: float = 4.0
    progress_margin: float = 0.5
    recursion: int = 1
    kl_weight: float = 1e-4
    free_nats: float = 0.0
    kl_warmup: float = 0.0
    posterior_std: float = 1.0
    posterior: Posterior = 'video'
    margin: int = 3
    num_targets: int = 0
    min_crop: float = 1.0
    start_crop: float = 0.3
    goal_picture: GoalPicture = 'mixed'
    colour: bool = True
    brightness: float = 0.2
    robot_mask: RobotMask = 'none'
    fill_context: float = 0.0
    new_pixels: bool = False
    base_width: int = 16
    decoder: Literal['separate', 'shared'] = 'shared'
    skips: bool = True
    initial_weights: str = ''
    precision: Precision = 'auto'
    patience: int = 0

    @property
    def method(self) -> str:
        """
        The name of the method in the paper's tables, such as 'fix0.25' or 'genmin-vae-gan'.

        As there, fix, min and genmin alone are trained with l1 and GAN, -wo-gan by l1 only.
        """
        number = {'fix': '' if self.fraction == 0.5 else f'{self.fraction:g}',
                  'genmin': f'{self.beta:g}' if self.forward else ''}.get(self.loss, '')
        model = '-vae' + '-gan' * self.gan if self.latent == 'vae' else '-wo-gan' * (not self.gan)
        chosen = f'+{self.selection}' if self.selection == 'marks' or (
            self.loss == 'genmin' and self.selection != 'absolute') else ''
        return f'{self.loss}{number}{model}{chosen}'

    @property
    def only_fraction(self) -> float | None:
        """The share of an episode at which its only target is, None for all targets."""
        return self.fraction if self.loss == 'fix' and not self.marks else None

    @property
    def forward(self) -> bool:
        """Whether the start picture is all of the context."""
        return self.mode == 'forward'

    def check(self, ranges: Mapping[str, tuple[float, float]] | None = None) -> None:
        """Raise ConfigError for settings that cannot be trained with, or that do nothing."""
        super().check({**_RANGES, **(ranges or {})})
        if self.forward and self.loss == 'genmin' and self.selection == 'progress':
            raise ConfigError('selection: progress needs a goal picture; with mode forward choose '
                              'absolute')
        if (self.selection == 'marks') != bool(self.marks) or (self.marks and self.loss == 'min'):
            raise ConfigError('marks: they go with loss genmin or fix and selection marks; give '
                              'both options or none')
        if self.marks and (self.min_crop < 1 or self.start_crop):
            raise ConfigError('marks: start and goal are drawn around the label; leave min_crop '
                              'and start_crop out, which draw them anywhere')
        check_different('label_topic', (*self.cameras, *self.label_topic))
        if (self.label_topic or self.label_signals) and not self.marks:
            raise ConfigError('label_topic, label_signals: they tell the moment of marks; give '
                              '--marks')
        if self.keyframes and (not self.marks or self.forward or self.new_pixels
                               or self.recursion > MOST_LEVELS):
            raise ConfigError('keyframes: they are the frames that marks label, between a start '
                              f'and a goal, at most {MOST_LEVELS}, and copied instead of new '
                              'pixels; give --marks and --no-new-pixels, and leave mode out')
        if self.mark_name and (not self.marks or self.recursion > 1):
            raise ConfigError('mark_name: it chooses one of the marks of a demonstration; give '
                              '--marks, and leave recursion out')
        if self.recursion > 1 and self.loss == 'fix':
            raise ConfigError('recursion: the targets of Eq. 3 follow the match; expected 1 with '
                              'loss fix')
        if self.posterior == 'frame' and (
                self.latent == 'none' or self.gan or self.recursion > 1 or self.free_nats):
            raise ConfigError("posterior: 'frame' goes with latent vae, without GAN, recursion "
                              'and free_nats')
        if self.skips and self.decoder != 'shared':
            raise ConfigError("skips: they go with decoder 'shared'")
        if self.fill_context and self.robot_mask == 'none':
            raise ConfigError('fill_context: nothing is known of the robot; choose robot_mask arm '
                              'or all')
        for name in ('free_nats', 'kl_warmup', 'posterior_std'):
            if self.latent == 'none' and getattr(self, name) != getattr(TrainingConfig, name):
                raise ConfigError(f'{name}: only z has it; choose latent vae, or leave {name} out')


_PUSH = TrainingConfig(recordings=())
# Where objects stand close together, genmin over progress copies the start.
_BY_COPYING = replace(_PUSH, selection='relative', progress_margin=0.0)
# Pictures that must be made up, of a gripper where it was not yet, do not come by warping. A hand
# on an object is told by its colour; other colours teach that it has none.
_GRIPPING = replace(
    _PUSH, progress_margin=0.0, new_pixels=True, goal_picture='last', start_crop=0.0, colour=False,
    brightness=0.0, steps=4000)

RECIPES = {  # the first stands for recordings of other tasks
    'push2': _PUSH,
    'order2': replace(_BY_COPYING, initial_weights='push2', steps=2500),
    # Begins anywhere in the first 0.6: a second subgoal is predicted from where the first was.
    'order3': replace(_BY_COPYING, start_crop=0.6, initial_weights='push3', steps=4000),
    'push3': replace(_PUSH, initial_weights='push2', steps=3000),
    'stack2': _GRIPPING,
    'stack3': _GRIPPING,
    'grasp': replace(_GRIPPING, steps=10000),
    'grasp_forward': replace(_GRIPPING, mode='forward', selection='absolute'),
    'pick_place': replace(_GRIPPING, steps=30000),
    'pick_place_vae': replace(
        _GRIPPING, selection='absolute', latent='vae', margin=0, kl_weight=2e-5, free_nats=4.0),
    # A dozen marked demonstrations, see marks. The moment may be three frames from the goal. As
    # above, gripping hands must be made up.
    'foreign': replace(_BY_COPYING, margin=1, start_crop=0.0, new_pixels=True, colour=False,
                       brightness=0.0, steps=800, batch_size=8),
    # Ten steps, to see whether recordings can be trained on.
    'debug': replace(_PUSH, steps=10, batch_size=4, test_fraction=0.3, threads=1, base_width=4,
                     precision='float32')}
