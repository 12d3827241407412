# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Starting and ending a node process, and how Fast DDS is set up for it."""

from collections.abc import Callable, MutableMapping
from contextlib import suppress
from difflib import get_close_matches
from importlib import import_module
import os
from pathlib import Path
import signal
import sys
import threading
import time
from typing import Any

import rclpy
from rclpy import executors
from rclpy.signals import SignalHandlerOptions
from rclpy.utilities import remove_ros_args
from tap_ros.base.contract import NODE_CLASSES, OWNED
from tap_ros.base.errors import TapError
from tap_ros.base.text import escaped, listing
from tap_ros.ros.calls import log_error, spin_once
from tap_ros.ros.heartbeat import Heartbeat

SUBNET = Path(__file__).with_name('fastdds_subnet.xml')
LOCALHOST = Path(__file__).with_name('fastdds_localhost.xml')
PROFILE = 'FASTRTPS_DEFAULT_PROFILES_FILE'
CHOICES = (PROFILE, 'FASTDDS_DEFAULT_PROFILES_FILE', 'FASTDDS_BUILTIN_TRANSPORTS')
FAST_DDS = (None, '', 'rmw_fastrtps_cpp', 'rmw_fastrtps_dynamic_cpp')
RANGE = 'ROS_AUTOMATIC_DISCOVERY_RANGE'
LOCALHOST_ONLY = 'ROS_LOCALHOST_ONLY'  # older than RANGE, and takes precedence


class _Ended(BaseException):
    """A signal came while the node started."""


def main(name: str = '', args: list[str] | None = None) -> int:
    """
    Run one node until SIGINT, SIGTERM, or its terminal is closed; what all executables call.

    On a signal the running callback is finished and `node.close()` is called before ROS shuts
    down: rclpy's own signal handlers would end the context first, and neither a last command nor a
    last episode mark could be sent. `close` is called whatever ends the node. An exception in a
    callback is logged, and the node goes on.

    A TapError of its constructor is fatal. The attribute num_threads of its class says how many
    threads callbacks have; by default it is the calling one alone.

    :param name: of the node, one of NODE_CLASSES; by default that of the executable.
    :param args: command-line arguments, None for those of the process.
    :return: exit code: 1 when the node could not be started, or when close returns 1; 0 after
        --help.
    """
    name = name or Path(sys.argv[0]).name
    if (said := usage(name, sys.argv[1:] if args is None else args)) is not None:
        print(said, file=sys.stderr if said.startswith('error') else sys.stdout)
        return int(said.startswith('error'))
    module, class_name = NODE_CLASSES[name].split(':')
    node_class = getattr(import_module(module), class_name)
    stop = threading.Event()

    def end(*_: Any) -> None:
        # Not KeyboardInterrupt: after one that leaves an exec(), as in making a dataclass, Python
        # ends by SIGINT even where it was caught.
        stop.set()
        raise _Ended

    node = executor = heartbeat = None
    code = 0
    try:
        _handle_signals(end)
        if os.environ.pop(OWNED, ''):
            threading.Thread(target=_end_with_owner, name='owner watch', daemon=True).start()
        configure_fast_dds()
        rclpy.init(args=args, signal_handler_options=SignalHandlerOptions.NO)
        node = node_class(automatically_declare_parameters_from_overrides=True)
        warn_of_unknown_parameters(node)
        _handle_signals(lambda *_: stop.set())
        num_threads = getattr(node_class, 'num_threads', 1)
        executor = (executors.SingleThreadedExecutor() if num_threads == 1
                    else executors.MultiThreadedExecutor(num_threads))
        executor.add_node(node)
        heartbeat = Heartbeat(node)
        while rclpy.ok() and not stop.is_set():
            spin_once(executor, node)
    except (_Ended, KeyboardInterrupt, executors.ExternalShutdownException):
        pass
    except (TapError, RuntimeError) as error:
        if not stop.is_set():  # else it is a consequence of the signal
            code = 1
            if isinstance(error, TapError):
                rclpy.logging.get_logger(name).fatal(escaped(error, 1000))
            elif node is not None or rclpy.ok():
                raise
            else:  # what follows --ros-args cannot be parsed
                print(f'{name}: {escaped(error, 1000)}', file=sys.stderr)
    finally:
        _handle_signals(lambda *_: None)  # it is ending already
        if node is not None:
            try:
                code = node.close() or code  # first of all: it stops the arm
            except Exception as error:
                log_error(node, 'the node did not end cleanly', error)
                code = 1
        if heartbeat is not None:
            heartbeat.end()
        if executor is not None:
            _finish(executor, 2.0)
        if node is not None:
            node.destroy_node()
        rclpy.try_shutdown()
    return code


