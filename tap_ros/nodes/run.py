# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Starting and ending a node process."""

from collections.abc import Callable
import signal
import sys
import threading
import traceback
from typing import Any, TYPE_CHECKING

import rclpy
from rclpy.executors import (
    ExternalShutdownException,
    MultiThreadedExecutor,
    SingleThreadedExecutor,
)
from rclpy.signals import SignalHandlerOptions
from tap_ros.errors import TapError
from tap_ros.nodes.heartbeat import Heartbeat
from tap_ros.nodes.middleware import configure_fast_dds
from tap_ros.text import escaped

if TYPE_CHECKING:
    from rclpy.executors import Executor
    from rclpy.node import Node


class _Ended(BaseException):
    """A signal came while the node started."""


def run_node(make_node: Callable[[], Any], name: str, args: list[str] | None = None,
             num_threads: int = 1) -> int:
    """
    Run one node until SIGINT, SIGTERM, or its terminal is closed.

    On a signal the callback in progress is finished and `node.close()` is called before ROS shuts
    down: rclpy's own signal handlers would end the context first, and neither a last command nor a
    last episode mark could be sent. `close` is called whatever ends the node. What a callback
    raises is logged, and the node goes on.

    :param make_node: called without arguments after rclpy.init; a TapError from it is fatal.
    :param name: name for the log until the node has one.
    :param args: command-line arguments, None for those of the process.
    :param num_threads: threads for callbacks; with 1 all of them run in the calling thread.
    :return: exit code: 1 when the node could not be started, or close says so by returning 1.
    """
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
        configure_fast_dds()
        rclpy.init(args=args, signal_handler_options=SignalHandlerOptions.NO)
        node = make_node()
        _handle_signals(lambda *_: stop.set())
        executor = (SingleThreadedExecutor() if num_threads == 1
                    else MultiThreadedExecutor(num_threads))
        executor.add_node(node)
        heartbeat = Heartbeat(node)
        while rclpy.ok() and not stop.is_set():
            _spin_once(executor, node)
    except (_Ended, KeyboardInterrupt, ExternalShutdownException):
        pass
    except TapError as error:
        if not stop.is_set():  # else it is what the signal has broken
            rclpy.logging.get_logger(name).fatal(escaped(error, 1000))
            code = 1
    except RuntimeError as error:
        if not stop.is_set():
            if node is not None or rclpy.ok():
                raise
            # What follows --ros-args cannot be parsed.
            print(f'{name}: {escaped(error, 1000)}', file=sys.stderr)
            code = 1
    finally:
        _handle_signals(lambda *_: None)  # it is ending already
        if node is not None:
            code = _close(node) or code  # first of all: it stops the arm
        if heartbeat is not None:
            heartbeat.end()
        if executor is not None:
            executor.shutdown(timeout_sec=2.0)
        if node is not None:
            node.destroy_node()
        rclpy.try_shutdown()
    return code


def refusal(kind: type, message: str) -> Any:
    """Return a response of this type, with the fields success and message, that refuses."""
    return kind(success=False, message=message)


def answering(node: 'Node', callback: Callable[[Any, Any], Any],
              refuse: Callable[[type, str], Any] = refusal) -> Callable[[Any, Any], Any]:
    """
    Let a service answer whatever its callback raises.

    :param node: rclpy Node, for its log.
    :param callback: of a service.
    :param refuse: makes a response of a type and a message.
    :return: a callback that raises nothing.
    """
    def answer(request: Any, response: Any) -> Any:
        try:
            return callback(request, response)
        except Exception as error:
            node.get_logger().error(traceback.format_exc())
            return refuse(
                type(response), f'internal error: {type(error).__name__}: {escaped(error)}')

    return answer


def _handle_signals(handler: Callable[[int, Any], Any]) -> None:
    """Handle what ends a node. A shell ignores SIGINT for jobs in the background; nodes do not."""
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGQUIT):
        signal.signal(number, handler)
    if signal.getsignal(signal.SIGHUP) is not signal.SIG_IGN:  # nohup
        signal.signal(signal.SIGHUP, handler)


def _spin_once(executor: 'Executor', node: 'Node') -> None:
    """Run what is ready; a signal is noticed after 0.1 s at most."""
    try:
        executor.spin_once(timeout_sec=0.1)
    except (KeyboardInterrupt, ExternalShutdownException):
        raise
    except Exception as error:
        node.get_logger().error(
            f'a callback failed with {type(error).__name__}: {escaped(error)}; going on\n'
            + traceback.format_exc())


def _close(node: Any) -> int:
    """Let the node end what it does; return its exit code."""
    try:
        return node.close() or 0
    except Exception:
        node.get_logger().error(f'the node did not end cleanly:\n{traceback.format_exc()}')
        return 1
