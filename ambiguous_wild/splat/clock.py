"""Training time alone: reading photos, probing and saving do not count."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import torch

# On a GPU the parts of every so many-th step are timed: an event costs a launch. A prime: growth comes every
# hundredth step, merging every thousandth, and a divisor of theirs would time them too often or never.
SAMPLED = 17


class Clock:
    """Seconds of training so far, by the wall and of all processors, and of each of its parts."""

    def __init__(self, elapsed_s: float = 0.0, parts_s: dict[str, float] | None = None) -> None:
        self.elapsed_s = elapsed_s
        self.parts_s = {} if parts_s is None else parts_s
        self.cpu_s = 0.0  # processor seconds of this process, all threads
        self._since: float | None = None
        self._cpu_since = 0.0

    def start(self) -> None:
        self._cpu_since = time.process_time()
        self._since = time.perf_counter()

    def stop(self) -> None:
        if self._since is not None:
            self.elapsed_s += time.perf_counter() - self._since
            self.cpu_s += time.process_time() - self._cpu_since
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

    def settle(self) -> None:
        """Wait for what was started but not finished; call it before the clock is stopped to be read."""

    def settle_stopped(self) -> None:
        """`settle` of a clock that has been stopped: what was started before counts."""


class GpuClock(Clock):
    """Parts by the GPU's own events: the host is done with a step long before the GPU is."""

    def __init__(
        self,
        elapsed_s: float = 0.0,
        parts_s: dict[str, float] | None = None,
        *,
        event: Callable[[], Any] | None = None,  # with record, synchronize, elapsed_time in ms
    ) -> None:
        super().__init__(elapsed_s, parts_s)
        self._event = event or (lambda: torch.cuda.Event(enable_timing=True))
        self._steps = 0
        self._open: list[tuple[str, Any, Any]] = []

    def start(self) -> None:
        super().start()
        self._steps += 1

    @contextmanager
    def part(self, name: str) -> Iterator[None]:
        if self._since is None or self._steps % SAMPLED:
            yield
            return
        begin, end = self._event(), self._event()
        begin.record()
        try:
            yield
        finally:
            end.record()
            self._open.append((name, begin, end))

    def settle(self) -> None:
        last = self._event()
        last.record()
        last.synchronize()
        for name, begin, end in self._open:
            spent = SAMPLED * begin.elapsed_time(end) / 1e3
            self.parts_s[name] = self.parts_s.get(name, 0.0) + spent
        self._open = []

    def settle_stopped(self) -> None:
        begin = time.perf_counter()
        self.settle()
        self.elapsed_s += time.perf_counter() - begin


def clock_for(device: torch.device, elapsed_s: float = 0.0, parts_s: dict[str, float] | None = None) -> Clock:
    """The clock of a run there."""
    return (GpuClock if device.type == "cuda" else Clock)(elapsed_s, parts_s)
