# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
The predictor G of appendix C, and with the one decoder of ours instead of its three.

Pictures go in and out as NCHW float32 in [-1, 1]. Everything works in either memory format; on a
CPU `channels_last` is the faster one.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
import math
from typing import Literal

from tap_ros.base.errors import check_fields, ConfigError
from tap_ros.images.crop import is_halved
from tap_ros.prediction.keyframe_bank import KeyframeBank
from tap_ros.prediction.warp import combine, warp
import torch
from torch import nn
from torch.nn import functional


@dataclass(frozen=True)
class PredictorConfig:
    """
    The shape of a predictor; saved in its weights file.

    :param image_size: pixels on each side, a power of two or three times one, from 16 on; the
        paper has 64.
    :param base_width: channels of the first block; they double at each following one. Paper: 32.
    :param num_context: pictures that the prediction is conditioned on: 2 is start and goal; more
        add keyframes of the most alike demonstrations, see keyframe_bank.
    :param code_size: length of the vector between encoder and decoders.
    :param latent_size: length of z, appended to that vector; 0 is a deterministic predictor.
    :param new_pixels: whether there is a decoder for pixels that cannot be copied. Object maps
        need the variant without (appendix E).
    :param flow_scale: pixels of flow for an output of 1 of the flow decoder; not in the paper.
    :param decoder: 'separate': three decoders of 5x5 convolutions (appendix C). 'shared': one of
        3x3 convolutions, with all outputs at its end; not in the paper, two to three times faster.
    :param skips: whether the shared decoder also sees what the encoder's blocks found, and the
        pictures themselves, each at its own size (U-Net). What is small gets lost in the code.
    """

    image_size: int = 64
    base_width: int = 32
    num_context: int = 2
    code_size: int = 128
    latent_size: int = 0
    new_pixels: bool = True
    flow_scale: float = 16.0
    decoder: Literal['separate', 'shared'] = 'separate'
    skips: bool = False

    def __post_init__(self) -> None:
        """Refuse shapes that the network cannot have."""
        check_fields(self, {
            'base_width': (1, 2 ** 15), 'num_context': (1, 64), 'code_size': (1, 2 ** 13),
            'latent_size': (0, 2 ** 13), 'flow_scale': (1e-6, 2 ** 16)})
        if self.skips and self.decoder != 'shared':
            raise ConfigError("skips: they go with decoder 'shared'; appendix C has none")
        if not is_halved(self.image_size):
            raise ConfigError(f'image_size: expected a power of two or three times one, from 16 '
                              f'on, such as 64 or 96, got {self.image_size}')
        # Beyond this a network takes many gigabytes; it is a wrong number rather than a wish.
        if self.image_size * self.base_width > 2 ** 15:
            raise ConfigError(f'image_size times base_width: expected at most {2 ** 15}, got '
                              f'{self.image_size} times {self.base_width}')

    @property
    def num_keyframes(self) -> int:
        """Pictures beside start and goal."""
        return max(0, self.num_context - 2)

    @property
    def widths(self) -> tuple[int, ...]:
        """Channels from the finest block to the coarsest: (32, 64, 128, 256) in the paper."""
        return tuple(self.base_width * 2 ** i for i in range(int(math.log2(self.image_size)) - 2))

    @property
    def coarsest(self) -> int:
        """Pixels a side after the coarsest block: 4 as in the paper, or 6."""
        return self.image_size >> len(self.widths)


@dataclass(frozen=True)
class Prediction:
    """
    What a predictor answers for a batch.

    :param image: (B, 3, H, W) in [-1, 1], the predicted frame.
    :param flow: (B, C, 2, H, W) in pixels, (du, dv): where, relative to itself, each pixel of
        the prediction is read from in context picture c.
    :param masks: (B, C+1, 1, H, W), or (B, C, 1, H, W) without new pixels; sum to 1 over dim 1,
        in the order of the context, the new pixels last.
    :param new_pixels: (B, 3, H, W) in [-1, 1], or None.
    """

    image: torch.Tensor
    flow: torch.Tensor
    masks: torch.Tensor
    new_pixels: torch.Tensor | None


