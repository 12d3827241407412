# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
A bank of keyframes: what demonstrations showed at the bottleneck, to be copied from.

A network for three pictures is given start, goal, and the keyframe of the demonstration whose
start and goal are most alike, as no hand at the object is in the first two; not in the paper. The
bank is part of the weights file: small pictures of start and goal, and the keyframe as a PNG.
"""

from collections.abc import Callable
from pathlib import Path
from typing import Self

import numpy as np
from tap_ros.base.errors import ConfigError, ImageError, WeightsError
from tap_ros.base.text import escaped
from tap_ros.images.drawing import png_bytes
from tap_ros.images.encodings import decompress
from tap_ros.images.pixels import resize_image, to_float, to_uint8
from tap_ros.prediction.retrieval import (
    ends_of,
    nearest_others,
    SIDE,
    spread_out,
    unlike,
    usual_distance,
)
import torch

MOST = 64  # keyframes
MOST_BYTES = 2**28  # of all of them together, as rgb
_PREFIX = 'bank.'
_ENDS, _KEYFRAME = f'{_PREFIX}ends', f'{_PREFIX}keyframe.'


class KeyframeBank:
    """
    Keyframes of demonstrations, and which of them goes with a start and a goal; never changed.

    :param ends: uint8 (N, 2, SIDE, SIDE, 3), start and goal of each, see retrieval.ends_of.
    :param files: N pictures of one size, as PNG.
    :raises ConfigError: for none, more than MOST, or as many of one as not of the other.
    :raises ImageError: for pictures that are damaged, too large together, or differ in size.
    :ivar keyframes: N pictures uint8 (H, W, 3), at the recorded size.
    """

    def __init__(self, ends: np.ndarray, files: list[bytes]) -> None:
        if ends.dtype != np.uint8 or ends.shape != (len(files), 2, SIDE, SIDE, 3) or not (
                1 <= len(files) <= MOST):
            raise ConfigError(f'expected 1 to {MOST} of them, and of each a start and a goal of '
                              f'{SIDE}x{SIDE} pixels')
        self._ends, self._files = ends, files
        self.keyframes = [decompress(file, 'png', MOST_BYTES // len(files)) for file in files]
        if len({picture.shape for picture in self.keyframes}) > 1:
            raise ImageError('they differ in size')
        self._usual = usual_distance(ends)
        self._scaled: dict[tuple[int, ...], np.ndarray] = {}

    def __len__(self) -> int:
        """Return the number of keyframes."""
        return len(self._files)

    def __deepcopy__(self, memo: object) -> Self:
        """Return itself: copies of a network share it."""
        return self

    @classmethod
    def choose(cls, ends: np.ndarray, keyframe: Callable[[int], np.ndarray]) -> Self:
        """
        Make a bank of the keyframes that cover all demonstrations best, as many as it may have.

        :param ends: uint8 (N, 2, SIDE, SIDE, 3) of all demonstrations, see retrieval.ends_of; of
            their start and goal pictures as the network is given them.
        :param keyframe: returns that of a demonstration, uint8 (H, W, 3); called for the chosen.
        :raises ImageError: see KeyframeBank.
        """
        most = max(1, min(MOST, MOST_BYTES // keyframe(0).nbytes))
        chosen = spread_out(ends, most)
        return cls(ends[chosen], [png_bytes(keyframe(i)) for i in chosen.tolist()])

    @classmethod
    def take(cls, tensors: dict[str, torch.Tensor], path: str | Path) -> Self | None:
        """
        Take the bank out of what a weights file holds.

        :param tensors: of the file; those of the bank are removed.
        :return: None where there are none.
        :raises WeightsError: where they are not what `tensors` returns, or too much.
        """
        own = {name: tensors.pop(name) for name in list(tensors) if name.startswith(_PREFIX)}
        if not own:
            return None
        try:
            ends = own.pop(_ENDS).numpy()
            files = [own.pop(f'{_KEYFRAME}{n}') for n in range(len(own))]
            if any(file.dtype != torch.uint8 or file.dim() != 1 for file in files):
                raise ConfigError('expected each as the bytes of a file')
            return cls(ends, [file.numpy().tobytes() for file in files])
        except (LookupError, TypeError, ConfigError, ImageError) as error:
            raise WeightsError(f'{escaped(path)}: its keyframes cannot be used: '
                               f'{escaped(error)}; copy it again, or train again') from error

    def tensors(self) -> dict[str, torch.Tensor]:
        """Return what a weights file holds of it, by name."""
        return {_ENDS: torch.from_numpy(self._ends), **{
            f'{_KEYFRAME}{n}': torch.frombuffer(bytearray(file), dtype=torch.uint8)
            for n, file in enumerate(self._files)}}

    def scaled(self, size: tuple[int, ...]) -> np.ndarray:
        """Return the keyframes as a network sees them, uint8 (N, H, W, 3); size is (H, W)."""
        if size not in self._scaled:
            self._scaled[size] = np.stack([
                picture if picture.shape[:2] == size else resize_image(picture, size)
                for picture in self.keyframes])
        return self._scaled[size]

    def find(self, pictures: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """
        Find the keyframes of the most alike demonstrations, see retrieval.nearest_others.

        :param pictures: uint8 (B, 2, H, W, 3), start and goal as the network is given them.
        :return: indices int64 (B,), and distances (B,), see retrieval.
        """
        asked = np.stack([ends_of(*pair) for pair in pictures])
        indices, distances = nearest_others(asked, self._ends, 1)
        return indices[:, 0], distances[:, 0]

    def unlike(self, distance: float) -> str:
        """Say that start and goal are unlike those of all demonstrations; '': they are not."""
        return unlike(distance, self._usual)

    def completed(self, context: torch.Tensor) -> torch.Tensor:
        """Return contexts (B, 2, 3, H, W) in [-1, 1] with the keyframe as the third picture."""
        return self.beside(context, self.find(to_uint8(context))[0])

    def beside(self, context: torch.Tensor, indices: np.ndarray) -> torch.Tensor:
        """Return contexts (B, 2, 3, H, W) with the keyframes of indices (B,) as third pictures."""
        keyframes = self.scaled(tuple(context.shape[-2:]))[indices]
        return torch.cat([context, to_float(keyframes).to(context.device)[:, None]], 1)
