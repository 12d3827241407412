# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Child processes with limits: on time, on memory, on the size of the files they write."""

from dataclasses import dataclass
import json
import os
from pathlib import Path
import resource
import select
import signal
import subprocess
import sys
import time

ROOT = Path(__file__).parents[2]
READER = [sys.executable, '-m', 'experiments.faults.reading']


class Reader:
    """
    The process of reading.py, started anew whenever a file has ended it.

    :param memory_bytes: most address space it may take; None: no limit.
    """

    def __init__(self, memory_bytes=None):
        self._memory = memory_bytes
        self._process = None

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self._end()

    def read(self, what, path, timeout_s=10.0):
        """
        Read a file.

        :param what: a key of reading.READERS.
        :param path: the file.
        :param timeout_s: after so long it is a hang, and the process is killed.
        :return: the dict of reading.answer; with 'kind' crash or hang when there was no answer.
        """
        if self._process is None:
            self._process = subprocess.Popen(
                READER, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL,
                cwd=ROOT, start_new_session=True, preexec_fn=self._limit)
            self._ask(what, os.devnull, 120.0)  # what is imported on the way is not timed
        if self._process is None:
            return _nothing('crash', 'the reader ended at once')
        return self._ask(what, path, timeout_s)

    def _ask(self, what, path, timeout_s):
        try:
            self._process.stdin.write((json.dumps([what, str(path)]) + '\n').encode())
            self._process.stdin.flush()
        except BrokenPipeError:
            return self._gone()
        ready, _, _ = select.select([self._process.stdout], [], [], timeout_s)
        if not ready:
            self._end()
            return _nothing('hang', f'no answer in {timeout_s:g} s')
        line = self._process.stdout.readline()
        return json.loads(line) if line else self._gone()

    def _gone(self):
        code = self._process.wait()
        self._process = None
        return _nothing('crash', describe_exit(code))

    def _limit(self):
        if self._memory is not None:
            resource.setrlimit(resource.RLIMIT_AS, (self._memory, self._memory))

    def _end(self):
        if self._process is not None:
            end_group(self._process)
            self._process.stdin.close()
            self._process.stdout.close()
            self._process = None


@dataclass(frozen=True)
class Ended:
    """How a child process ended."""

    code: int | None  # None: it was killed after its time
    text: str  # what it printed
    seconds: float


def run_limited(command, timeout_s, file_bytes=None, env=None):
    """
    Run a command to its end.

    :param command: list of words.
    :param timeout_s: after so long all of its processes are killed.
    :param file_bytes: most bytes of any file that it writes; beyond, a write fails as it does on a
        full disk, though with another error number.
    :param env: environment variables beside those of this process.
    :return: Ended.
    """
    def limit():
        if file_bytes is not None:
            signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
            resource.setrlimit(resource.RLIMIT_FSIZE, (file_bytes, file_bytes))
    begin = time.monotonic()
    process = subprocess.Popen(
        command, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.STDOUT,
        cwd=ROOT, env={**os.environ, **(env or {})}, start_new_session=True, preexec_fn=limit)
    try:
        text, _ = process.communicate(timeout=timeout_s)
        code = process.returncode
    except subprocess.TimeoutExpired:
        end_group(process)
        text, _ = process.communicate()
        code = None
    return Ended(code, text.decode(errors='replace'), time.monotonic() - begin)


def end_group(process):
    """Kill a process and all that it started, if it still runs."""
    if process.poll() is None:
        os.killpg(process.pid, signal.SIGKILL)
    process.wait()


def describe_exit(code):
    """Return an exit code in words."""
    if code is not None and code < 0:
        return f'ended by {signal.Signals(-code).name}'
    return f'exit code {code}'


def _nothing(kind, error):
    return {'content': None, 'error': error, 'kind': kind, 'expected': False, 'warnings': [],
            'seconds': 0.0, 'peak_mb': 0.0}