def encoder(in_channels: int, widths: tuple[int, ...]) -> nn.Sequential:
    """
    Build the DCGAN discriminator's trunk: 4x4 convolutions that halve the size (appendix C).

    As in DCGAN, to which the paper says it is identical, the first block has no batch norm.
    """
    layers: list[nn.Module] = []
    for i, width in enumerate(widths):
        layers.append(nn.Conv2d(in_channels, width, 4, stride=2, padding=1, bias=i == 0))
        if i > 0:
            layers.append(nn.BatchNorm2d(width))
        layers.append(nn.LeakyReLU(0.2))
        in_channels = width
    return nn.Sequential(*layers)


def decoder(in_features: int, widths: tuple[int, ...], out_channels: int,
            coarsest: int = 4) -> nn.Sequential:
    """
    Build a decoder: transposed convolution to 4x4, then upsampling-5x5 convolutions (appendix C).

    With the misprint of the paper corrected: 256x4x4, 128x8x8, 64x16x16, 32x32x32, out x64x64.
    The activation of the last block is left to the caller.
    """
    layers: list[nn.Module] = [nn.ConvTranspose2d(in_features, widths[-1], coarsest, bias=False)]
    for wider, narrower in zip(widths[::-1], widths[-2::-1]):
        layers += [nn.BatchNorm2d(wider), nn.ReLU(), nn.Upsample(scale_factor=2, mode='bilinear'),
                   nn.Conv2d(wider, narrower, 5, padding=2, bias=False)]
    return nn.Sequential(
        *layers, nn.BatchNorm2d(widths[0]), nn.ReLU(),
        nn.Upsample(scale_factor=2, mode='bilinear'),
        nn.Conv2d(widths[0], out_channels, 5, padding=2))


def initialise(module: nn.Module) -> None:
    """Set DCGAN's initial weights: normal(0, .02), batch norm normal(1, .02), biases 0."""
    if isinstance(module, (nn.Conv2d, nn.ConvTranspose2d)):
        nn.init.normal_(module.weight, 0.0, 0.02)
        if module.bias is not None:
            nn.init.zeros_(module.bias)
    elif isinstance(module, nn.BatchNorm2d):
        nn.init.normal_(module.weight, 1.0, 0.02)
        nn.init.zeros_(module.bias)


class SharedDecoder(nn.Module):
    """
    One decoder for all outputs, of 3x3 convolutions; not in the paper.

    The sizes of its blocks are those of appendix C. With skips (U-Net), each block also takes
    what the encoder's block of its size found in the pictures, and the last convolution the
    pictures themselves.

    :param in_features: length of the code.
    :param widths: channels of the blocks, fine to coarse.
    :param outputs: channels of each output.
    :param pictures: of how many pictures the skips are; 0: there are none.
    :param coarsest: pixels a side of the first block.
    """

    def __init__(self, in_features: int, widths: Sequence[int], outputs: Sequence[int],
                 pictures: int = 0, coarsest: int = 4) -> None:
        super().__init__()
        steps = list(zip(widths[:0:-1], widths[-2::-1]))  # channels (in, out), coarse to fine
        self.outputs = list(outputs)
        self.start = nn.Sequential(
            nn.ConvTranspose2d(in_features, widths[-1], coarsest, bias=False),
            nn.BatchNorm2d(widths[-1]), nn.ReLU())
        self.blocks = nn.ModuleList(nn.Sequential(
            nn.Conv2d(wider, narrower, 3, padding=1, bias=False),
            nn.BatchNorm2d(narrower), nn.ReLU()) for wider, narrower in steps)
        self.skips = nn.ModuleList(
            nn.Conv2d(pictures * narrower, wider, 1) for wider, narrower in steps
        ) if pictures else None
        self.end = nn.Conv2d(widths[0] + 3 * pictures, sum(outputs), 3, padding=1)

    def forward(self, code: torch.Tensor, levels: Sequence[torch.Tensor],
                pictures: torch.Tensor) -> Sequence[torch.Tensor]:
        """
        Decode.

        :param code: (B, in_features, 1, 1).
        :param levels: for the skips: what the encoder's blocks found, fine to coarse, each
            (B * pictures, width, h, w).
        :param pictures: (B, pictures, 3, H, W).
        :return: for each output (B, channels, H, W), before its activation.
        """
        x = self.start(code)
        for i, block in enumerate(self.blocks):
            x = _double(x)
            if self.skips is not None:
                x = x + self.skips[i](_joined(levels[-2 - i], len(pictures)))
            x = block(x)
        x = _double(x)
        if self.skips is not None:
            if x.requires_grad:  # its gradient is a part of a larger one, which is slow to double
                x.register_hook(_channels_last)
            x = torch.cat([x, _joined(pictures.flatten(0, 1), len(pictures)).to(x.dtype)], 1)
        return self.end(x).split(self.outputs, 1)


