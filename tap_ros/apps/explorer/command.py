# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The command `python -m tap_ros explore`: all nodes, and a page in the browser to try them."""

from contextlib import suppress
from dataclasses import dataclass
import time
from typing import Annotated

from tap_ros.apps.node_processes import NodeProcesses
from tap_ros.apps.server import PageServer
from tap_ros.base.contract import DEFAULT_LOOK, LOOKS
from tap_ros.base.errors import ConfigError
from tap_ros.base.files import free_folder
from tap_ros.base.options import Folder, one_of
from tap_ros.base.plugins import names
from tap_ros.weights import DEFAULT_PREDICTOR, PREDICTORS


@dataclass(frozen=True)
class Options:
    """
    Options of the command.

    :param task: of the first scene; its predictor is the one that is started.
    :param seed: of the first scene.
    :param look: of the world: the whole arm at its table, or its hand alone.
    :param objects: whether tracker_node follows those that are clicked, or the simulator tells.
    :param host: address at which browsers find the page; 0.0.0.0: of every network of this
        machine, with a token.
    :param port: of the page; 0: any that is free.
    :param token: that browsers must give; empty: made up where one is needed.
    :param logs: folder for the nodes' logs; a number is added when it exists.
    """

    task: Annotated[str, one_of(names('tap_ros.tasks'))] = 'push2'
    seed: int = 1_000_000
    look: Annotated[str, one_of(LOOKS)] = DEFAULT_LOOK
    objects: Annotated[str, one_of(('tracked', 'truth'))] = 'tracked'
    host: str = '127.0.0.1'
    port: int = 8000
    token: str = ''
    logs: Folder = 'runs/explore'


def run(args: Options) -> None:
    """
    Start the nodes, say where the page is, and wait for Ctrl-C.

    :raises ConfigError: for a seed that there is not, and where the page cannot be served.
    :raises NodeEnded: when a node ends; the message has the end of its log.
    """
    if args.seed < 0:
        raise ConfigError(f'seed {args.seed}: expected 0 or more')
    try:  # before nodes start, which would disturb those of another explorer
        PageServer('explorer/page', args.host, args.port).server_close()
    except ConfigError as error:
        raise ConfigError(
            f'{error}; beside another explorer with its own ROS_DOMAIN_ID, too') from error
    folder = free_folder(args.logs)
    with NodeProcesses(folder) as processes:
        start_nodes(processes, args)
        print(f'starting nodes; their logs are in {folder}', flush=True)
        url = processes.wait_until_ready()
        with suppress(KeyboardInterrupt):  # the way to end it
            print(f'open {url} in a browser; Ctrl-C ends all nodes', flush=True)
            while True:
                time.sleep(0.2)
                processes.check()


def start_nodes(processes: NodeProcesses, args: Options) -> None:
    """Start the simulator, what sees, predicts and plans, and the page."""
    # In lock-step a scene waits for those who look at it, however slow the machine is.
    processes.start('sim_node', lock_step=True, observer=True, task=args.task, seed=args.seed,
                    look=args.look, objects=args.objects)
    if args.objects == 'tracked':
        processes.start('tracker_node')
    processes.start('predictor_node', weights=args.task if args.task in PREDICTORS
                    else DEFAULT_PREDICTOR)
    processes.start('visual_mpc_node')
    processes.start('explorer_node', host=args.host, port=args.port, task=args.task,
                    token=args.token)
