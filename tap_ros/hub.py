# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Trained weights to and from the Hugging Face Hub, as safetensors that are checked, with their card.

Which Hub and with which token is left to huggingface_hub: HF_ENDPOINT, HF_TOKEN, `hf auth login`.
"""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
import json
from pathlib import Path, PurePosixPath
import re
import shlex
from tempfile import TemporaryDirectory
from typing import Annotated

from tap_ros.errors import ConfigError, HubError, TapError
from tap_ros.files import write_atomically
from tap_ros.options import default_text, Flag, Folder
from tap_ros.text import escaped, listing
from tap_ros.weights import find_predictor
from tyro import conf

_PICTURE = re.compile(r'!\[[^]]*\]\(([\w.-]+)\)')  # in a card, of a file beside it
_PLAIN_CARD = """---
library_name: tap_ros
tags: [robotics, ros2, safetensors]
---
# {name}

Weights of tap_ros. Nobody has written a model card; this is what the file says of itself.

```json
{about}
```
"""


@dataclass(frozen=True)
class Push:
    """
    Options of `python -m tap_ros hub push`.

    :param weights: a .safetensors file, or shipped weights by name. The .md beside it becomes
        README.md, with the pictures in it that lie there, too; without one a short card is made.
    :param repo_id: OWNER/NAME; made if it is not there.
    :param private: make a new repository private.
    """

    weights: Annotated[conf.Positional[str], conf.arg(metavar='WEIGHTS')]
    repo_id: Annotated[conf.Positional[str], conf.arg(metavar='REPO_ID')]
    private: Flag = False


@dataclass(frozen=True)
class Pull:
    """
    Options of `python -m tap_ros hub pull`.

    :param repo_id: OWNER/NAME.
    :param out: where to put the file, under its own name.
    :param revision: a commit, branch or tag.
    :param file: name in the repository, where that holds several .safetensors files.
    """

    repo_id: Annotated[conf.Positional[str], conf.arg(metavar='REPO_ID')]
    out: Folder
    revision: Annotated[str, conf.arg(metavar='COMMIT')] = 'main'
    file: Annotated[str, conf.arg(metavar='NAME', help_behavior_hint=default_text)] = ''


def push(args: Push) -> None:
    """
    Push weights and their card in one commit; print the command that pulls exactly this file.

    :raises TapError: for what is no weights file, and for what the Hub refuses.
    """
    from huggingface_hub import CommitOperationAdd, HfApi
    from tap_ros.training.weights import load_tensors  # torch takes seconds
    file, hub = find_predictor(args.weights), HfApi()
    _, about = load_tensors(file)
    card = file.with_suffix('.md')
    text = card.read_text() if card.exists() else _PLAIN_CARD.format(
        name=file.name, about=json.dumps(about, indent=2))
    pictures = [path for name in _PICTURE.findall(text)
                if (path := file.with_name(name)).is_file()]
    contents = {'README.md': text.encode(), **{
        path.name: path.read_bytes() for path in (file, *pictures)}}
    with _hub_errors(args.repo_id):
        hub.create_repo(args.repo_id, private=args.private or None, exist_ok=True)
        commit = hub.create_commit(
            args.repo_id, [CommitOperationAdd(name, data) for name, data in contents.items()],
            commit_message=f'Upload {file.name}').oid
    print(f'python -m tap_ros hub pull {args.repo_id} --revision {commit} --file '
          f'{shlex.quote(file.name)} --out weights')


def pull(args: Pull) -> None:
    """
    Pull weights, check the SHA-256 that they hold, and print file and commit.

    :raises TapError: for what cannot be had or is no weights file, and where another file of that
        name is; then nothing is written.
    """
    from huggingface_hub import HfApi
    from tap_ros.training.weights import load_tensors
    hub = HfApi()
    with TemporaryDirectory(prefix='tap_ros_hub_') as folder:
        with _hub_errors(args.repo_id):
            info = hub.model_info(args.repo_id, revision=args.revision)
            names = [file.rfilename for file in info.siblings or ()
                     if PurePosixPath(file.rfilename).suffix == '.safetensors']
            chosen = [name for name in names if args.file in ('', name)]
            if len(chosen) != 1:
                raise ConfigError('--file: expected one of the .safetensors files of '
                                  f'{args.repo_id}: {listing(names) or "none"}')
            path = Path(hub.hf_hub_download(
                args.repo_id, chosen[0], revision=info.sha, local_dir=folder))
        load_tensors(path)
        data, target = path.read_bytes(), Path(args.out, path.name)
        if target.exists() and target.read_bytes() != data:
            raise ConfigError(f'--out {escaped(target)}: is there already with other content')
        write_atomically(target, data)
    print(f'file        {escaped(target)}\ncommit      {info.sha}')


@contextmanager
def _hub_errors(repo: str) -> Iterator[None]:
    """Turn what huggingface_hub raises, which has no base class, into one line."""
    try:
        yield
    except TapError:
        raise
    except Exception as error:
        said = ' '.join(str(getattr(error, 'server_message', '') or error).split())
        raise HubError(f'{escaped(repo)}: {escaped(said, 300)}; correct the name or --revision, '
                       'log in (`hf auth login`) or see to the network') from error
