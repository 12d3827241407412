# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
The settings of a training run of the predictor, in parts.

A TrainingConfig has the fields of all parts: options on the command line and settings in files are
one flat list.
"""

from dataclasses import dataclass, fields
from functools import cached_property
from typing import Any, get_args, Literal

from tap_ros.errors import ConfigError
from tap_ros.prediction.methods import Method, Mode, parse_method
from tap_ros.recording.reading import Reading
from tap_ros.training.robot_mask import RobotMask
from tap_ros.training.split import TEST_FRACTION

Decoder = Literal['separate', 'shared']
GoalPicture = Literal['last', 'recorded', 'mixed']
Posterior = Literal['video', 'frame']
Precision = Literal['auto', 'float32', 'bfloat16']


@dataclass(frozen=True)
class RunSettings:
    """
    Where a run happens and what it leaves.

    :param recordings: .mcap files, bag folders, or folders of these.
    :param out: the run's folder; if it holds a checkpoint, training goes on from there.
    :param test_fraction: share of episodes held out, by seed.
    :param seed: of the weights, batches and augmentation.
    :param device: where the networks are: 'auto', 'cpu' or 'cuda'.
    :param precision: 'float32', 'bfloat16' (autocast), or 'auto': bfloat16 where a short trial
        finds it faster. The choice stays for the whole run.
    :param threads: of the CPU; 0: as many as there are.
    :param compile: use torch.compile; slow to start, results differ in the last digits.
    :param log_every: steps between curve points.
    :param save_every: steps between checkpoints, scores and sample pictures.
    """

    recordings: tuple[str, ...]
    out: str
    test_fraction: float = TEST_FRACTION
    seed: int = 0
    device: str = 'auto'
    precision: Precision = 'auto'
    threads: int = 0
    compile: bool = False
    log_every: int = 20
    save_every: int = 500

    def __post_init__(self) -> None:
        """Refuse settings that cannot be run with."""
        if not self.recordings:
            raise ConfigError('recordings: expected at least one .mcap file or bag folder')
        _check_choice(self, precision=Precision)
        _check_least(self, 1, 'log_every', 'save_every')
        _check_least(self, 0, 'threads')
        _check_range(self, test_fraction=(0, 0.9))


@dataclass(frozen=True)
class ObjectiveSettings:
    """
    What the loss of a batch is.

    :param mode: 'bidirectional', from start and goal, or 'forward', from the start alone.
    :param method: 'fix' (Eq. 1), 'min' (Eq. 2) or 'genmin' (Eq. 5), as the paper names them: with
        l1 and GAN; fix0.25 with its target at a quarter of the episode; genmin2 with beta = 2, in
        forward prediction; -wo-gan is l1 alone, -vae adds z (Eq. 9), -vae-gan both (Eq. 10);
        with +relative the error relative to copying selects, with +reach the cost of reaching
        does, with +progress the preference is over what the pictures show of the way (losses.py).
    :param bell_edge: w at both ends of the targets; 2/3 in the paper.
    :param progress_margin: with +progress, frames whose progress is within this of that of the
        start or the goal picture are not matched, see losses.beside_context; 0..0.95.
    :param outer_power: power of the outer error; 1 in the paper, see objective.predictor_loss.
    :param changed_weight: how much more pixels of the target weigh in the outer error that differ
        from every input; 0 in the paper, see losses.weighted_l1_error.
    :param match_temperature: draw the target of min and genmin by a softmax of this temperature
        at the start of the training, see losses.match_step; 0, the paper: the least error.
    :param match_share: share of the training over which the temperature falls to 0.
    :param recursion: levels of Eq. 3; 1: none. The GAN's and the VAE's terms stand at the first.
    :param detach_recursion: a level's prediction is an input of the next one without gradient; the
        paper: with it, see objective.py.
    :param gan_weight: of the GAN's terms beside the l1 error on [0, 1].
    :param kl_weight: of the KL divergence beside it.
    :param free_nats: KL divergence up to this, in the mean over a process's part of the batch,
        costs nothing; 0, the paper: all of it costs, and z may be ignored (posterior collapse). As
        free bits (arXiv:1606.04934), of the whole z.
    :param kl_warmup: share of the training in which the KL divergence costs nothing, and over
        which its weight then rises, so that z is of use before it has a price (as in
        arXiv:1602.02282); 0, the paper: never.
    :param posterior_std: standard deviation of z that the recognition network begins with; one
        well below 1 is little noise, which the predictor need not learn to ignore first.
    :param posterior: z is inferred from the whole 'video' (Eq. 9), or from each 'frame' (appendix
        B, slow: choose a small num_targets).
    """

    mode: Mode = 'bidirectional'
    method: str = 'genmin-wo-gan+relative'
    bell_edge: float = 2 / 3
    progress_margin: float = 0.0
    outer_power: float = 0.5
    changed_weight: float = 0.0
    match_temperature: float = 0.0
    match_share: float = 0.5
    recursion: int = 1
    detach_recursion: bool = False
    gan_weight: float = 5e-5
    kl_weight: float = 1e-4
    free_nats: float = 0.0
    kl_warmup: float = 0.0
    posterior_std: float = 1.0
    posterior: Posterior = 'video'

    def __post_init__(self) -> None:
        """Refuse a loss that there is not."""
        _check_choice(self, mode=Mode, posterior=Posterior)
        _check_least(self, 1, 'recursion')
        _check_least(self, 0, 'changed_weight', 'gan_weight', 'kl_weight', 'free_nats')
        _check_range(self, bell_edge=(1e-6, 1), progress_margin=(0, 0.95), outer_power=(0.1, 1),
                     match_temperature=(0, 1e6), match_share=(1e-6, 1),
                     kl_warmup=(0, 0.5), posterior_std=(0.01, 1))
        method = self.chosen
        if method.beta is not None and not self.forward:
            raise ConfigError(f'method: {method.name} has the linear preference of forward '
                              "prediction; give --mode forward, or 'genmin'")
        if method.selection == 'picture_progress' and self.forward:
            raise ConfigError(f'method: {method.name} needs a goal picture; give --mode '
                              'bidirectional')
        if self.progress_margin and method.selection != 'picture_progress':
            raise ConfigError('progress_margin: it goes with a +progress method, got method '
                              f'{method.name}')
        if self.match_temperature and method.loss == 'fix':
            raise ConfigError('match_temperature: a fixed target is not drawn; expected 0 with '
                              f'method {method.name}')
        if self.recursion > 1 and method.loss == 'fix':
            raise ConfigError('recursion: the targets of Eq. 3 follow the match; expected 1 with '
                              f'method {method.name}')
        if self.posterior == 'frame' and (
                not method.vae or method.gan or self.recursion > 1):
            raise ConfigError("posterior: 'frame' goes with a -vae method without GAN and without "
                              'recursion')
        if self.free_nats and self.posterior == 'frame':
            raise ConfigError("free_nats: it goes with posterior 'video'")
        for name in ('free_nats', 'kl_warmup', 'posterior_std'):
            if getattr(self, name) != getattr(ObjectiveSettings, name) and not method.vae:
                raise ConfigError(f'{name}: it goes with a -vae method, got method {method.name}')

    @cached_property
    def chosen(self) -> Method:
        """The Method that `method` names."""
        return parse_method(self.method)

    @property
    def forward(self) -> bool:
        """Whether the start picture is all of the context."""
        return self.mode == 'forward'


@dataclass(frozen=True)
class DataSettings:
    """
    What is taken from the episodes, and how it is changed; see batches.Sampling.

    :param margin: frames left out of the targets next to each context picture.
    :param num_targets: at most so many random targets an episode and step; 0: all of them.
    :param max_frames: longer episodes are cut to a random piece of this length; 0: never.
    :param min_crop: cut episodes to a random piece of at least this share; 1: never.
    :param start_crop: leave out a random beginning of at most this share, so that the start
        picture often shows the arm at work already; 0: never.
    :param goal_picture: the goal picture is the episode's 'last' frame; the 'recorded' goal
        where the episode reached it; or 'mixed', one or the other at random.
    :param flip: mirror half of the episodes.
    :param colour: permute the colour channels of each episode.
    :param brightness: change each channel's brightness by up to this share.
    :param robot_mask: what the recordings' robot masks take out of targets and errors: 'none'; the
        'arm' with its shadow, so that the hand stays in the picture; or 'all' of the robot. What
        it hides is filled with what is seen there in the nearest frame of the episode.
    :param fill_context: share of the episodes whose start and goal pictures are filled, too, as a
        node with the parameter robot_mask does; 0: the robot stays in all of them.
    """

    margin: int = 3
    num_targets: int = 0
    max_frames: int = 0
    min_crop: float = 1.0
    start_crop: float = 0.0
    goal_picture: GoalPicture = 'mixed'
    flip: bool = True
    colour: bool = True
    brightness: float = 0.2
    robot_mask: RobotMask = 'none'
    fill_context: float = 0.0

    def __post_init__(self) -> None:
        """Refuse what cannot be taken from episodes."""
        _check_choice(self, goal_picture=GoalPicture, robot_mask=RobotMask)
        _check_least(self, 0, 'margin', 'num_targets', 'max_frames')
        if 0 < self.max_frames < 3:
            raise ConfigError(f'max_frames: expected 0 or at least 3, got {self.max_frames}')
        _check_range(self, min_crop=(1e-6, 1), brightness=(0, 0.9), start_crop=(0, 0.9),
                     fill_context=(0, 1))
        if self.fill_context and self.robot_mask == 'none':
            raise ConfigError('fill_context: nothing is known of the robot; give --robot-mask arm '
                              'or all')


@dataclass(frozen=True)
class NetworkSettings:
    """
    Which networks are trained; see PredictorConfig.

    :param new_pixels: whether the network may paint; object maps are best without.
    :param base_width: the network's width; 32 in the paper.
    :param flow_scale: pixels of flow for an output of 1 of the flow decoder.
    :param decoder: 'separate': three decoders, one an output (appendix C); 'shared': one of
        smaller convolutions for all outputs, faster.
    :param skips: the shared decoder also sees what the encoder's blocks found (U-Net).
    :param latent_size: length of z, for the methods that have it.
    :param video_frames: the recognition network sees the video at so many moments; the paper: all.
    :param initial_weights: begin with these instead of fresh ones: a file, or the name of shipped
        weights; to learn another task from few episodes. The network must have the same shape.
    :param pretrain_steps: steps of training the decoders as a frame generator first (appendix C),
        at a rate of 1e-4.
    """

    new_pixels: bool = False
    base_width: int = 16
    flow_scale: float = 16.0
    decoder: Decoder = 'separate'
    skips: bool = False
    latent_size: int = 32
    video_frames: int = 16
    initial_weights: str = ''
    pretrain_steps: int = 0

    def __post_init__(self) -> None:
        """Refuse networks that there are not."""
        if self.initial_weights and self.pretrain_steps:
            raise ConfigError('initial_weights: they have decoders already; expected '
                              f'pretrain_steps 0, got {self.pretrain_steps}')
        _check_choice(self, decoder=Decoder)
        if self.skips and self.decoder != 'shared':
            raise ConfigError("skips: they go with decoder 'shared'; give --decoder shared, too")
        if self.pretrain_steps and self.decoder != 'separate':
            raise ConfigError('pretrain_steps: only the decoders of appendix C are pretrained; '
                              "expected 0 with decoder 'shared'")
        _check_least(self, 1, 'base_width', 'latent_size', 'video_frames')
        _check_least(self, 0, 'pretrain_steps')


@dataclass(frozen=True)
class OptimizerSettings:
    """
    How the weights are moved.

    :param steps: length of the training, and of the cosine schedule of the learning rate.
    :param batch_size: 64 in the paper.
    :param learning_rate: at the start; Adam (beta1 is 0.5 with a GAN, else 0.9). 1e-4 in the
        paper, for 200 epochs.
    :param discriminator_rate: the discriminators' learning rate at the start.
    :param warmup: steps over which the learning rate rises.
    :param gradient_clip: largest norm of the gradient; 0: any.
    :param average_decay: of the exponential moving average that is shipped; 0: none.
    """

    steps: int = 5000
    batch_size: int = 32
    learning_rate: float = 1e-3
    discriminator_rate: float = 2e-4
    warmup: int = 100
    gradient_clip: float = 1.0
    average_decay: float = 0.999

    def __post_init__(self) -> None:
        """Refuse what cannot be optimised with."""
        _check_least(self, 1, 'steps', 'batch_size')
        _check_least(self, 0, 'warmup')
        _check_range(self, average_decay=(0, 0.99999))


# Of the bases the last has its fields first.
@dataclass(frozen=True)
class TrainingConfig(
        OptimizerSettings, NetworkSettings, DataSettings, ObjectiveSettings, Reading,
        RunSettings):
    """All that a training run is made from: the fields of its parts."""

    def __post_init__(self) -> None:
        """Refuse settings that cannot be trained with."""
        for part in PARTS:
            part.__post_init__(self)


PARTS: tuple[type[Any], ...] = TrainingConfig.__bases__
DEFAULTS = {field.name: field.default for field in fields(TrainingConfig)}


def _check_choice(config: object, **choices: Any) -> None:
    """Refuse a field that is none of its choices, a Literal."""
    for name, valid in choices.items():
        if getattr(config, name) not in get_args(valid):
            raise ConfigError(f'{name}: expected one of {", ".join(get_args(valid))}, '
                              f'got {getattr(config, name)!r}')


def _check_least(config: object, least: float, *names: str) -> None:
    """Refuse fields that are less than they can be."""
    for name in names:
        if getattr(config, name) < least:
            wanted = 'at least 1' if least else '0 or more'
            raise ConfigError(f'{name}: expected {wanted}, got {getattr(config, name)}')


def _check_range(config: object, **ranges: tuple[float, float]) -> None:
    """Refuse fields outside their range."""
    for name, (low, high) in ranges.items():
        if not low <= getattr(config, name) <= high:
            raise ConfigError(f'{name}: expected {low}..{high}, got {getattr(config, name)}')
