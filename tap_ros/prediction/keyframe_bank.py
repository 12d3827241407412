# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
A bank of keyframes: what demonstrations showed at the bottleneck, to be copied from.

A network for more than two pictures is given start, goal, and keyframes of the demonstrations
whose start and goal are most alike, as no hand at the object is in the first two; not in the
paper. With recursion each level has keyframes of its own. The bank is part of the weights file:
of each demonstration small pictures of start and goal, keyframes as PNGs, and where its objects
are in them, where the recordings tell.
"""

from collections.abc import Callable
from pathlib import Path
from typing import Self

import numpy as np
from tap_ros.base.contract import MOST_LEVELS
from tap_ros.base.errors import ConfigError, ImageError, WeightsError
from tap_ros.base.text import escaped
from tap_ros.images.drawing import png_bytes
from tap_ros.images.encodings import decompress
from tap_ros.images.pixels import resize_image, to_float, to_uint8
from tap_ros.prediction.retrieval import (
    ends_of,
    EQUAL,
    LARGEST_WEIGHT,
    nearest_others,
    pad_columns,
    places_then,
    SIDE,
    spread_out,
    unlike,
    usual_distance,
)
from tap_ros.prediction.warp import one_hot_maps
import torch

MOST = 64  # demonstrations
MOST_OBJECTS = 32  # whose places are kept
FARTHEST = 1e6  # px from the picture's corner that a known place may be
NOWHERE = -FARTHEST  # in a file: unknown
MOST_BYTES = 2**28  # of all of them together, as rgb
_PREFIX = 'bank.'
_ENDS, _KEYFRAME, _OBJECTS, _WEIGHTS = (
    _PREFIX + name for name in ('ends', 'keyframe.', 'objects', 'weights'))


class KeyframeBank:
    """
    Keyframes of demonstrations, and which of them goes with a start and a goal; never changed.

    :param ends: uint8 (N, 2, SIDE, SIDE, 3), start and goal of each, see retrieval.ends_of.
    :param files: N * L pictures of one size, as PNG: of each demonstration one for each level of
        recursion.
    :param objects: float32 (N, 1 + L, K, 2), (u, v) of objects in the start and the keyframes, in
        pixels of the network; NaN where unknown. None: nothing is known.
    :param weights: int32 (2, SIDE, SIDE), of the pixels of start and goal, see retrieval.nearest.
    :raises ConfigError: for none, too many, or as many of one as not of the others, for places
        beyond FARTHEST, and for weights that are none.
    :raises ImageError: for pictures that are damaged, too large together, or differ in size.
    :ivar keyframes: N * L pictures uint8 (H, W, 3), at the recorded size.
    :ivar levels: L.
    """

    def __init__(self, ends: np.ndarray, files: list[bytes],
                 objects: np.ndarray | None = None, weights: np.ndarray = EQUAL) -> None:
        N, self.levels = len(ends), len(files) // max(1, len(ends))
        if ends.dtype != np.uint8 or ends.shape != (N, 2, SIDE, SIDE, 3) or not (
                1 <= N <= MOST and 1 <= self.levels <= MOST_LEVELS
                and len(files) == N * self.levels):
            raise ConfigError(f'expected 1 to {MOST} of them, and of each a start and a goal of '
                              f'{SIDE}x{SIDE} pixels')
        if objects is not None and (
                objects.dtype != np.float32 or objects.ndim != 4 or objects.shape[3] != 2
                or objects.shape[:2] != (N, 1 + self.levels)
                or objects.shape[2] > MOST_OBJECTS):
            raise ConfigError(f'expected places of at most {MOST_OBJECTS} objects in each')
        if objects is not None and np.abs(np.nan_to_num(objects)).max(initial=0) > FARTHEST:
            raise ConfigError(f'expected places of objects of at most {FARTHEST:.0f} pixels')
        if weights.dtype != np.int32 or weights.shape != EQUAL.shape or not (
                0 <= weights.min() and 0 < weights.max() <= LARGEST_WEIGHT):
            raise ConfigError(f'expected weights of pixels from 0 to {LARGEST_WEIGHT}, not all 0')
        self._ends, self._files, self._objects, self._weights = ends, files, objects, weights
        self.keyframes = [decompress(file, 'png', MOST_BYTES // len(files)) for file in files]
        if len({picture.shape for picture in self.keyframes}) > 1:
            raise ImageError('they differ in size')
        self._usual = usual_distance(ends)
        self._scaled: dict[tuple[int, ...], np.ndarray] = {}

    def __len__(self) -> int:
        """Return the number of demonstrations."""
        return len(self._ends)

    def __deepcopy__(self, memo: object) -> Self:
        """Return itself: copies of a network share it."""
        return self

    @classmethod
    def choose(cls, ends: np.ndarray, keyframe: Callable[[int], np.ndarray],
               objects: np.ndarray | None = None, levels: int = 1,
               weights: np.ndarray = EQUAL) -> Self:
        """
        Make a bank of the keyframes that cover all demonstrations best, as many as it may have.

        :param ends: uint8 (N, 2, SIDE, SIDE, 3) of all demonstrations, see retrieval.ends_of; of
            their start and goal pictures as the network is given them.
        :param keyframe: returns that of a number, uint8 (H, W, 3): of demonstration i the numbers
            i * levels and following; called for the chosen.
        :param objects: see KeyframeBank, of all demonstrations; weights: the same.
        :raises ImageError: see KeyframeBank.
        """
        most = max(1, min(MOST, MOST_BYTES // (levels * keyframe(0).nbytes)))
        chosen = spread_out(ends, most, weights)
        return cls(ends[chosen], [png_bytes(keyframe(i * levels + level))
                                  for i in chosen.tolist() for level in range(levels)],
                   None if objects is None else objects[chosen], weights)

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
            ends, objects = own.pop(_ENDS).numpy(), own.pop(_OBJECTS, None)
            weights = own.pop(_WEIGHTS).numpy() if _WEIGHTS in own else EQUAL
            files = [own.pop(f'{_KEYFRAME}{n}') for n in range(len(own))]
            if any(file.dtype != torch.uint8 or file.dim() != 1 for file in files):
                raise ConfigError('expected each as the bytes of a file')
            return cls(ends, [file.numpy().tobytes() for file in files],
                       None if objects is None else objects.where(
                           objects > NOWHERE, torch.nan).numpy(), weights)
        except (LookupError, TypeError, ConfigError, ImageError) as error:
            raise WeightsError(f'{escaped(path)}: its keyframes cannot be used: '
                               f'{escaped(error)}; copy it again, or train again') from error

    def tensors(self) -> dict[str, torch.Tensor]:
        """Return what a weights file holds of it, by name."""
        known = {} if self._objects is None else {
            _OBJECTS: torch.from_numpy(self._objects).nan_to_num(NOWHERE)}
        return {_ENDS: torch.from_numpy(self._ends), **known,
                _WEIGHTS: torch.from_numpy(self._weights), **{
            f'{_KEYFRAME}{n}': torch.frombuffer(bytearray(file), dtype=torch.uint8)
            for n, file in enumerate(self._files)}}

    def scaled(self, size: tuple[int, ...]) -> np.ndarray:
        """Return the keyframes as a network sees them, uint8 (N * L, H, W, 3); size is (H, W)."""
        if size not in self._scaled:
            self._scaled[size] = np.stack([
                picture if picture.shape[:2] == size else resize_image(picture, size)
                for picture in self.keyframes])
        return self._scaled[size]

    def find(self, pictures: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
        """
        Find the most alike demonstrations, see retrieval.nearest_others.

        :param pictures: uint8 (B, 2, H, W, 3), start and goal as the network is given them.
        :param count: of demonstrations; where there are fewer, the last one is repeated.
        :return: indices int64 (B, count) by the weights, the nearest first, and distances (B,) of
            the nearest by equal weights, which tell what is unlike everywhere.
        """
        asked = np.stack([ends_of(*pair) for pair in pictures])
        indices, _ = nearest_others(asked, self._ends, count, self._weights)
        _, distances = nearest_others(asked, self._ends, 1)
        return pad_columns(indices, count), distances[:, 0]

    def unlike(self, distance: float) -> str:
        """Say that start and goal are unlike those of all demonstrations; '': they are not."""
        return unlike(distance, self._usual)

    def completed(self, context: torch.Tensor, count: int) -> torch.Tensor:
        """Return contexts (B, 2, 3, H, W) in [-1, 1] with count keyframes each behind them."""
        return self.beside(context, self.find(to_uint8(context), count)[0])

    def numbers(self, indices: np.ndarray, level: int = 1) -> np.ndarray:
        """Return which keyframes demonstrations (any shape) have at a level, from 1 on."""
        return indices * self.levels + min(level, self.levels) - 1

    def beside(self, context: torch.Tensor, indices: np.ndarray, level: int = 1) -> torch.Tensor:
        """Return contexts (B, 2, 3, H, W) with keyframes of demonstrations (B, n) behind them."""
        keyframes = self.scaled(tuple(context.shape[-2:]))[self.numbers(indices, level)]
        return torch.cat([context, to_float(keyframes).to(context.device)], 1)

    def beside_maps(self, maps: torch.Tensor, asked: np.ndarray, indices: np.ndarray,
                    level: int = 1) -> torch.Tensor:
        """
        Add where objects are in the keyframes; those of which nothing is known are nowhere.

        :param maps: (B, 2, K, H, W), in start and goal.
        :param asked: (B, K, 2), (u, v) in the start; see retrieval.places_then.
        :param indices: demonstrations (B, n).
        :return: (B, 2 + n, K, H, W); the same as given where nothing is known.
        """
        if self._objects is None:
            return maps
        places = torch.from_numpy(np.stack([
            [places_then(known[0], known[min(level, self.levels)], pixels) for known in each]
            for pixels, each in zip(asked, self._objects[indices])]))
        more = one_hot_maps(places.nan_to_num(), maps.shape[-2:])
        more *= places.isfinite().all(-1)[..., None, None]
        return torch.cat([maps, more.to(maps.device)], 1)
