# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Progress bars, and a line now and then in their place in a pipe or a log."""

from typing import Any

from tqdm import tqdm

EVERY_S = 300.0  # of the lines where nobody watches


class Progress(tqdm):  # type: ignore[misc]
    """A progress bar on a terminal; elsewhere a line every five minutes, and at its end."""

    disable: bool
    _ends, _told = False, 0.0

    def display(self, msg: str | None = None, pos: int | None = None) -> bool:
        """Draw it; without a terminal only now and then."""
        if self.fp.isatty():
            return bool(super().display(msg, pos))
        seconds = self.format_dict['elapsed']
        now = self.n != self.total and seconds > self._told + EVERY_S
        if msg is None and self.n and (self._ends or now):
            self.fp.write(str(self) + '\n' * (not self._ends))  # close() adds the last one
            self.fp.flush()
            self._told = seconds
        return False

    def clear(self, *args: Any, **kwargs: Any) -> None:
        """Make room for other output, where there is a bar."""
        if self.fp.isatty():
            super().clear(*args, **kwargs)

    def close(self) -> None:
        """End it, leaving its last state."""
        self._ends = True
        if not self.disable and not self.n and not self.fp.isatty():  # nothing was to be done
            self._decr_instances(self)
            self.disable = True
        super().close()
