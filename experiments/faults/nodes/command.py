# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The command that injects faults: `python -m tap_ros evaluate faults`."""

import os
import signal

from experiments.faults.nodes.groups import GROUPS
from experiments.faults.nodes.rig import Rig
from experiments.faults.runner import choose, run_faults


def add_arguments(parser):
    """Add the options of the command."""
    parser.add_argument('--only', nargs='+', default=[], metavar='NAME',
                        help='only these faults (default: all; --list names them)')
    parser.add_argument('--share', type=float, default=1.0,
                        help='share of the trials of each fault (default: %(default)s)')
    parser.add_argument('--out', default='docs/results',
                        help='folder of faults.json and faults.md (default: %(default)s)')
    parser.add_argument('--again', action='store_true',
                        help='try also what faults.json says already')
    parser.add_argument('--list', action='store_true',
                        help='list the faults and about how long each takes, and try none')


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
