# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Start nodes as processes of their own, with logs, and end them all."""

from collections.abc import Iterable
import os
from pathlib import Path
import re
import signal
import subprocess
import sys
import time
from typing import Any, Self

from tap_ros.base.contract import OWNED
from tap_ros.base.errors import TapError
import yaml

READY_S, LOOK_S = 120.0, 0.1
# What no log should have: Python's and C++'s last words, and what rclpy calls an error.
_WRONG = re.compile(r'Traceback \(most recent call last\)|^Fatal Python error|^terminate called|'
                    r'^\[(?:ERROR|FATAL)\] \[')


class NodeEnded(TapError):
    """A node's process ended by itself."""


def errors_in(log: str, expected: Iterable[str] = ()) -> list[str]:
    """
    Return the lines of a node's log that no healthy node prints: tracebacks, ERROR and FATAL.

    :param log: its text.
    :param expected: patterns of lines that were provoked.
    """
    known = [re.compile(pattern) for pattern in expected]
    return [line for line in log.splitlines()
            if _WRONG.search(line) and not any(pattern.search(line) for pattern in known)]


class NodeProcesses:
    """
    Processes of nodes, ended with the with-block; each logs into a file of its own.

    SIGTERM and SIGHUP, as of a terminal that is closed, leave the block, too. If this process is
    killed, nodes see that their standard input closes, and end themselves.

    :param log_folder: folder of the logs, made if it is not there.
    :param namespace: of the nodes, such as '/left'.
    """

    def __init__(self, log_folder: str | Path, namespace: str = '') -> None:
        self._folder = Path(log_folder)
        self._remap = ['-r', f'__ns:={namespace}'] if namespace else []
        self._folder.mkdir(parents=True, exist_ok=True)
        self._processes: dict[str, subprocess.Popen[bytes]] = {}

    def start(self, name: str, **parameters: Any) -> None:
        """
        Start a node.

        :param name: one of NODE_CLASSES.
        :param parameters: its ROS parameters.
        """
        command = [sys.executable, '-m', 'tap_ros.nodes', name, '--ros-args', *self._remap]
        if parameters:  # in a file that others cannot read: a token is no argument for all to see
            file = self._folder / f'{name}.yaml'
            file.touch(mode=0o600)
            file.write_text(yaml.safe_dump({'/**': {'ros__parameters': {
                key: str(value) if isinstance(value, Path) else value
                for key, value in parameters.items()}}}))
            command += ['--params-file', str(file)]
        with self._log(name).open('wb') as log:
            # A session of its own: Ctrl-C reaches us, and we end the nodes in order.
            self._processes[name] = subprocess.Popen(
                command, stdout=log, stderr=subprocess.STDOUT, stdin=subprocess.PIPE,
                start_new_session=True, env=os.environ | {OWNED: '1'})

    def check(self) -> None:
        """
        Make sure that all still run.

        :raises NodeEnded: naming the first that does not, with the end of its log.
        """
        for name, process in self._processes.items():
            if process.poll() is not None:
                lines = self._log(name).read_text(errors='replace').strip().splitlines()
                raise NodeEnded(
                    f'{name} ended with exit code {process.returncode}; the end of '
                    f'{self._log(name)}: ' + '; '.join(lines[-5:]))

    def cpu_s(self, name: str) -> float:
        """Return the CPU time that a node has taken so far, s; Linux tells."""
        stat = Path(f'/proc/{self._processes[name].pid}/stat').read_text()
        user, system = stat.rpartition(')')[2].split()[11:13]
        return (int(user) + int(system)) / os.sysconf('SC_CLK_TCK')

    def wait_until_ready(self) -> str:
        """
        Wait until each node's log says that it is ready.

        :return: the rest of that line in the log of the node that was started last.
        :raises TapError: when a node ends, or is not ready after READY_S.
        """
        deadline, said = time.monotonic() + READY_S, ''
        for name in self._processes:
            while not (found := re.search(r'ready: (?:open )?(.*)',
                                         self._log(name).read_text(errors='replace'))):
                self.check()
                if time.monotonic() > deadline:
                    raise TapError(f'{self._log(name)}: {name} is not ready after {READY_S:g} s')
                time.sleep(LOOK_S)
            said = found[1]
        return said

    def __enter__(self) -> Self:
        for number in (signal.SIGTERM, signal.SIGHUP):
            if signal.getsignal(number) is signal.SIG_DFL:  # nohup ignores SIGHUP: so do we
                signal.signal(number, lambda number, _: sys.exit(128 + number))
        return self

    def __exit__(self, *_: object) -> None:
        self.end()

    def end(self) -> None:
        """End all nodes, politely first; that started first, which may record, as the last."""
        processes = list(self._processes.values())
        for group in (processes[1:], processes[:1]):
            running = [p for p in group if p.poll() is None]
            for process in running:
                process.terminate()  # a shell ignores SIGINT for jobs in the background
            for process in running:
                try:
                    process.wait(15)
                except subprocess.TimeoutExpired:
                    process.kill()
                    process.wait()
        for process in processes:
            if process.stdin is not None:
                process.stdin.close()

    def _log(self, name: str) -> Path:
        return self._folder / f'{name}.log'