def usage(name: str, args: list[str]) -> str | None:
    """Return what is said instead of starting a node with such arguments; None: nothing."""
    how = (f'{name} --ros-args -p NAME:=VALUE ..., or --ros-args --params-file FILE.yaml; all '
           'parameters are in config/tap_ros.yaml')
    with suppress(RuntimeError):  # of ROS arguments that cannot be parsed; rclpy.init says it
        for one in remove_ros_args(['', *args])[1:]:
            return f'usage: {how}' if one in ('-h', '--help') else (
                f'error: argument {escaped(one, 60)} is unknown; expected {how}')
    return None


def _finish(executor: Any, seconds: float) -> None:
    """Wait for callbacks that threads have begun, as shutdown of rclpy does not, and end."""
    end = time.monotonic() + seconds
    while time.monotonic() < end and not all(
            task.done() for task in getattr(executor, '_futures', ())):
        time.sleep(0.01)
    executor.shutdown()


def warn_of_unknown_parameters(node: Any) -> None:
    """Warn of parameters that were given to a node and that it does not have."""
    known = list(node.list_parameters([], 0).names)
    for name in sorted(node.params.given - set(known)):
        near = get_close_matches(name, known, 1) or known
        node.get_logger().warning(
            f'parameter {escaped(name)} is unknown to this node and has no effect; '
            + (f'did you mean {near[0]}?' if len(near) == 1 else f'it has {listing(near, 50)}'))


def configure_fast_dds(environ: MutableMapping[str, str] = os.environ) -> None:
    """
    Let Fast DDS drop this process 3 s after its death, and use UDP alone.

    By default it waits for 20 s, and until then others send calls of its services to it. Much
    less than 3 s is too little on a loaded machine: a node that is dropped and comes back can
    lose what is sent to it for a while. Shared memory is left out as Fast DDS 2.14 loses what a
    process sends to one that was killed and started again (its pull request 4728).

    To be called before rclpy.init. Another middleware, and profiles or transports that the user
    has chosen, are left alone; so is LOCALHOST with ROS_STATIC_PEERS, where rmw_fastrtps adds
    shared memory.

    :param environ: the variables of this process, which rclpy.init reads.
    """
    if environ.get('RMW_IMPLEMENTATION') not in FAST_DDS or any(
            name in environ for name in CHOICES):
        return
    profile = SUBNET
    alone = environ.get(LOCALHOST_ONLY) == '1'
    local = alone or environ.get(RANGE, '').upper() == 'LOCALHOST'
    if local and (alone or not environ.get('ROS_STATIC_PEERS')):
        profile = LOCALHOST
    if not profile.is_file():  # without it the range must stay as it is
        return
    environ[PROFILE] = str(profile)
    if profile is LOCALHOST:  # rmw_fastrtps leaves the system's default alone
        environ.pop(LOCALHOST_ONLY, None)
        environ[RANGE] = 'SYSTEM_DEFAULT'


def _end_with_owner() -> None:
    """End this process as SIGTERM does once its owner, who holds its standard input, is gone."""
    with suppress(OSError):  # it is closed already
        while os.read(0, 1024):
            pass
    os.kill(os.getpid(), signal.SIGTERM)


def _handle_signals(handler: Callable[[int, Any], Any]) -> None:
    """Handle what ends a node. A shell ignores SIGINT for jobs in the background; nodes do not."""
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGQUIT):
        signal.signal(number, handler)
    if signal.getsignal(signal.SIGHUP) is not signal.SIG_IGN:  # nohup
        signal.signal(signal.SIGHUP, handler)