def _joined(features: torch.Tensor, batch: int) -> torch.Tensor:
    """
    Put the channels of the pictures of an episode in a row.

    In the format channels_last, and so is the gradient: mixed formats are slow.
    """
    rows = features.permute(0, 2, 3, 1).unflatten(0, (batch, -1))  # B, C, h, w, channels
    return rows.movedim(1, 3).flatten(3).contiguous().permute(0, 3, 1, 2)


def _channels_last(x: torch.Tensor) -> torch.Tensor:
    return x.contiguous(memory_format=torch.channels_last)


def _double(x: torch.Tensor) -> torch.Tensor:
    return functional.interpolate(x, scale_factor=2, mode='bilinear')


class PredictorNetwork(nn.Module):
    """
    Predict one frame between context pictures: warped pictures and new pixels, blended by masks.

    One encoder reads each context picture; their features are concatenated. Three decoders of
    the same shape give the new pixels, the flow and the masks (appendix C, its last figure), or
    one gives all of them (`decoder='shared'`).

    :ivar bank: what pictures beside start and goal come from, unless they are given.
    """

    bank: KeyframeBank | None = None

    def __init__(self, config: PredictorConfig) -> None:
        """Build the network with fresh weights."""
        super().__init__()
        self.config = config
        widths, features = config.widths, config.code_size + config.latent_size
        C = config.num_context
        self.encoder = encoder(3, widths)
        # Kernel sizes of the head are ours: the paper says convolution-ReLU-convolution.
        self.head = nn.Sequential(
            nn.Conv2d(C * widths[-1], widths[-1], 3, padding=1),
            nn.ReLU(),
            nn.Conv2d(widths[-1], config.code_size, config.coarsest))
        if config.decoder == 'shared':
            self.shared_decoder = SharedDecoder(
                features, widths, (2 * C, C + config.new_pixels, 3 * config.new_pixels),
                C if config.skips else 0, config.coarsest)
            flow = self.shared_decoder.end.weight
        else:
            build = partial(decoder, features, widths, coarsest=config.coarsest)
            self.flow_decoder = build(2 * C)
            self.mask_decoder = build(C + config.new_pixels)
            self.pixel_decoder = build(3) if config.new_pixels else None
            flow = self.flow_decoder[-1].get_parameter('weight')
        self.apply(initialise)
        # Training starts from copying: flow near 0.
        with torch.no_grad():
            flow[:2 * C].normal_(0.0, 0.002)

    def forward(self, context: torch.Tensor, z: torch.Tensor | None = None) -> Prediction:
        """
        Predict.

        :param context: (B, C, 3, H, W) in [-1, 1]; of a network with a bank also start and goal
            alone, whose keyframes then are looked up.
        :param z: (B, latent_size), or None for zeros, the mean of the prior.
        :return: a Prediction.
        """
        if self.bank is not None and context.shape[1] == 2:
            context = self.bank.completed(context, self.config.num_keyframes)
        B, C, _, H, W = context.shape
        x, levels = context.flatten(0, 1), []                   # B*C, 3, 64, 64
        for layer in self.encoder:
            x = layer(x)
            if isinstance(layer, nn.LeakyReLU):                 # a block, fine to coarse
                levels.append(x)
        code = self.head(_joined(levels[-1], B))                # B, 128, 1, 1
        if self.config.latent_size:
            if z is None:
                z = code.new_zeros(B, self.config.latent_size)
            code = torch.cat([code, z[:, :, None, None].to(code.dtype)], 1)
        if self.config.decoder == 'shared':
            flow, masks, new = self.shared_decoder(code, levels, context)
        else:
            flow, masks, new = (code if part is None else part(code) for part in (
                self.flow_decoder, self.mask_decoder, self.pixel_decoder))
        # Positions need more digits than half precision has: blend in float32.
        flow = flow.float().unflatten(1, (C, 2)) * self.config.flow_scale
        masks = functional.softmax(masks.float(), 1)[:, :, None]
        new_pixels = torch.tanh(new.float()) if self.config.new_pixels else None
        image = combine(warp(context.float(), flow), masks, new_pixels)
        return Prediction(image, flow, masks, new_pixels)
