# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The command `python -m tap_ros train`: the options are the parts of TrainingConfig."""

from dataclasses import asdict, dataclass

from tap_ros.options import Bags, Folder
from tap_ros.prediction.training_config import (
    DataSettings,
    NetworkSettings,
    ObjectiveSettings,
    OptimizerSettings,
    RunSettings,
    TrainingConfig,
)
from tap_ros.recording.reading_options import ReadingOptions
from tap_ros.training.model_option import ModelOption


@dataclass(frozen=True)
class RunOptions(RunSettings):
    """Where the run happens and what it leaves."""

    recordings: Bags
    out: Folder


@dataclass(frozen=True, kw_only=True)
class Options(ModelOption):
    """Options of the command."""

    run: RunOptions
    reading: ReadingOptions = ReadingOptions()
    objective: ObjectiveSettings = ObjectiveSettings()
    data: DataSettings = DataSettings()
    network: NetworkSettings = NetworkSettings()
    optimizer: OptimizerSettings = OptimizerSettings()

    @property
    def config(self) -> TrainingConfig:
        """All of them as a TrainingConfig."""
        parts = (self.run, self.reading, self.objective, self.data, self.network,
                 self.optimizer)
        return TrainingConfig(**{
            name: value for part in parts for name, value in asdict(part).items()})


def run(args: Options) -> None:
    """Train as the command line says, and print where the weights are."""
    from tap_ros.prediction.training import train
    from tap_ros.training.parallel import local_rank  # torch takes seconds, --help does without
    weights = train(args.config)
    if not local_rank():
        print(weights)
