# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The command `train predictor`, and its option --choose, see trials.py."""

from dataclasses import dataclass

from tap_ros.prediction import training_config


@dataclass(frozen=True, kw_only=True)
class Options(training_config.Options):
    """
    Options of the command `train predictor`.

    :param choose: train each selection for a short time instead, and write a page, choose.html,
        with what they predict for held-out demonstrations and the commands that train them.
    """

    choose: bool = False


defaults = training_config.defaults


def run(args: Options) -> None:
    """Train; or with --choose try the selections, see trials.run."""
    if not args.choose:
        training_config.run(args)
        return
    from tap_ros.evaluation import trials  # torch takes seconds, --help does without
    trials.run(args)
