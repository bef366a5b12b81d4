"""Training time alone: reading photos, probing and saving do not count."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field


@dataclass
class Clock:
    """Seconds of training so far, and of each of its parts."""

    elapsed_s: float = 0.0
    parts_s: dict[str, float] = field(default_factory=dict)
    _since: float | None = None

    def start(self) -> None:
        self._since = time.perf_counter()

    def stop(self) -> None:
        if self._since is not None:
            self.elapsed_s += time.perf_counter() - self._since
            self._since = None

    def now(self) -> float:
        running = 0.0 if self._since is None else time.perf_counter() - self._since
        return self.elapsed_s + running

    @contextmanager
    def part(self, name: str) -> Iterator[None]:
        begin = time.perf_counter()
        try:
            yield
        finally:
            self.parts_s[name] = self.parts_s.get(name, 0.0) + time.perf_counter() - begin
