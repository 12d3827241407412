# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Where the shipped weights are, and their names."""

from pathlib import Path

_FOLDER = Path(__file__).parent
FORWARD_MODEL = _FOLDER / 'forward_model_push.safetensors'
PREDICTORS = {path.stem.removeprefix('predictor_'): path
              for path in sorted(_FOLDER.glob('predictor_*.safetensors'))}
DEFAULT_PREDICTOR = 'push2'


def find_predictor(text: str | Path) -> Path:
    """
    Find weights of a predictor.

    :param text: name of shipped ones, such as 'push2', or a file; a file that has such a name can
        be given as './push2'.
    :return: Path, of a file that need not exist.
    """
    return PREDICTORS.get(str(text), Path(text))
