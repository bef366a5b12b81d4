"""A progress bar on standard error that threads may advance; a line where that is no terminal."""

from __future__ import annotations

import sys
import threading

from tqdm import tqdm

from ambiguous_wild.io.terminal import keep_clock_running, say


class Bar:
    """One bar for all stages, one after the other; with `enabled=False` every call does nothing."""

    def __init__(self, enabled: bool = True) -> None:
        self.enabled = enabled
        self._bar: tqdm | None = None
        self._lock = threading.Lock()

    def start(self, what: str, total: int | None) -> None:
        """Begin a bar of `total` steps; None: unknown number."""
        self.finish()
        if self.enabled:
            self._bar = tqdm(total=total, desc=what, file=sys.stderr, leave=False, disable=None)
            keep_clock_running(self._bar)
            if self._bar.disable:
                say(what)

    def step(self, count: int = 1) -> None:
        """Advance by `count`."""
        with self._lock:
            if self._bar is not None:
                self._bar.update(count)

    def at(self, position: int) -> None:
        """Set the position; never moves back."""
        with self._lock:
            if self._bar is not None and position > self._bar.n:
                self._bar.update(position - int(self._bar.n))

    def finish(self) -> None:
        """Close the bar."""
        with self._lock:
            if self._bar is not None:
                self._bar.close()
                self._bar = None

    def say(self, text: str) -> None:
        """Print a line on standard error."""
        self.finish()
        if self.enabled:
            say(text)
