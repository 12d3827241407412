# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Predictions at the size of the pictures that were sent, by a network that sees smaller ones.

The network says where each pixel comes from. Its flow and masks, enlarged, read the pictures as
they were sent, so what is copied stays as sharp as the camera; not in the paper. On a CPU, in 8
bits: about 10 ms more for 640x480 on one core.
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import cv2
import numpy as np
from tap_ros.images.crop import TrainedCrop
from tap_ros.images.pixels import check_pixels, resize_image, resize_pixels, to_uint8
from tap_ros.prediction.networks import Prediction
from tap_ros.prediction.protocol import Request

LEAST = 1e-6  # of a mask
STEEPER = 1.5  # edges of enlarged masks; nearer to the truth than 1 in pushing, stacking, grasping


def pictures_of(request: Request) -> list[np.ndarray]:
    """Return the pictures of a request in the order of the context: start, and goal if any."""
    return [request.start] if request.goal is None else [request.start, request.goal]


def fit(request: Request, crop: TrainedCrop) -> Request:
    """
    Make larger pictures as small as a network takes them, and move positions along.

    :param request: of any pictures; what cannot be used stays as it is.
    :param crop: of the network; which sizes it says are cut already are made smaller.
    :return: a Request; the same where nothing is larger.
    :raises ImageError: for positions that are unusable.
    """
    changes: dict[str, Any] = {}
    for name in ('start', 'goal'):
        picture = getattr(request, name)
        if not isinstance(picture, np.ndarray) or picture.dtype != np.uint8 or (
                picture.ndim != 3 or picture.shape[2] != 3 or picture.shape[:2] == crop.size
                or not crop.is_cut(picture.shape[:2])):
            continue
        changes[name] = resize_image(picture, crop.size)
        places = getattr(request, key := f'{name}_pixels')
        if places is not None:
            changes[key] = resize_pixels(check_pixels(places, key), picture.shape[:2], crop.size)
    return replace(request, **changes) if changes else request


def answer_size(pictures: Sequence[np.ndarray]) -> tuple[int, int]:
    """Return (height, width) of the answer to pictures: that of the largest."""
    return max(picture.shape[:2] for picture in pictures)


def enlarged(prediction: Prediction, sources: Sequence[Sequence[np.ndarray]],
             sizes: Sequence[tuple[int, int]]) -> list[np.ndarray]:
    """
    Return predictions as pictures, of the sizes that are wanted.

    :param prediction: of B rows, (h, w) pixels.
    :param sources: of each row the C pictures of its context, uint8 (H, W, 3), as they were sent.
    :param sizes: of each row (height, width) of the answer; of (h, w) it is the prediction itself.
    :return: B pictures, uint8 (height, width, 3).
    """
    size, small = tuple(prediction.image.shape[-2:]), to_uint8(prediction.image)
    return [small[b] if wanted == size else _enlarged(prediction, b, pictures, wanted)
            for b, (pictures, wanted) in enumerate(zip(sources, sizes))]


def _enlarged(prediction: Prediction, b: int, sources: Sequence[np.ndarray],
              size: tuple[int, int]) -> np.ndarray:
    """Return the prediction in row b at a size; see enlarged."""
    flows = prediction.flow[b].cpu().numpy()  # C, 2, h, w
    # Before their softmax masks have less of an edge to blur: C or C + 1, h, w.
    logits = STEEPER * prediction.masks[b, :, 0].clamp(min=LEAST).log().cpu().numpy()
    masks = [cv2.exp(_wide(one, size)) for one in logits]
    layers = [_read(source, flow, size) for source, flow in zip(sources, flows, strict=True)]
    if prediction.new_pixels is not None:
        new = to_uint8(prediction.new_pixels[b])
        layers.append(np.asarray(cv2.resize(new, size[::-1], interpolation=cv2.INTER_CUBIC)))
    image, weight = layers[0], masks[0]
    for layer, share in zip(layers[1:], masks[1:], strict=True):
        # This divides by the sum of the weights.
        image = np.asarray(cv2.blendLinear(image, layer, weight, share))
        weight = weight + share
    return image


def _wide(values: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """Enlarge (h, w) bilinearly, the outermost values reaching to the border."""
    return np.asarray(cv2.resize(values, size[::-1], interpolation=cv2.INTER_LINEAR))


def _read(source: np.ndarray, flow: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """
    Read each pixel of a picture of a size where the flow points to in another, bilinearly.

    :param source: uint8 (H, W, 3), of any size; positions outside read its border.
    :param flow: float32 (2, h, w) in pixels of the network, (du, dv).
    :return: uint8 (height, width, 3).
    """
    (H, W), (_, h, w), (height, width) = source.shape[:2], flow.shape, size
    u, v = (_wide(one, size) for one in flow)
    u *= W / w  # in place, as new arrays cost page faults
    v *= H / h
    u += (np.arange(width, dtype=np.float32) + 0.5) * (W / width) - 0.5
    v += ((np.arange(height, dtype=np.float32) + 0.5) * (H / height) - 0.5)[:, None]
    # To 1/32 px, which takes two thirds of the time of floats.
    maps = cv2.convertMaps(u, v, cv2.CV_16SC2)
    return np.asarray(
        cv2.remap(source, *maps, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE))
