# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The options of commands that run many tasks."""

from dataclasses import dataclass
from typing import Annotated

from tap_ros.engines.task import Engine, EngineName
from tap_ros.options import default_text
from tyro import conf


@dataclass(frozen=True)
class EngineOptions(Engine):
    """Where the tasks run."""

    name: Annotated[EngineName, conf.arg(name='engine')] = Engine.name
    workers: Annotated[int, conf.arg(aliases=('--jobs',), metavar='N')] = Engine.workers
    address: Annotated[str, conf.arg(
        metavar='HOST:PORT', help_behavior_hint=default_text)] = Engine.address
