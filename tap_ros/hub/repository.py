# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
The Hub as huggingface_hub reaches it, and its errors as one line.

Which Hub, and with which token, is left to that library: HF_ENDPOINT, HF_TOKEN, `hf auth login`.
"""

from collections.abc import Iterator
from contextlib import contextmanager
from http import HTTPStatus
import os
import re
import sys
from typing import TYPE_CHECKING

from tap_ros.errors import ConfigError, HubError, TapError
from tap_ros.text import escaped

if TYPE_CHECKING:
    from huggingface_hub import HfApi

COMMIT = re.compile('[0-9a-f]{40}')
SUFFIX = '.safetensors'
_LOG_IN = 'log in (`hf auth login`), or set HF_TOKEN'


def open_hub(repo: str) -> 'HfApi':
    """
    Make what talks to the Hub; nothing is sent yet.

    :param repo: name of a repository, checked here.
    :raises ConfigError: if no repository can have that name.
    :raises ModuleNotFoundError: where huggingface_hub is not installed.
    """
    os.environ.setdefault('HF_HUB_VERBOSITY', 'error')  # what fails in the end is said once
    from huggingface_hub import HfApi
    from huggingface_hub.errors import HFValidationError
    from huggingface_hub.utils import disable_progress_bars, validate_repo_id
    if not sys.stderr.isatty():
        disable_progress_bars()
    try:
        validate_repo_id(repo)
    except HFValidationError as error:
        raise ConfigError(f'REPO_ID: {_line(error)} Give OWNER/NAME') from error
    if '/' not in repo:
        raise ConfigError(f'REPO_ID {repo}: expected OWNER/NAME')
    return HfApi()


@contextmanager
def hub_errors(repo: str, revision: str) -> Iterator[None]:
    """
    Turn what huggingface_hub raises, which has no base class, into one line.

    :param repo: name of the repository; revision: the branch or commit that was asked for.
    :raises HubError: for any error of the block but a TapError.
    """
    from huggingface_hub import constants
    try:
        yield
    except TapError:
        raise
    except Exception as error:
        raise HubError(f'{repo} at {constants.ENDPOINT}: {_reason(error, revision)}') from error


def _reason(error: BaseException, revision: str) -> str:
    """Say what was wrong, and what would be right."""
    from huggingface_hub import errors
    while error.__cause__ and not isinstance(error, errors.HfHubHTTPError | ValueError):
        error = error.__cause__  # the library's own words are long, those of the system are not
    match error:
        case errors.OfflineModeIsEnabled():
            return 'HF_HUB_OFFLINE is set; unset it'
        case errors.GatedRepoError():
            return f'access has to be granted; ask for it on its page, then {_LOG_IN}'
        case errors.RepositoryNotFoundError():
            return ('no such repository, or it is private and not yours; correct the name, or '
                    + _LOG_IN)
        case errors.RevisionNotFoundError():
            return (f'has no branch or commit {escaped(revision)}; see its page for those that '
                    'it has, and correct --revision')
        case errors.HfHubHTTPError():
            return _refusal(error.response.status_code, _line(error.server_message or ''))
        case ValueError():
            return (f'{_line(error)} ({type(error).__name__}); correct what this names, or see '
                    'whether HF_ENDPOINT is a Hugging Face Hub')
    return (f'cannot be reached, or broke off ({_line(error)}); see whether the network is there '
            'and HF_ENDPOINT is right, then try again')


def _refusal(status: int, message: str) -> str:
    """Say what an HTTP status means here."""
    said = f'{status} {message or HTTPStatus(status).phrase}'
    match status:
        case HTTPStatus.UNAUTHORIZED:
            return f'no valid token was given ({said}); {_LOG_IN}'
        case HTTPStatus.FORBIDDEN:
            return (f'the token may not do that ({said}); use one with write permission, for a '
                    'repository of yours')
        case HTTPStatus.TOO_MANY_REQUESTS:
            return f'too many requests ({said}); wait some minutes, then try again'
        case _ if status >= HTTPStatus.INTERNAL_SERVER_ERROR:
            return f'the server failed ({said}); try again later'
    return f'refused ({said}); correct what this names'


def _line(text: object) -> str:
    """Return text of the library or of a server, fit for one line."""
    return escaped(' '.join(str(text).split()))
