# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The trained predictor: arrays in, arrays out."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any, Self

import numpy as np
from tap_ros.base.errors import ConfigError, WeightsError
from tap_ros.base.text import escaped
from tap_ros.images.crop import trained_crop
from tap_ros.images.pixels import resize_pixels, to_float
from tap_ros.messages.subgoals import Subgoal
from tap_ros.prediction.fullsize import answer_size, enlarged, fit, pictures_of
from tap_ros.prediction.keyframe_bank import KeyframeBank
from tap_ros.prediction.networks import PredictorConfig, PredictorNetwork
from tap_ros.prediction.protocol import check_request, Predictor, Request
from tap_ros.prediction.warp import expected_pixels, one_hot_maps, warp_object_maps, WarpedMaps
from tap_ros.weights import find_predictor
from tap_ros.weights.devices import placed
from tap_ros.weights.weights import load_weights, make_network
import torch


class SubgoalPredictor(Predictor):
    """
    Predict the bottleneck between a start and a goal picture, or one to come after the start.

    :ivar config: PredictorConfig.
    :ivar image_size: (height, width) of the pictures that the network sees.
    :ivar mode: 'bidirectional' for two of them, also with a keyframe; 'forward' for one.
    :ivar training: dict saying how the weights were made.
    :ivar camera_crop: TrainedCrop: what to make of a camera's pictures before it sees them.
    """

    full_size = True

    def __init__(self, network: PredictorNetwork, training: dict[str, Any] | None = None,
                 source: str | Path = 'predictor') -> None:
        """
        Take a network into service, and run it once, so that the first request is not slow.

        :param network: PredictorNetwork, on the device it shall run on.
        :param training: dict saying how the weights were made.
        :param source: how errors call it, for example the file of its weights.
        :raises ConfigError: if it takes more than start and goal, and has no keyframes.
        :raises WeightsError: if it predicts nonsense.
        """
        if (network.bank is None) == (network.config.num_keyframes > 0):
            raise ConfigError('predictor: needs weights for 2 context pictures, start and goal, '
                              'for 1, the start, or for more with a bank of keyframes; these are '
                              f'for {network.config.num_context} with'
                              f'{"out" * (network.bank is None)} one')
        self.config = network.config
        self.mode = 'forward' if network.config.num_context == 1 else 'bidirectional'
        self.image_size = (network.config.image_size, network.config.image_size)
        self.training = training or {}
        self.camera_crop = trained_crop(self.training, self.image_size)
        self._network = network.eval().requires_grad_(False)
        self._device = next(network.parameters()).device
        grey = np.full((*self.image_size, 3), 128, np.uint8)
        pixels = np.array([[0.25, 0.25], [0.5, 0.5]], np.float32) * self.image_size[::-1]
        goal: dict[str, Any] = {}
        if self.mode == 'bidirectional':
            goal = {'goal': grey, 'goal_pixels': pixels}
        subgoal, = self.predict(grey, start_pixels=pixels, **goal)
        if not np.allclose(subgoal.object_maps.sum((1, 2)), 1, atol=1e-3):
            raise WeightsError(
                f'{escaped(source)}: predicts object maps that do not sum to 1; the weights are '
                'damaged or were not trained, train them again')

    @classmethod
    def load(cls, path: str | Path, device: torch.device | str = 'cpu') -> Self:
        """
        Load a weights file.

        :param path: name of shipped weights, such as 'push2', or a file written by training.
        :param device: where to run it, 'cpu' or 'cuda'.
        :return: SubgoalPredictor, with pictures of its image_size.
        :raises WeightsError: if the file is missing, damaged or for something else.
        """
        return cls(*load_network(path, device), source=path)

    @torch.inference_mode()
    def predict_together(self, requests: Sequence[Request]) -> list[list[Subgoal]]:
        """
        Answer several requests at once, which takes less time than one after the other.

        In recursive prediction (section 3.1) each prediction takes the place of the last context
        picture of the next one: of the goal, so that the next one lies between the start and it;
        or, forward, of the start, G(G(c)), so that the next one comes after it. The objects are
        followed through the maps. Each level of each sample has a z of its own; weights without z
        predict one sample, for all would be the same. Requests with equally many objects go
        through the network in one batch, where the last digits of an answer may differ from those
        of the request alone. Mind the memory: all their samples are held at once.

        :param requests: their fields are the arguments of predict.
        :return: for each what predict returns.
        :raises ImageError: if a picture has the wrong type or size, or a position is unusable.
        :raises ConfigError: if a count is below 1, or a goal is missing or too much.
        """
        scenes = [check_request(fit(request, self.camera_crop), self.mode, self.image_size)
                  for request in requests]
        alike: dict[int, list[int]] = {}  # number of objects: [index of a request]
        for index, (_, pixels) in enumerate(scenes):
            alike.setdefault(pixels.shape[1], []).append(index)
        answers: list[list[Subgoal]] = [[] for _ in requests]
        for chosen in alike.values():
            chosen.sort(key=lambda index: -requests[index].recursion_depth)
            found = self._predict([requests[i] for i in chosen], [scenes[i] for i in chosen])
            for index, subgoals in zip(chosen, found):
                answers[index] = subgoals
        return answers

    def _predict(self, requests: Sequence[Request],
                 scenes: Sequence[tuple[np.ndarray, np.ndarray]]) -> list[list[Subgoal]]:
        """Answer requests with equally many objects, the deepest recursion first."""
        latent_size = self.config.latent_size
        counts = [request.num_samples if latent_size else 1 for request in requests]
        generators = [torch.Generator().manual_seed(request.seed) for request in requests]
        context = _join([to_float(pictures).to(self._device).expand(N, -1, -1, -1, -1)
                         for N, (pictures, _) in zip(counts, scenes)])
        sources = [pictures_of(request) for N, request in zip(counts, requests) for _ in range(N)]
        sizes = [answer_size(pictures) for pictures in sources]
        said: list[dict[str, Any]] = [{} for _ in requests]
        if (bank := self._network.bank) is not None:  # the same demonstrations for all levels
            alike, distances = bank.find(np.stack([pictures for pictures, _ in scenes]),
                                         self.config.num_keyframes)
            said = [{'distance': distance, 'warning': bank.unlike(distance)}
                    for distance in distances.tolist()]
            alike = np.repeat(alike, counts, 0)
        places = np.repeat([pixels for _, pixels in scenes], counts, 0)  # rows, C, K, 2
        maps = one_hot_maps(torch.from_numpy(places).to(self._device), self.image_size)
        levels: list[list[list[Subgoal]]] = [[] for _ in requests]
        for level in range(1, max(request.recursion_depth for request in requests) + 1):
            # Those that go on are the first rows, since the deepest come first.
            going = sum(request.recursion_depth >= level for request in requests)
            rows = sum(counts[:going])
            context, maps = context[:rows], maps[:rows]
            z = None
            if latent_size:
                z = _join([torch.randn(N, latent_size, generator=generator) for N, generator in
                           zip(counts[:going], generators)]).to(self._device)
            shown, known, copied = context, maps, sources[:rows]
            if bank is not None:
                shown = bank.beside(context, alike[:rows], level)
                known = bank.beside_maps(maps, places[:rows, 0], alike[:rows], level)
                copied = [[*pictures, *(bank.keyframes[n] for n in numbers)]
                          for pictures, numbers in zip(copied, bank.numbers(alike, level))]
            prediction = self._network(shown, z)
            warped = warp_object_maps(known, prediction.flow, prediction.masks)
            images = enlarged(prediction, copied, sizes)
            found = _to_subgoals(images, warped, counts[:going], level, said)
            for subgoals, chain in zip(found, levels):
                chain.append(subgoals)
            # The prediction takes the place of the last picture that was sent.
            context = torch.cat([context[:, :-1], prediction.image.clamp(-1, 1)[:, None]], 1)
            maps = torch.cat([maps[:, :-1], warped.maps[:, None]], 1)
            sources = [[*pictures[:-1], image] for pictures, image in zip(sources, images)]
        if self.mode == 'bidirectional':
            for chain in levels:
                chain.reverse()  # each level lies before the one that it was predicted from
        return [[subgoals[n] for n in range(N) for subgoals in chain]
                for N, chain in zip(counts, levels)]


