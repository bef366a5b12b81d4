"""What is written down of a run: training time, the timeline, and what density control did where."""

from __future__ import annotations

import csv
import io
import math
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from ambiguous_wild.io.files import write_text

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


ROWS = 100


class Timeline:
    """Collects the loss between two rows; rows are plain dicts, see `add`."""

    def __init__(self) -> None:
        self.rows: list[dict[str, Any]] = []
        self.loss_sum: float | Tensor = 0.0  # since the last row
        self.loss_count = 0
        self.before_s = 0.0  # seconds of earlier trainings that belong to this one

    def loss(self, value: float | Tensor) -> None:
        """Take the loss of one iteration; NaN (a photo left out) does not count.

        A tensor is added up where it is: nobody waits for it.
        """
        if isinstance(value, Tensor) or not math.isnan(value):
            self.loss_sum, self.loss_count = self.loss_sum + value, self.loss_count + 1

    def add(self, iteration: int, gaussians: int, clock: Clock) -> dict[str, Any]:
        """A new row; returns it, with room for the PSNR of the test views."""
        row: dict[str, Any] = {
            "wall_s": round(self.before_s + clock.now(), 3),
            "iteration": iteration,
            "loss": float(self.loss_sum) / max(self.loss_count, 1),
            "gaussians": gaussians,
            "psnr_probe": None,
        }
        self.loss_sum, self.loss_count = 0.0, 0
        parts = clock.parts_s.items()
        row |= {f"ms_{name.replace(' ', '_')}": 1e3 * s / max(iteration, 1) for name, s in parts}
        self.rows.append(row)
        return row

    def write(self, path: Path) -> None:
        """timeline.csv: one line a row; empty cells where nothing was measured."""
        names = list(dict.fromkeys(name for row in self.rows for name in row))
        text = io.StringIO()
        writer = csv.DictWriter(text, names, lineterminator="\n", restval="")
        writer.writeheader()
        writer.writerows({k: "" if v is None else v for k, v in row.items()} for row in self.rows)
        write_text(path, text.getvalue())


MOST = 20_000  # positions kept of a kind; more would tell a picture nothing and weigh on every checkpoint


@dataclass
class Places:
    """Positions [n, 3] in the world, evenly thinned to `MOST` at most; draws no random numbers."""

    xyz: Tensor = field(default_factory=lambda: torch.zeros(0, 3))
    stride: int = 1  # every so many-th position is kept
    passed: int = 0  # positions shown so far

    def add(self, xyz: Tensor) -> None:
        """Take in positions [n, 3] in their order."""
        first = -self.passed % self.stride
        self.passed += len(xyz)
        self.xyz = torch.cat([self.xyz, xyz.detach()[first :: self.stride].cpu()])
        while len(self.xyz) > MOST:
            self.xyz = self.xyz[::2].clone()
            self.stride *= 2


@dataclass
class Round:
    """One round of growth, in Gaussians."""

    iteration: int
    cloned: int = 0
    split: int = 0
    pruned: int = 0
    merged: int = 0  # that merging removed
    count: int = 0  # afterwards


@dataclass
class DensityLog:
    """Rounds in order, and where Gaussians came to be."""

    rounds: list[Round] = field(default_factory=list)
    added: Places = field(default_factory=Places)  # by cloning and splitting
    merged: Places = field(default_factory=Places)  # what merging put in the place of several

    def begin(self, iteration: int) -> None:
        """A round starts."""
        self.rounds.append(Round(iteration))

    @property
    def now(self) -> Round:
        """The round under way; one before the first where density is driven by hand."""
        if not self.rounds:
            self.begin(0)
        return self.rounds[-1]

    def grew(self, cloned: int, split: int, xyz: Tensor) -> None:
        """Growth made Gaussians at `xyz` [n, 3]."""
        self.now.cloned, self.now.split = cloned, split
        self.added.add(xyz)

    def merge(self, removed: int, xyz: Tensor) -> None:
        """Merging removed so many and left one at each of `xyz` [n, 3]."""
        self.now.merged += removed
        self.merged.add(xyz)

    def state_dict(self) -> dict[str, Any]:
        return {
            "rounds": [[r.iteration, r.cloned, r.split, r.pruned, r.merged, r.count] for r in self.rounds],
            **{
                name: {"xyz": places.xyz, "stride": places.stride, "passed": places.passed}
                for name, places in (("added", self.added), ("merged", self.merged))
            },
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        self.rounds = [Round(*row) for row in state["rounds"]]
        self.added, self.merged = Places(**state["added"]), Places(**state["merged"])
