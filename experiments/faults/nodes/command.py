# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The command that injects faults: `python -m tap_ros evaluate faults`."""

from dataclasses import dataclass
import os
import signal
from typing import Annotated

from experiments.faults.nodes.all_faults import GROUPS
from experiments.faults.nodes.rig import Rig
from experiments.faults.runner import choose, run_faults
from tap_ros.options import Flag, Folder
from tyro import conf


@dataclass(frozen=True)
class Options:
    """
    Options of the command.

    :param only: only these faults; --list names them.
    :param share: share of the trials of each fault.
    :param out: folder of faults.json and faults.md.
    :param again: try also what faults.json says already.
    :param list: list the faults and about how long each takes, and try none.
    """

    only: Annotated[tuple[str, ...], conf.arg(
        metavar='NAME [NAME ...]', help_behavior_hint='(default: all)')] = ()
    share: float = 1.0
    out: Folder = 'docs/results'
    again: Flag = False
    list: Flag = False


def run(args):
    """Try faults, and write what came of it."""
    faults = choose(GROUPS, args.only)
    if args.list:
        total = 0.0
        for fault in faults:
            seconds = fault.count * args.share * fault.seconds
            total += seconds
            print(f'{fault.name:<28} {fault.title}: {max(1, round(fault.count * args.share))} '
                  f'trials, about {seconds / 60:.1f} min')
        print(f'all of these: about {total / 3600:.1f} h')
        return
    # Nodes of others on this machine must neither hear this nor be attacked.
    os.environ.setdefault('ROS_DOMAIN_ID', str(1 + os.getpid() % 100))
    signal.signal(signal.SIGTERM, signal.default_int_handler)  # the nodes end with the run
    os.environ.setdefault('ROS_AUTOMATIC_DISCOVERY_RANGE', 'LOCALHOST')
    with Rig() as rig:
        print(f'logs of the nodes: {rig.folder}', flush=True)
        run_faults(GROUPS, args.out, args.only, args.share, args.again, rig)
    print(f'page: {args.out}/faults.md')
