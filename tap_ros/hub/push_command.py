# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The command `python -m tap_ros hub push`: weights and their model card in one commit."""

from dataclasses import dataclass
import hashlib
import json
import os
from pathlib import Path
import re
import shlex
from typing import Annotated, Any

from tap_ros.errors import ConfigError
from tap_ros.files import storage_errors
from tap_ros.hub.repository import check_weights, COMMIT, hub_errors, open_hub, SUFFIX
from tap_ros.options import default_text, Flag
from tap_ros.text import escaped
from tap_ros.weights import find_predictor, PREDICTORS
from tyro import conf

_PICTURE = re.compile(r'!\[[^]]*\]\(([\w.-]+)\)')  # in a card, of a file beside it
_PLAIN_CARD = """\
---
library_name: tap_ros
tags:
- robotics
- ros2
- safetensors
---
# {name}

Weights of a tap_ros {kind}. Nobody has written a model card; this is what the file says of itself.

```json
{about}
```
"""


@dataclass(frozen=True)
class Options:
    """
    Options of the command.

    :param weights: a .safetensors file, or shipped weights by name. The .md beside it becomes
        README.md, with the pictures in it that lie there, too; without one a short card is made.
    :param repo_id: OWNER/NAME; made if it is not there.
    :param revision: branch to commit to; made if it is not there.
    :param private: make a new repository private, and refuse one that is public; without it a new
        one is public.
    :param message: of the commit; by default it names the file.
    """

    weights: Annotated[conf.Positional[str], conf.arg(metavar='WEIGHTS')]
    repo_id: Annotated[conf.Positional[str], conf.arg(metavar='REPO_ID')]
    revision: Annotated[str, conf.arg(metavar='BRANCH')] = 'main'
    private: Flag = False
    message: Annotated[str, conf.arg(metavar='TEXT', help_behavior_hint=default_text)] = ''


def run(args: Options) -> None:
    """
    Push, and print commit, SHA-256 of the file and the command that pulls it.

    :raises TapError: for what is no weights file, and for what the Hub refuses.
    """
    hub = open_hub(args.repo_id)
    if COMMIT.fullmatch(args.revision):
        raise ConfigError(f'--revision {args.revision}: is a commit; name a branch')
    file = find_predictor(args.weights)
    if file.suffix != SUFFIX:
        raise ConfigError(f'{escaped(file)}: expected a {SUFFIX} file, or shipped weights: '
                          f'{", ".join(PREDICTORS)}')
    about = check_weights(file)
    with storage_errors(file):
        contents = {file.name: file.read_bytes()} | _card(file, about)
    from huggingface_hub import CommitOperationAdd
    with hub_errors(args.repo_id, args.revision):
        hub.create_repo(args.repo_id, private=args.private or None, exist_ok=True)
        if args.private and not hub.model_info(args.repo_id).private:
            raise ConfigError(f'{args.repo_id}: is there already, and public; make it private on '
                              'its page, name another one, or leave out --private')
        if args.revision != 'main':
            hub.create_branch(args.repo_id, branch=args.revision, exist_ok=True)
        commit = hub.create_commit(
            args.repo_id, [CommitOperationAdd(name, data) for name, data in contents.items()],
            commit_message=args.message or f'Upload {file.name}', revision=args.revision)
    digest = hashlib.sha256(contents[file.name]).hexdigest()
    pull = shlex.join([
        *(f'{name}={os.environ[name]}' for name in ['HF_ENDPOINT'] if name in os.environ),
        'python', '-m', 'tap_ros', 'hub', 'pull', args.repo_id, '--revision', commit.oid,
        '--sha256', digest, '--file', file.name, '--out', 'weights'])
    print(f'files       {escaped(", ".join(contents))}\ncommit      {commit.oid}\n'
          f'sha256      {digest}\npull        {escaped(pull, 2000)}')


def _card(file: Path, about: dict[str, Any]) -> dict[str, bytes]:
    """Return README.md and what it shows, by their names in the repository."""
    card = file.with_suffix('.md')
    if not card.exists():
        return {'README.md': _PLAIN_CARD.format(
            name=file.name, kind=str(about['kind']).replace('_', ' '),
            about=json.dumps(about, indent=2)).encode()}
    data = card.read_bytes()
    shown = [file.with_name(name) for name in _PICTURE.findall(data.decode(errors='replace'))]
    return {'README.md': data} | {path.name: path.read_bytes() for path in shown if path.is_file()}
