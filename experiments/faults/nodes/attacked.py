# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Node processes that are killed, stopped, frozen and started again."""

import os
from pathlib import Path
import signal
import subprocess
import sys
import time

from experiments.faults.children import end_group
from tap_ros.contract import NODE_MODULES
from tap_ros.errors import TapError

START_S = 90.0


def _hear_signals():
    """Take back what nohup and background jobs of a shell ignore."""
    for number in (signal.SIGINT, signal.SIGHUP):
        signal.signal(number, signal.SIG_DFL)


class Attacked:
    """
    One node in a process group of its own.

    :param name: a name of NODE_MODULES.
    :param log: file for what it prints; a new start adds to it.
    :param parameters: {name: value} of its ROS parameters.
    :param arguments: more arguments after --ros-args.
    """

    def __init__(self, name, log, parameters=None, arguments=()):
        self.name, self.log = name, Path(log)
        self.parameters, self.arguments = dict(parameters or {}), tuple(arguments)
        self._from = 0  # where the log of the present process begins
        self.process = None

    def start(self):
        """Start it, without waiting."""
        command = [sys.executable, '-m', NODE_MODULES[self.name], '--ros-args', *self.arguments]
        for key, value in self.parameters.items():
            text = str(value).lower() if isinstance(value, bool) else str(value)
            command += ['-p', f'{key}:={text}']
        self._from = self.log.stat().st_size if self.log.exists() else 0
        with self.log.open('ab') as log:
            self.process = subprocess.Popen(
                command, stdout=log, stderr=subprocess.STDOUT, stdin=subprocess.DEVNULL,
                start_new_session=True,
                preexec_fn=_hear_signals)
        return self

    @property
    def alive(self):
        """Whether it runs."""
        return self.process is not None and self.process.poll() is None

    @property
    def text(self):
        """What the present process has printed."""
        with self.log.open('rb') as log:
            log.seek(self._from)
            return log.read().decode(errors='replace')

    def wait_until_ready(self, timeout_s=START_S):
        """Wait until it says that it is ready; raise TapError when it does not."""
        return self.wait_for('ready', timeout_s)

    def wait_for(self, words, timeout_s):
        """Wait until it prints something; raise TapError when it does not."""
        deadline = time.monotonic() + timeout_s
        while words not in self.text:
            if not self.alive:
                raise TapError(f'{self.name} ended with code {self.process.returncode}: '
                               f'{self.last_line()}')
            if time.monotonic() > deadline:
                raise TapError(f'{self.name} did not print {words!r} in {timeout_s:g} s: '
                               f'{self.last_line()}')
            time.sleep(0.02)
        return self

    def last_line(self):
        """Return the last line that it printed."""
        return (self.text.strip().splitlines() or ['it printed nothing'])[-1]

    def send(self, number):
        """Send a signal, if it runs."""
        if self.alive:
            self.process.send_signal(number)

    def kill(self):
        """Kill it, as the kernel does when memory is short; return the moment."""
        moment = time.monotonic()
        if self.process is not None:
            end_group(self.process)
        return moment

    def end(self, number=signal.SIGINT, timeout_s=10.0):
        """
        End it politely.

        :return: exit code; None when it did not end in time, and was killed.
        """
        self.send(number)
        try:
            return self.process.wait(timeout_s)
        except subprocess.TimeoutExpired:
            self.kill()
            return None

    def memory_mb(self):
        """Return the memory that it holds (resident set), in MB."""
        pages = Path(f'/proc/{self.process.pid}/statm').read_text().split()[1]
        return int(pages) * os.sysconf('SC_PAGE_SIZE') / 1e6
