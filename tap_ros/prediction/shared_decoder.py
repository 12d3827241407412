# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""One decoder for all outputs of the predictor, in place of the three of appendix C."""

from collections.abc import Sequence

import torch
from torch import nn
from torch.nn import functional


class SharedDecoder(nn.Module):
    """
    Transposed convolution to 4x4, then upsampling-3x3 convolutions; not in the paper.

    The sizes of its blocks are those of appendix C. With skips (U-Net), each block also takes
    what the encoder's block of its size found in the pictures, and the last convolution the
    pictures themselves.

    :param in_features: length of the code.
    :param widths: channels of the blocks, fine to coarse.
    :param outputs: channels of each output.
    :param pictures: of how many pictures the skips are; 0: there are none.
    """

    def __init__(self, in_features: int, widths: Sequence[int], outputs: Sequence[int],
                 pictures: int = 0) -> None:
        super().__init__()
        steps = list(zip(widths[:0:-1], widths[-2::-1]))  # channels (in, out), coarse to fine
        self.outputs = list(outputs)
        self.start = nn.Sequential(
            nn.ConvTranspose2d(in_features, widths[-1], 4, bias=False),
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
            x = torch.cat([x, _joined(pictures.flatten(0, 1), len(pictures)).to(x.dtype)], 1)
        return self.end(x).split(self.outputs, 1)


def _joined(features: torch.Tensor, batch: int) -> torch.Tensor:
    """Put the channels of the pictures of an episode in a row, in the format channels_last."""
    return features.unflatten(0, (batch, -1)).permute(0, 3, 4, 1, 2).flatten(3).permute(0, 3, 1, 2)


def _double(x: torch.Tensor) -> torch.Tensor:
    return functional.interpolate(x, scale_factor=2, mode='bilinear', align_corners=False)
