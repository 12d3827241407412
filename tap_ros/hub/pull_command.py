# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The command `python -m tap_ros hub pull`: weights that are checked before they are in place."""

from dataclasses import dataclass
import hashlib
from pathlib import Path, PurePosixPath
import re
from tempfile import TemporaryDirectory
from typing import Annotated

from tap_ros.errors import ConfigError, HubError, WeightsError
from tap_ros.files import storage_errors, write_atomically
from tap_ros.hub.repository import COMMIT, hub_errors, open_hub, SUFFIX
from tap_ros.options import default_text, Flag, Folder
from tap_ros.text import escaped, listing
from tyro import conf


@dataclass(frozen=True)
class Options:
    """
    Options of the command.

    :param repo_id: OWNER/NAME.
    :param out: where to put the file, under its own name.
    :param revision: a commit, branch or tag.
    :param sha256: what the file must have, 64 hexadecimal digits; any other one is refused.
    :param file: name in the repository, where that holds several .safetensors files.
    :param force: replace a file of that name with other content.
    """

    repo_id: Annotated[conf.Positional[str], conf.arg(metavar='REPO_ID')]
    out: Folder
    revision: Annotated[str, conf.arg(metavar='COMMIT')] = 'main'
    sha256: Annotated[str, conf.arg(metavar='HASH', help_behavior_hint=default_text)] = ''
    file: Annotated[str, conf.arg(metavar='NAME', help_behavior_hint=default_text)] = ''
    force: Flag = False


def run(args: Options) -> None:
    """
    Pull, and print file, commit and SHA-256.

    :raises TapError: for what cannot be had, is not what was asked for or is no weights file, and
        for a file that is there with other content. Then the folder is as it was.
    """
    hub = open_hub(args.repo_id)
    wanted = args.sha256.lower()
    if wanted and not re.fullmatch('[0-9a-f]{64}', wanted):
        raise ConfigError(f'--sha256 {escaped(args.sha256)}: expected 64 hexadecimal digits')
    if args.file:
        _check_suffix(args.file)
    with hub_errors(args.repo_id, args.revision):
        info = hub.model_info(args.repo_id, revision=args.revision)
        commit, names = str(info.sha), [file.rfilename for file in info.siblings or ()]
    if not COMMIT.fullmatch(commit):
        raise HubError(f'{args.repo_id}: the server does not say which commit '
                       f'{escaped(args.revision)} is; see whether HF_ENDPOINT is right')
    name = _choose(names, args.file, f'{args.repo_id} at {commit[:12]}')
    source = f'{args.repo_id}/{escaped(name)} at {commit[:12]}'
    from tap_ros.hub.checked import check_weights  # torch takes seconds
    with TemporaryDirectory(prefix='tap_ros_hub_') as folder:
        with hub_errors(args.repo_id, args.revision):
            # A cache of its own: one that holds a damaged file would give it again and again.
            path = Path(hub.hf_hub_download(
                args.repo_id, name, revision=commit, local_dir=folder, cache_dir=folder))
        with storage_errors(path):
            data = path.read_bytes()
        found = hashlib.sha256(data).hexdigest()
        if wanted not in ('', found):
            raise WeightsError(f'{source}: has SHA-256 {found}, --sha256 says {wanted}; nothing '
                               'was written. Correct one of --revision, --file and --sha256')
        try:
            check_weights(path)
        except WeightsError as error:
            reason = str(error).removeprefix(f'{escaped(path)}: ')
            raise WeightsError(f'{source}: {reason}. Nothing was written') from error
    target = Path(args.out, PurePosixPath(name).name)
    there = _content(target)
    if there != data:
        if there is not None and not args.force:
            raise ConfigError(f'{escaped(target)}: is there already with other content; name '
                              'another --out, or replace it with --force')
        write_atomically(target, data)
    print(f'file        {escaped(target)}\ncommit      {commit}\nsha256      {found}')


def _check_suffix(name: str) -> None:
    """Refuse what may be a pickle, which runs code when it is loaded."""
    if PurePosixPath(name).suffix != SUFFIX:
        raise ConfigError(f'--file {escaped(name)}: expected a {SUFFIX} file; others, such as '
                          'pickles, are never loaded')


def _choose(names: list[str], wanted: str, source: str) -> str:
    """
    Choose the file to pull.

    :param names: of all files of the repository; wanted: of one of them, or empty.
    :param source: repository and commit, for messages.
    """
    found = sorted(name for name in names if PurePosixPath(name).suffix == SUFFIX)
    if wanted in found:
        return wanted
    if not found:
        raise WeightsError(f'{source}: holds no {SUFFIX} file, only {listing(names) or "nothing"};'
                           ' correct REPO_ID or --revision')
    if not wanted and len(found) == 1:
        return found[0]
    raise ConfigError((f'--file {escaped(wanted)}: is not in {source}' if wanted else
                       f'{source}: holds several weights files')
                      + f'; name one by --file: {listing(found)}')


def _content(path: Path) -> bytes | None:
    """Return what a file holds; None: there is none."""
    with storage_errors(path):
        try:
            return path.read_bytes()
        except FileNotFoundError:
            return None
