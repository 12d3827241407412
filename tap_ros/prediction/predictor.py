# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The trained predictor: arrays in, arrays out."""

from dataclasses import dataclass

import numpy as np
from tap_ros.errors import ConfigError, ImageError
from tap_ros.images import check_image, to_float, to_uint8
from tap_ros.prediction.networks import Predictor, PredictorConfig
from tap_ros.prediction.warp import expected_pixels, one_hot_maps, warp_object_maps
from tap_ros.prediction.weights import load_into, load_weights, make_config
import torch


@dataclass(frozen=True)
class Subgoal:
    """
    A predicted frame on the way to the goal.

    :param image: uint8 (H, W, 3).
    :param object_maps: float32 (K, H, W), each sums to 1: where each object should then be.
    :param expected_pixels: float32 (K, 2), the mean (u, v) under each map.
    :param mass: float32 (K,), what each map summed to before normalising; far from 1 the map
        is doubtful (warp.WarpedMaps).
    """

    image: np.ndarray
    object_maps: np.ndarray
    expected_pixels: np.ndarray
    mass: np.ndarray


class SubgoalPredictor:
    """
    Predict the bottleneck between a start and a goal picture.

    :ivar config: PredictorConfig.
    :ivar image_size: (height, width) of the pictures it takes.
    :ivar num_context: pictures it is conditioned on, 2.
    :ivar training: dict saying how the weights were made.
    """

    def __init__(self, network, training=None):
        """
        Take a network into service, and run it once so that the first request is not slow.

        :param network: Predictor, on the device it shall run on.
        :param training: dict saying how the weights were made.
        :raises ConfigError: if it does not take a start and a goal picture.
        """
        if network.config.num_context != 2:
            raise ConfigError(f'predictor: needs weights for 2 context pictures, start and goal; '
                              f'these are for {network.config.num_context}')
        self.config = network.config
        self.num_context = network.config.num_context
        self.image_size = (network.config.image_size, network.config.image_size)
        self.training = training or {}
        self._network = network.eval().requires_grad_(False)
        self._device = next(network.parameters()).device
        blank = np.zeros((*self.image_size, 3), np.uint8)
        self.predict(blank, blank, np.zeros((1, 2)), np.zeros((1, 2)))

    @classmethod
    def load(cls, path, device='cpu'):
        """
        Load a weights file.

        :param path: written by training.
        :param device: where to run it.
        :return: SubgoalPredictor.
        :raises WeightsError: if the file is missing, damaged or for something else.
        """
        return cls(*load_network(path, device))

    @torch.inference_mode()
    def predict(self, start, goal, start_pixels=None, goal_pixels=None, num_samples=1,
                recursion_depth=1, seed=0):
        """
        Predict subgoals.

        Recursive prediction (section 3.1) puts each further one between the start and the one
        predicted before, and follows the objects through the maps.

        :param start: uint8 (H, W, 3).
        :param goal: uint8 (H, W, 3).
        :param start_pixels: (K, 2) object positions (u, v) in the start picture; None: K = 0.
        :param goal_pixels: (K, 2), of the same objects in the goal picture.
        :param num_samples: how many z to draw; weights without z predict one subgoal whatever
            this says, for all samples would be the same.
        :param recursion_depth: how many subgoals in a row, at least 1.
        :param seed: of z.
        :return: list of Subgoal; each sample's subgoals follow each other, earliest first.
        :raises ImageError: if a picture has the wrong type or size, or a position is unusable.
        :raises ConfigError: if num_samples or recursion_depth is below 1.
        """
        for name, value in (('num_samples', num_samples), ('recursion_depth', recursion_depth)):
            if value < 1:
                raise ConfigError(f'{name}: expected at least 1, got {value}')
        check_image(start, 'start', self.image_size)
        check_image(goal, 'goal', self.image_size)
        start_pixels = check_pixels(start_pixels, 'start_pixels')
        goal_pixels = check_pixels(goal_pixels, 'goal_pixels')
        if len(start_pixels) != len(goal_pixels):
            raise ImageError(f'goal_pixels: expected {len(start_pixels)} objects as in '
                             f'start_pixels, got {len(goal_pixels)}')
        if not self.config.latent_size:
            num_samples = 1
        N = num_samples
        generator = torch.Generator().manual_seed(seed)
        images = to_float(np.stack([start, goal])).to(self._device).expand(N, -1, -1, -1, -1)
        pixels = torch.from_numpy(np.stack([start_pixels, goal_pixels])).to(self._device)
        maps = one_hot_maps(pixels, self.image_size).expand(N, -1, -1, -1, -1)  # N, 2, K, H, W
        subgoals = []
        for _ in range(recursion_depth):
            z = None
            if self.config.latent_size:
                z = torch.randn(N, self.config.latent_size, generator=generator).to(self._device)
            prediction = self._network(images, z)
            warped = warp_object_maps(maps, prediction.flow, prediction.masks)
            subgoals.insert(0, _to_subgoals(prediction.image, warped))
            # The prediction is the goal of the next level.
            images = torch.stack([images[:, 0], prediction.image.clamp(-1, 1)], 1)
            maps = torch.stack([maps[:, 0], warped.maps], 1)
        return [subgoals[r][n] for n in range(N) for r in range(recursion_depth)]


def load_network(path, device='cpu'):
    """
    Load the network of a weights file, in eval mode.

    :param path: written by training.
    :param device: where to run it.
    :return: (Predictor, dict saying how the weights were made).
    :raises WeightsError: if the file is missing, damaged or for something else.
    """
    values, state, training = load_weights(path, 'predictor')
    network = Predictor(make_config(PredictorConfig, values, path))
    load_into(network, state, path)
    network.eval().requires_grad_(False)
    return network.to(device, memory_format=torch.channels_last), training


def check_pixels(pixels, name):
    """
    Accept object positions or say what is wrong with them.

    :param pixels: (K, 2) numbers in (u, v) order, or None for no objects.
    :param name: how the message calls them.
    :return: float32 (K, 2).
    :raises ImageError: for another shape, or positions that are not finite.
    """
    if pixels is None:
        return np.zeros((0, 2), np.float32)
    pixels = np.asarray(pixels, np.float32)
    if pixels.size == 0:
        return np.zeros((0, 2), np.float32)
    if pixels.ndim != 2 or pixels.shape[1] != 2:
        raise ImageError(f'{name}: expected shape (objects, 2), got {pixels.shape}')
    unknown = np.flatnonzero(~np.isfinite(pixels).all(1))
    if len(unknown):
        raise ImageError(f'{name}: the position of object {unknown[0]} is unknown (not finite); '
                         'give (u, v) in pixels for every object, or leave that object out')
    return pixels


def _to_subgoals(images, warped):
    """Turn N predictions into Subgoals."""
    images = to_uint8(images)
    maps, mass = warped.maps.cpu().numpy(), warped.mass.cpu().numpy()
    positions = expected_pixels(warped.maps).cpu().numpy()
    return [Subgoal(*parts) for parts in zip(images, maps, positions, mass)]
