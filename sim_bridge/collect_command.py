# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The command `python -m tap_ros collect`."""

from dataclasses import dataclass
from typing import Annotated

from sim_bridge.collect import collect, CollectConfig, CollectSettings
from sim_bridge.tasks.tasks import task_names, TIMINGS
from sim_bridge.world.appearance import CHOICES
from sim_bridge.world.looks import LOOKS
from tap_ros.engines import Engine
from tap_ros.options import Folder, one_of
from tap_ros.plugins import names


@dataclass(frozen=True)
class Recording(CollectSettings):
    """What to collect."""

    task: Annotated[str, one_of(task_names())] = CollectSettings.task
    timing: Annotated[str, one_of(TIMINGS)] = CollectSettings.timing
    look: Annotated[str, one_of(LOOKS)] = CollectSettings.look
    appearance: Annotated[str, one_of(CHOICES)] = CollectSettings.appearance
    arm: Annotated[str, one_of(names('tap_ros.arms'))] = CollectSettings.arm


@dataclass(frozen=True)
class Options:
    """
    Options of the command.

    :param out: folder of the recording, say bags/push2; an interrupted collection goes on there.
    """

    out: Folder
    recording: Recording = Recording()
    engine: Engine = Engine()


def run(args: Options) -> None:
    """Collect and say what was collected."""
    result = collect(args.out, CollectConfig(**vars(args.recording)), args.engine)
    if not result['episodes']:
        print(f'{args.out}: all {args.recording.episodes} episodes were there already')
        return
    print(f"{args.out}: {result['episodes']} episodes, {result['frames']} frames in "
          f"{result['seconds']['wall']:.0f} s; objects end "
          f"{100 * result['mean_final_distance']:.1f} cm from their goals on average, "
          f"{result['success_rate']:.0%} of the episodes succeed")