def load_network(path: str | Path,
                 device: torch.device | str = 'cpu') -> tuple[PredictorNetwork, dict[str, Any]]:
    """
    Load the network of a weights file, in eval mode.

    :param path: written by training, or the name of shipped weights, see weights.PREDICTORS.
    :param device: where to run it.
    :return: (PredictorNetwork, dict saying how the weights were made).
    :raises WeightsError: if the file is missing, damaged or for something else.
    """
    path = find_predictor(path)
    values, state, training = load_weights(path, 'predictor')
    bank = KeyframeBank.take(state, path)
    network = make_network(PredictorNetwork, PredictorConfig, values, state, path)
    if (bank is None) == (network.config.num_keyframes > 0):
        raise WeightsError(f'{escaped(path)}: weights for {network.config.num_context} pictures '
                           f'with{"out" * (bank is None)} a bank of keyframes, which those for '
                           'more than 2 have; train again')
    network.bank = bank
    network.eval().requires_grad_(False)
    return placed(network, device), training


def _join(parts: list[torch.Tensor]) -> torch.Tensor:
    """Join tensors along their first dimension; one alone stays as it is, to the memory format."""
    return parts[0] if len(parts) == 1 else torch.cat(parts)


def _to_subgoals(images: Sequence[np.ndarray], warped: WarpedMaps, counts: Sequence[int],
                 level: int, said: Sequence[dict[str, Any]]) -> list[list[Subgoal]]:
    """Turn the predictions of one level into Subgoals, counts[i] for request i, with said[i]."""
    maps, mass = warped.maps.cpu().numpy(), warped.mass.cpu().numpy()
    places = expected_pixels(warped.maps).cpu().numpy()
    rows = zip(images, maps, [resize_pixels(at, maps.shape[-2:], image.shape[:2])
                              for at, image in zip(places, images)], mass)
    return [[Subgoal(*next(rows), sample=n, level=level, **more) for n in range(N)]
            for N, more in zip(counts, said)]
