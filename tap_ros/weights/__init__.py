# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Where the shipped weights are, and their names."""

from collections.abc import Iterable
from pathlib import Path

from tap_ros.base.errors import ConfigError, WeightsError
from tap_ros.base.text import escaped, meant

_FOLDER = Path(__file__).parent
FORWARD_MODEL = _FOLDER / 'forward_model_push.safetensors'
PREDICTORS = {path.stem.removeprefix('predictor_'): path
              for path in sorted(_FOLDER.glob('predictor_*.safetensors'))}
PLANNING_TASKS = ('push2', 'push3', 'order2', 'order3')  # that the forward model is for
FORWARD_MODELS = dict.fromkeys(('push', *PLANNING_TASKS), FORWARD_MODEL)  # by name, and by task
DEFAULT_PREDICTOR = 'push2'


def find_predictor(text: str | Path, others: Iterable[str] = ()) -> Path:
    """
    Find weights of a predictor.

    :param text: name of shipped ones, such as 'push2', or a file; a file that has such a name can
        be given as './push2'.
    :param others: names that are valid where this is asked, for the message.
    :return: Path, of a file that need not exist.
    :raises WeightsError: for a bare word that is neither; it names the nearest and all names.
    """
    if (file := PREDICTORS.get(str(text))) is None:
        file = _file(text, PREDICTORS, others)
    return file


def find_forward_model(text: str | Path) -> Path:
    """
    Find weights of a forward model.

    :param text: 'push', the shipped one, or a task that it is for; or a file.
    :return: Path, of a file that need not exist.
    :raises WeightsError: for a bare word that is neither; it names the nearest and all names.
    :raises ConfigError: for the name of a predictor.
    """
    if (file := FORWARD_MODELS.get(str(text))) is None:
        if str(text) in PREDICTORS:
            raise ConfigError(f'weights: {text} is a subgoal predictor, for predictor_node; '
                              f'expected a forward model: a file, or {", ".join(FORWARD_MODELS)}')
        file = _file(text, FORWARD_MODELS)
    return file


def _file(text: str | Path, names: Iterable[str], others: Iterable[str] = ()) -> Path:
    """Return a file; WeightsError for a word that looks like a name and is none."""
    path, others = Path(text), list(others)
    if path.name == str(text) == path.stem and not path.exists():
        more = f', or NAME:ARGUMENT with NAME one of {", ".join(others)}' if others else ''
        raise WeightsError(f'{escaped(text)}: no such weights file; '
                           f'{meant(str(text), [*names, *others])}valid: {", ".join(names)}, a '
                           f'.safetensors file{more}')
    return path
