# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Appearance flow: one backward warp for pictures and for object maps.

A flow (du, dv) in pixels at pixel (u, v) says that the output there is read from
(u + du, v + dv). Pixel (0, 0) is the centre of the top-left pixel.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import torch
from torch.nn import functional

# Of the mass 1 of an object map, what has to survive the warp for it to be trusted.
MIN_MASS = 0.05


@dataclass(frozen=True)
class WarpedMaps:
    """
    Object maps of a predicted frame.

    :param maps: (B, K, H, W), each sums to 1.
    :param mass: (B, K), what each map summed to before it was normalised. Backward warping does
        not conserve mass: near 0 the object got lost, near 2 it is seen twice.
    """

    maps: torch.Tensor
    mass: torch.Tensor


def warp(images: torch.Tensor, flow: torch.Tensor) -> torch.Tensor:
    """
    Read each pixel of the output where the flow points to, bilinearly.

    :param images: (B, C, channels, H, W), pictures or maps.
    :param flow: (B, C, 2, H, W) in pixels, (du, dv).
    :return: (B, C, channels, H, W). Positions outside the picture read its border.
    """
    B, C, _, H, W = flow.shape
    here, scale = _pixels(H, W, flow.dtype, flow.device)
    # With align_corners -1 and 1 are the centres of the outermost pixels. Fastest on a CPU where
    # all u lie together, and all v.
    grid = ((flow.flatten(0, 1).contiguous() + here) * scale - 1).movedim(1, -1)  # B*C, H, W, 2
    warped = functional.grid_sample(images.flatten(0, 1), grid, mode='bilinear',
                                    padding_mode='border', align_corners=True)
    return warped.unflatten(0, (B, C))


@lru_cache(8)
@torch.inference_mode(False)
def _pixels(H: int, W: int, dtype: torch.dtype,
            device: torch.device) -> tuple[torch.Tensor, torch.Tensor]:
    """Return (u, v) of each pixel, (2, H, W), and the scale of both for a grid, (2, 1, 1)."""
    v, u = (torch.arange(side, device=device, dtype=dtype) for side in (H, W))
    return (torch.stack([u.expand(H, W), v[:, None].expand(H, W)]),
            torch.tensor([2 / max(side - 1, 1) for side in (W, H)], device=device,
                         dtype=dtype)[:, None, None])


def combine(warped: torch.Tensor, masks: torch.Tensor,
            new_pixels: torch.Tensor | None = None) -> torch.Tensor:
    """
    Blend warped pictures, and new pixels if there are any, by masks.

    :param warped: (B, C, channels, H, W).
    :param masks: (B, C, 1, H, W), or (B, C+1, 1, H, W) with the one of the new pixels last.
    :param new_pixels: (B, channels, H, W) or None.
    :return: (B, channels, H, W).
    """
    C = warped.shape[1]
    image = (masks[:, :C] * warped).sum(1)
    return image if new_pixels is None else image + masks[:, C] * new_pixels


def one_hot_maps(pixels: torch.Tensor, size: Sequence[int]) -> torch.Tensor:
    """
    Draw each position as a map that sums to 1 and has its mean there.

    A position between pixels is shared among its four neighbours bilinearly; one outside the
    picture moves to the nearest pixel inside.

    :param pixels: (..., 2) in (u, v) order, finite.
    :param size: (height, width).
    :return: float32 (..., H, W).
    """
    H, W = size
    pixels = pixels.float()
    here, _ = _pixels(H, W, pixels.dtype, pixels.device)
    u = pixels[..., 0].clamp(0, W - 1)[..., None]
    v = pixels[..., 1].clamp(0, H - 1)[..., None]
    along_u = (1 - (u - here[0, 0]).abs()).clamp(min=0)  # ..., W
    along_v = (1 - (v - here[1, :, 0]).abs()).clamp(min=0)  # ..., H
    return along_v[..., :, None] * along_u[..., None, :]


def expected_pixels(maps: torch.Tensor) -> torch.Tensor:
    """Return the mean position (..., 2), (u, v), under each map (..., H, W) that sums to 1."""
    H, W = maps.shape[-2:]
    here, _ = _pixels(H, W, maps.dtype, maps.device)
    u = maps.sum(-2) @ here[0, 0]
    v = maps.sum(-1) @ here[1, :, 0].contiguous()
    return torch.stack([u, v], -1)


def warp_object_maps(maps: torch.Tensor, flow: torch.Tensor,
                     masks: torch.Tensor) -> WarpedMaps:
    """
    Find where a prediction puts each object, by its own flow and masks (appendix E).

    p = sum over c of mask_c * warp(map_c, flow_c), divided by its sum. A map that loses nearly
    all its mass (the flow jumps over the object's pixel) is blurred by one pixel before warping;
    if that does not help, the object is where the first keyframe that has it shows it, keyframes
    being after start and goal; else it is the mask-weighted mixture of the maps where they were,
    and if the masks hide these too, their plain mean.

    :param maps: (B, C, K, H, W), maps in each context picture, each summing to 1; those of start
        and goal. In a keyframe of another demonstration also 0: nothing is known of the object.
    :param flow: (B, C or more, 2, H, W) in pixels.
    :param masks: (B, C or more, 1, H, W). What comes after the first C is left out: new pixels
        have no origin, and where objects are in a keyframe may not be known. The mass tells how
        much of an object is copied from where it is known.
    :return: WarpedMaps.
    """
    flow, masks = flow[:, :maps.shape[1]], masks[:, :maps.shape[1]]
    warped = combine(warp(maps, flow), masks)  # B, K, H, W
    kept = mass = warped.sum((-2, -1))
    if bool((lost := mass < MIN_MASS).any()):
        b, k = lost.nonzero(as_tuple=True)
        warped[b, k] = _found(maps[b, :, k], flow[b], masks[b])
        kept = warped.sum((-2, -1))
    return WarpedMaps(warped / kept[..., None, None], mass)


def _found(maps: torch.Tensor, flow: torch.Tensor, masks: torch.Tensor) -> torch.Tensor:
    """Say where N objects are, (N, H, W), whose maps (N, C, H, W) got lost in the warp."""
    maps = maps[:, :, None]
    candidates = [combine(warp(blur(maps), flow), masks), *maps[:, 2:].unbind(1),
                  combine(maps, masks), maps.mean(1)]
    found = candidates[-1]
    for candidate in reversed(candidates[:-1]):
        kept = candidate.sum((-2, -1), keepdim=True) >= MIN_MASS
        found = torch.where(kept, candidate, found)
    return found[:, 0]


def blur(maps: torch.Tensor) -> torch.Tensor:
    """Blur maps (..., H, W) by a Gaussian of one pixel; at the border mass stays inside."""
    for dim in (-1, -2):
        at = torch.arange(maps.shape[dim], device=maps.device, dtype=maps.dtype)
        kernel = torch.exp(-((at[:, None] - at) ** 2) / 2)
        kernel = kernel / kernel.sum(0)  # column: how the mass of one pixel is shared out
        maps = (maps.transpose(dim, -1) @ kernel.T).transpose(dim, -1)
    return maps
