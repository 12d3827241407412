# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Run the command line: python -m tap_ros."""

import os
import signal
import sys
from typing import Any


def leave(*_: Any) -> None:
    """End at once: an interrupted import comes out as any other error."""
    os.write(2, b'interrupted\n')
    os._exit(130)


if __name__ == '__main__':
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:  # no job in the background
        signal.signal(signal.SIGINT, leave)
    from tap_ros.cli import main
    sys.exit(main(leave=leave))
