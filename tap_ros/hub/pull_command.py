# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The command `python -m tap_ros hub pull`: weights that are checked before they are in place."""

from dataclasses import dataclass
import hashlib
from pathlib import Path, PurePosixPath
import re
from tempfile import TemporaryDirectory
from typing import Annotated

from tap_ros.errors import ConfigError, WeightsError
from tap_ros.files import storage_errors, write_atomically
from tap_ros.hub.repository import check_weights, hub_errors, open_hub, SUFFIX
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
    hub, wanted = open_hub(args.repo_id), args.sha256.lower()
    if wanted and not re.fullmatch('[0-9a-f]{64}', wanted):
        raise ConfigError(f'--sha256 {escaped(args.sha256)}: expected 64 hexadecimal digits')
    if args.file and PurePosixPath(args.file).suffix != SUFFIX:
        raise ConfigError(f'--file {escaped(args.file)}: expected a {SUFFIX} file; others, such '
                          'as pickles, are never loaded')
    with TemporaryDirectory(prefix='tap_ros_hub_') as folder:
        with hub_errors(args.repo_id, args.revision):
            info = hub.model_info(args.repo_id, revision=args.revision)
            commit = str(info.sha)
            name = _choose([file.rfilename for file in info.siblings or ()], args.file,
                           f'{args.repo_id} at {commit[:12]}')
            # A cache of its own: one that holds a damaged file would give it again and again.
            path = Path(hub.hf_hub_download(
                args.repo_id, name, revision=commit, local_dir=folder, cache_dir=folder))
        with storage_errors(path):
            data = path.read_bytes()
        source = f'{args.repo_id}/{escaped(name)} at {commit[:12]}'
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
    with storage_errors(target):
        there = target.read_bytes() if target.exists() else None
    if there != data:
        if there is not None and not args.force:
            raise ConfigError(f'{escaped(target)}: is there already with other content; name '
                              'another --out, or replace it with --force')
        write_atomically(target, data)
    print(f'file        {escaped(target)}\ncommit      {commit}\nsha256      {found}')


def _choose(names: list[str], wanted: str, source: str) -> str:
    """
    Choose the file to pull.

    :param names: of all files of the repository; wanted: of one of them, or empty.
    :param source: repository and commit, for messages.
    """
    found = sorted(name for name in names if PurePosixPath(name).suffix == SUFFIX)
    if wanted in found or (not wanted and len(found) == 1):
        return wanted or found[0]
    if not found:
        raise WeightsError(f'{source}: holds no {SUFFIX} file, only {listing(names) or "nothing"};'
                           ' correct REPO_ID or --revision')
    raise ConfigError((f'--file {escaped(wanted)}: is not in {source}' if wanted else
                       f'{source}: holds several weights files')
                      + f'; name one by --file: {listing(found)}')
