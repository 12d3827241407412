# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Decoders that begin as a generator of frames (appendix C).

The paper only says that the decoder is first trained "as an unconditional frame generator on
frames from the training videos". Here that is a DCGAN of single frames.
"""

from collections.abc import Callable, Iterator
import contextlib

import numpy as np
from tap_ros.images.pixels import to_float
from tap_ros.prediction.networks import decoder, encoder, initialise, Predictor, PredictorConfig
from tap_ros.training.devices import Autocast, placed
import torch
from torch import nn
from torch.nn import functional
from tqdm import tqdm

_BETAS = (0.5, 0.999)  # DCGAN's; Adam's own 0.9 makes the two networks swing


def pretrain_decoders(network: Predictor, draw_frames: Callable[[int], np.ndarray | torch.Tensor],
                      steps: int, learning_rate: float = 1e-4, seed: int = 0,
                      autocast: Autocast = contextlib.nullcontext, progress: bool = False) -> None:
    """
    Train a frame generator of the decoders' shape and copy its weights into the decoders.

    The pixel decoder takes all of it; flow and masks keep their own last layers, whose outputs
    mean something else. Nothing else of the network changes. The result depends on the seed and
    on the frames alone; the global random numbers are neither used nor moved.

    :param network: Predictor, on any device; changed in place.
    :param draw_frames: function from a step, 0 on, to frames of the training videos, uint8
        (B, H, W, 3), array or tensor.
    :param steps: of the generator and of its discriminator; 10 epochs of batches of 64 in the
        paper.
    :param learning_rate: of Adam, for both.
    :param seed: of the first weights and of the latent vectors.
    :param autocast: makes the context manager to run the networks in.
    :param progress: whether to show a progress bar.
    """
    device = next(network.parameters()).device
    size = network.config.code_size + network.config.latent_size
    generator, discriminator = (placed(part, device).train()
                                for part in frame_gan(network.config, seed))
    optimizers = [torch.optim.Adam(part.parameters(), learning_rate, _BETAS, fused=True)
                  for part in (discriminator, generator)]
    for step in tqdm(range(steps), 'pretraining', unit='step', disable=not progress):
        real = to_float(draw_frames(step)).to(device)
        z = _latent(len(real), size, seed, step).to(device)
        for optimizer, loss in zip(
                optimizers, _losses(generator, discriminator, real, z, autocast)):
            optimizer.zero_grad()
            loss.backward()
            optimizer.step()
    _copy(generator, network)


def frame_gan(config: PredictorConfig, seed: int) -> tuple[nn.Sequential, nn.Sequential]:
    """
    Build the two networks of the pretraining.

    :param config: PredictorConfig of the predictor that will take the generator's weights.
    :param seed: of their weights.
    :return: the generator, from (B, code_size + latent_size, 1, 1) to (B, 3, H, W) before the
        tanh; the discriminator, from (B, 3, H, W) in [-1, 1] to (B, 1, 1, 1) logits.
    """
    with torch.random.fork_rng(devices=[]):  # built on the CPU: no other device's numbers move
        torch.default_generator.manual_seed(seed)
        generator = decoder(config.code_size + config.latent_size, config.widths, 3)
        discriminator = nn.Sequential(
            *encoder(3, config.widths), nn.Conv2d(config.widths[-1], 1, 4))
        return generator.apply(initialise), discriminator.apply(initialise)


def _latent(batch: int, size: int, seed: int, step: int) -> torch.Tensor:
    """Draw latent vectors (B, size, 1, 1) from N(0, I), the same ones whenever asked."""
    rng = np.random.default_rng([seed, 5, step])
    return torch.from_numpy(rng.standard_normal((batch, size, 1, 1), np.float32))


def _losses(generator: nn.Sequential, discriminator: nn.Sequential, real: torch.Tensor,
            z: torch.Tensor, autocast: Autocast) -> Iterator[torch.Tensor]:
    """Yield the discriminator's loss, then, once that was minimised, the generator's."""
    with autocast():
        fake = torch.tanh(generator(z).float())
        discriminator.requires_grad_(True)
        # One batch each: batch norm must not mix real and generated frames.
        positive, negative = discriminator(real), discriminator(fake.detach())
    yield (functional.softplus(-positive.float()) + functional.softplus(negative.float())).mean()
    with autocast():
        discriminator.requires_grad_(False)
        judged = discriminator(fake)
    yield functional.softplus(-judged.float()).mean()


def _copy(generator: nn.Sequential, network: Predictor) -> None:
    """Give the network's decoders the generator's weights and statistics."""
    for part in (network.flow_decoder, network.mask_decoder):
        for mine, trained in zip(list(part)[:-1], list(generator)[:-1]):
            mine.load_state_dict(trained.state_dict())
    if network.pixel_decoder is not None:
        network.pixel_decoder.load_state_dict(generator.state_dict())
