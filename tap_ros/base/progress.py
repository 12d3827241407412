# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Progress bars, and one line in their place where nobody watches: in a pipe, or a log."""

from typing import Any

from tqdm import tqdm


class Progress(tqdm):  # type: ignore[misc]
    """A progress bar on a terminal; elsewhere it prints one line, at its end."""

    _ends = False

    def display(self, msg: str | None = None, pos: int | None = None) -> bool:
        """Draw it; without a terminal only when it ends."""
        if self.fp.isatty():
            return bool(super().display(msg, pos))
        if self._ends and msg is None:
            self.fp.write(str(self))  # close() adds the end of the line
        return False

    def clear(self, *args: Any, **kwargs: Any) -> None:
        """Make room for other output, where there is a bar."""
        if self.fp.isatty():
            super().clear(*args, **kwargs)

    def close(self) -> None:
        """End it, leaving its last state."""
        self._ends = True
        super().close()
