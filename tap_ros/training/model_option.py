# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The option of `python -m tap_ros train` that says what is trained."""

from dataclasses import dataclass
from typing import Literal


@dataclass(frozen=True, kw_only=True)
class ModelOption:
    """
    What is trained.

    :param model: the predictor, or the forward model of the planner; with --help beside it, its
        options. To predict from the start alone is --mode forward of the predictor.
    """

    model: Literal['predictor', 'forward'] = 'predictor'
