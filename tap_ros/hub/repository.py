# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
The Hub as huggingface_hub reaches it, its errors as one line, and the check of weights.

Which Hub, and with which token, is left to that library: HF_ENDPOINT, HF_TOKEN, `hf auth login`.
"""

from collections.abc import Iterator
from contextlib import contextmanager
import os
from pathlib import Path
import re
import sys
from typing import TYPE_CHECKING

from tap_ros.errors import ConfigError, HubError, TapError
from tap_ros.text import escaped

if TYPE_CHECKING:
    from huggingface_hub import HfApi

COMMIT = re.compile('[0-9a-f]{40}')
SUFFIX = '.safetensors'


def open_hub(repo: str) -> 'HfApi':
    """
    Make what talks to the Hub; nothing is sent yet.

    :param repo: name of a repository, checked here.
    :raises ConfigError: if no repository can have that name.
    :raises ModuleNotFoundError: where huggingface_hub is not installed.
    """
    os.environ.setdefault('HF_HUB_VERBOSITY', 'error')  # what fails in the end is said once
    from huggingface_hub import HfApi
    from huggingface_hub.utils import disable_progress_bars
    if not re.fullmatch(r'[\w.-]+/[\w.-]+', repo):
        raise ConfigError(f'REPO_ID {escaped(repo)}: expected OWNER/NAME')
    if not sys.stderr.isatty():
        disable_progress_bars()
    return HfApi()


@contextmanager
def hub_errors(repo: str, revision: str) -> Iterator[None]:
    """
    Turn what huggingface_hub raises, which has no base class, into one line.

    :param repo: name of the repository; revision: the branch or commit that was asked for.
    :raises HubError: for any error of the block but a TapError.
    """
    from huggingface_hub import constants, errors
    try:
        yield
    except TapError:
        raise
    except Exception as error:
        cause: BaseException = error
        while cause.__cause__ and not isinstance(cause, errors.HfHubHTTPError | ValueError):
            cause = cause.__cause__  # the library's own words are long, those of the system not
        said = str(cause)
        if isinstance(cause, errors.HfHubHTTPError):
            said = f'{cause.response.status_code} {cause.server_message or said}'
            advice = (f'correct the name or --revision {escaped(revision)}, or log in '
                      '(`hf auth login`, HF_TOKEN) as one who may do that')
        elif isinstance(cause, errors.OfflineModeIsEnabled):
            said, advice = 'HF_HUB_OFFLINE is set', 'unset it'
        else:
            advice = 'see whether the network is there and HF_ENDPOINT is right, then try again'
        said = ' '.join(said.split())
        raise HubError(f'{repo} at {constants.ENDPOINT}: {escaped(said, 300)}; '
                       f'{advice}') from error


def check_weights(path: Path) -> dict[str, object]:
    """
    Load a weights file as whoever uses it would.

    :param path: absolute, or with a suffix, so that it is no name of shipped weights.
    :return: what the file says of itself: kind, config, training.
    :raises WeightsError: if it is damaged, no weights file, or neither of a predictor nor of a
        forward model.
    """
    from tap_ros.planning.forward_model import LearnedForwardModel  # torch takes seconds
    from tap_ros.prediction.predictor import load_network
    from tap_ros.training.weights import load_tensors
    _, about = load_tensors(path)
    if about.get('kind') == 'forward_model':
        LearnedForwardModel.load(path)
    else:
        load_network(path)
    return about
