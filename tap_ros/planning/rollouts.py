# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Judge many action sequences at once: in even batches, on several threads or on a GPU."""

from concurrent.futures import ThreadPoolExecutor
import os
from typing import Any

import numpy as np
from tap_ros.contract import LOW
from tap_ros.planning.cost import PlanCost
from tap_ros.planning.protocols import ForwardModel
import torch


class Rollouts:
    """
    Carries object maps along action sequences and says what these cost.

    :param model: ForwardModel; cost: PlanCost.
    :param batch_size: sequences predicted at once, at most.
    :param threads: on the CPU; 0: as many as there are cores.
    """

    def __init__(self, model: ForwardModel, cost: PlanCost, batch_size: int,
                 threads: int = 0) -> None:
        self.model, self.cost, self.batch_size = model, cost, batch_size
        # Each thread predicts whole batches: operators split among threads would wait for each
        # other at every one of some thousand small steps, and for anything else that runs.
        self._pool = ThreadPoolExecutor(
            (threads or len(os.sched_getaffinity(0))) if model.table.device.type == 'cpu' else 1,
            initializer=torch.set_num_threads, initargs=(1,))

    def judge(self, start: Any, maps: torch.Tensor, prices: torch.Tensor, actions: np.ndarray,
              grippers: np.ndarray, every: int) -> tuple[np.ndarray, np.ndarray]:
        """
        Judge action sequences by PlanCost.of_maps.

        :param start: from ForwardModel.begin; maps (K, n, n) of the objects now.
        :param prices: (K, n n) px, of an object in each table cell.
        :param actions: numpy (N, HORIZON, 4); grippers (N, 4), where each sequence begins.
        :param every: look at the maps after every so many steps.
        :return: numpy costs (N,) float64, rounded to 0.01 px; prices at the end (N,).
        """
        size = -(-len(actions) // -(-len(actions) // self.batch_size))  # as even as can be

        @torch.inference_mode()
        def judge(actions: torch.Tensor,
                  grippers: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
            count = len(actions)  # the last part is filled up: all go the same way
            actions, grippers = (torch.cat([t, t[-1:].expand(size - count, *t.shape[1:])])
                                 for t in (actions, grippers))
            carried = self.model.carried_maps(start, grippers, maps, actions, every)
            costs, ends = self.cost.of_maps(carried, prices)
            return costs[:count], ends[:count]

        # together with others that come down as late: up there, nothing needs to be predicted
        heights = grippers[:, 2:3] + actions[..., 2].cumsum(1)
        order = np.argsort((heights > LOW + 0.01).sum(1), kind='stable')
        parts = [torch.from_numpy(values[order]).to(prices.device).split(size)
                 for values in (actions, grippers)]
        costs, ends = to_numpy(*map(torch.cat, zip(*self._pool.map(judge, *parts))))
        back = np.argsort(order)
        # rounded so that the batch size, which moves the last bits, cannot change the ranking
        return costs[back].astype(np.float64).round(2), ends[back]


def to_numpy(*tensors: torch.Tensor) -> list[np.ndarray]:
    """Bring tensors of one type to numpy in one trip, for each of which a GPU would wait."""
    joined = torch.cat([tensor.flatten() for tensor in tensors]).cpu().numpy()
    ends = np.cumsum([tensor.numel() for tensor in tensors])
    return [part.reshape(tensor.shape) for part, tensor in zip(np.split(joined, ends), tensors)]
