# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Starting and ending a node process."""

import signal
import sys
import threading

import rclpy
from rclpy.executors import (
    ExternalShutdownException,
    MultiThreadedExecutor,
    SingleThreadedExecutor,
)
from rclpy.signals import SignalHandlerOptions
from tap_ros.errors import TapError


def run_node(make_node, name, args=None, num_threads=1):
    """
    Run one node until SIGINT or SIGTERM.

    On a signal the callback in progress is finished and `node.close()` is called before ROS shuts
    down: rclpy's own signal handlers would end the context first, and neither a last command nor a
    last episode mark could be sent.

    :param make_node: called without arguments after rclpy.init; a TapError from it is fatal.
    :param name: name for the log until the node has one.
    :param args: command-line arguments, None for those of the process.
    :param num_threads: threads for callbacks; with 1 all of them run in the calling thread.
    :return: exit code, 1 when the node could not be started.
    """
    stop = threading.Event()
    node = executor = None
    signal.signal(signal.SIGINT, signal.default_int_handler)
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    try:
        rclpy.init(args=args, signal_handler_options=SignalHandlerOptions.NO)
    except RuntimeError as error:  # what follows --ros-args cannot be parsed
        print(f'{name}: {error}', file=sys.stderr)
        return 1
    try:
        node = make_node()
        executor = (SingleThreadedExecutor() if num_threads == 1
                    else MultiThreadedExecutor(num_threads))
        executor.add_node(node)
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, lambda *_: stop.set())
        while rclpy.ok() and not stop.is_set():
            executor.spin_once(timeout_sec=0.1)  # a signal is noticed after this time at most
        node.close()
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    except TapError as error:
        rclpy.logging.get_logger(name).fatal(str(error))
        return 1
    finally:
        if executor is not None:
            executor.shutdown(timeout_sec=2.0)
        if node is not None:
            node.destroy_node()
        rclpy.try_shutdown()
    return 0
