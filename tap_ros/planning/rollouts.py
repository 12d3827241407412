# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Many action sequences along which the forward model carries the objects, as fast as it can."""

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from functools import partial
import math
import os
import time
from typing import Any

import numpy as np
from tap_ros.base.contract import LOW
from tap_ros.planning.cost import PlanCost
from tap_ros.planning.protocols import ForwardModel
import torch


class TimeLimit:
    """
    Lets the parts of a search begin that will end in time, judged by the longest so far.

    :param seconds: from now on.
    :ivar over: whether a part was left out.
    """

    def __init__(self, seconds: float = math.inf) -> None:
        self._end, self._longest, self.over = time.perf_counter() + seconds, -math.inf, False

    def run(self, part: Callable[[], Any]) -> Any:
        """Return what a part returns, None if it is left out; those are run that begin at once."""
        begin = time.perf_counter()
        if self.over or begin + self._longest > self._end:
            self.over = True
            return None
        found = part()
        self._longest = max(self._longest, time.perf_counter() - begin)
        return found


@dataclass(frozen=True)
class Start:
    """What all sequences of a plan begin with."""

    maps: torch.Tensor  # (K, n, n) of the objects now
    features: Any  # from ForwardModel.begin
    limit: TimeLimit = field(default_factory=TimeLimit)


class Rollouts:
    """
    Carries object maps along action sequences and says what these cost.

    :param model: ForwardModel; cost: PlanCost.
    :param batch_size: sequences predicted at once, at most.
    :param threads: on the CPU; 0: as many as there are cores. Each computes alone: so the bits
        of a plan do not depend on how many threads torch is given.
    """

    def __init__(self, model: ForwardModel, cost: PlanCost, batch_size: int,
                 threads: int = 0) -> None:
        self.model, self.cost, self.batch_size = model, cost, batch_size
        # Each thread predicts whole batches: operators split among threads would wait for each
        # other at every one of some thousand small steps, and for anything else that runs.
        self._pool = ThreadPoolExecutor(
            (threads or len(os.sched_getaffinity(0))) if model.table.device.type == 'cpu' else 1,
            initializer=torch.set_num_threads, initargs=(1,))

    def compute(self, function: Callable[..., Any], *args: Any) -> Any:
        """Return what a function of tensors returns, computed in one of the threads."""
        return self._pool.submit(torch.inference_mode()(function), *args).result()

    def judge(self, start: Start, prices: torch.Tensor, actions: np.ndarray,
              grippers: np.ndarray, every: int) -> tuple[np.ndarray, np.ndarray]:
        """
        Judge action sequences by PlanCost.of_maps.

        :param start: Start; what its limit leaves out is NaN.
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
            carried = self.model.carried_maps(
                start.features, grippers, start.maps, actions, every)
            costs, ends = self.cost.of_maps(carried, prices)
            return costs[:count], ends[:count]

        # together with others that come down as late: up there, nothing needs to be predicted
        heights = grippers[:, 2:3] + actions[..., 2].cumsum(1)
        order = np.argsort((heights > LOW + 0.01).sum(1), kind='stable')
        back = np.argsort(order)
        parts = list(zip(*(torch.from_numpy(values[order]).to(prices.device).split(size)
                           for values in (actions, grippers))))
        # the part of the last sequence first: solvers put proposals there, such as the last plan
        queue = sorted(range(len(parts)), key=lambda i: i != back[-1] // size)
        running = {i: self._pool.submit(start.limit.run, partial(judge, *parts[i])) for i in queue}
        found = [running[i].result() or prices.new_full((2, len(part[0])), torch.nan).unbind()
                 for i, part in enumerate(parts)]
        costs, ends = to_numpy(*map(torch.cat, zip(*found)))
        # rounded so that the batch size, which moves the last bits, cannot change the ranking
        return costs[back].astype(np.float64).round(2), ends[back]


def to_numpy(*tensors: torch.Tensor) -> list[np.ndarray]:
    """Bring tensors of one type to numpy in one trip, for each of which a GPU would wait."""
    joined = torch.cat([tensor.flatten() for tensor in tensors]).cpu().numpy()
    ends = np.cumsum([tensor.numel() for tensor in tensors])
    return [part.reshape(tensor.shape) for part, tensor in zip(np.split(joined, ends), tensors)]
