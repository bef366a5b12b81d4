"""Records of a run: training time, timeline, positions of added and merged Gaussians."""

from __future__ import annotations

import csv
import io
import math
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import astuple, dataclass, field
from pathlib import Path
from typing import Any, Protocol

import torch
from torch import Tensor

from ambiguous_wild.core.config import State
from ambiguous_wild.io.files import write_text

# On a GPU the parts of every 17th step are timed, because an event costs a launch. The number is prime:
# growth comes every hundredth step, merging every thousandth; a divisor of these would time them too often.
SAMPLED = 17
ROWS = 100  # rows of a timeline
MAX_POSITIONS = 20_000  # positions kept of each kind: enough for a picture, small in every checkpoint


class Clock:
    """Seconds of training so far: wall time, processor time, and the wall time of each part of a step."""

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

    @contextmanager
    def paused(self) -> Iterator[None]:
        """Do what is no training without its time; a clock that does not run stays stopped."""
        running = self._since is not None
        self.stop()
        try:
            yield
        finally:
            if running:
                self.start()

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
        """Wait until all launched work is done; call it before stopping the clock to read it."""

    def settle_stopped(self) -> None:
        """Do as `settle` for a stopped clock; the time that launched work still takes is added."""


class GpuClock(Clock):
    """A clock that times parts with GPU events, because the host finishes a step long before the GPU."""

    def __init__(
        self,
        elapsed_s: float = 0.0,
        parts_s: dict[str, float] | None = None,
        *,
        event: Callable[[], Any] | None = None,  # makes an event: record, synchronize, elapsed_time in ms
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
    """Return the clock for a run on this device."""
    return (GpuClock if device.type == "cuda" else Clock)(elapsed_s, parts_s)


class RunObserver(Protocol):
    """Watches the machine while a run trains; it is called with the run's clock stopped.

    `harness.meter.Meter` is one; this package cannot import it.
    """

    def begin(self, trained_s: float) -> None: ...

    def due(self, trained_s: float, progress: float) -> bool: ...

    def calibrate(self, trained_s: float) -> None: ...

    def end(self) -> None: ...

    def state_dict(self) -> State: ...

    def load_state_dict(self, state: State) -> None: ...


Row = dict[str, float | None]  # one row of a timeline, see `Timeline.add`


class Timeline:
    """The rows of timeline.csv; collects the loss between two rows."""

    def __init__(self) -> None:
        self.rows: list[Row] = []
        self.loss_sum: float | Tensor = 0.0  # since the last row
        self.loss_count = 0
        self.before_s = 0.0  # seconds of earlier trainings that belong to this one

    def loss(self, value: float | Tensor) -> None:
        """Add the loss of one iteration; NaN (of a photo that was left out) is ignored.

        A tensor is added on its device, so that the host need not wait.
        """
        if isinstance(value, Tensor) or not math.isnan(value):
            self.loss_sum, self.loss_count = self.loss_sum + value, self.loss_count + 1

    def add(self, iteration: int, gaussians: int, clock: Clock) -> Row:
        """Append a row and return it; the caller may set its "psnr_probe", the PSNR of the test views."""
        row: Row = {
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
        """Write timeline.csv, with empty cells where nothing was measured."""
        names = list(dict.fromkeys(name for row in self.rows for name in row))
        text = io.StringIO()
        writer = csv.DictWriter(text, names, lineterminator="\n", restval="")
        writer.writeheader()
        writer.writerows(self.rows)
        write_text(path, text.getvalue())


@dataclass
class SampledPositions:
    """Positions [n, 3] in the world, thinned evenly to at most `MAX_POSITIONS` without random numbers."""

    xyz: Tensor = field(default_factory=lambda: torch.zeros(0, 3))
    stride: int = 1  # one in `stride` positions is kept
    passed: int = 0  # number of positions added so far, kept or not

    def add(self, xyz: Tensor) -> None:
        """Add positions [n, 3] in this order."""
        first = -self.passed % self.stride
        self.passed += len(xyz)
        self.xyz = torch.cat([self.xyz, xyz.detach()[first :: self.stride].cpu()])
        while len(self.xyz) > MAX_POSITIONS:
            self.xyz = self.xyz[::2].clone()
            self.stride *= 2


@dataclass
class Round:
    """Numbers of Gaussians in one round of growth."""

    iteration: int
    cloned: int = 0
    split: int = 0
    pruned: int = 0
    merged: int = 0  # removed by merging
    count: int = 0  # after the round


@dataclass
class DensityLog:
    """Rounds of growth in order, and positions of the Gaussians that they made."""

    rounds: list[Round] = field(default_factory=list)
    added: SampledPositions = field(default_factory=SampledPositions)  # by cloning and splitting
    merged: SampledPositions = field(default_factory=SampledPositions)  # in place of merged Gaussians

    def begin(self, iteration: int) -> None:
        """Start a round."""
        self.rounds.append(Round(iteration))

    @property
    def now(self) -> Round:
        """The current round; one of iteration 0 if none was started."""
        if not self.rounds:
            self.begin(0)
        return self.rounds[-1]

    def grew(self, cloned: int, split: int, xyz: Tensor) -> None:
        """Note that growth made Gaussians at `xyz` [n, 3]."""
        self.now.cloned, self.now.split = cloned, split
        self.added.add(xyz)

    def merge(self, removed: int, xyz: Tensor) -> None:
        """Note that merging removed this many Gaussians and left one at each of `xyz` [n, 3]."""
        self.now.merged += removed
        self.merged.add(xyz)

    def state_dict(self) -> State:
        return {
            "rounds": [list(astuple(round_)) for round_ in self.rounds],
            "added": dict(vars(self.added)),
            "merged": dict(vars(self.merged)),
        }

    def load_state_dict(self, state: State) -> None:
        self.rounds = [Round(*row) for row in state["rounds"]]
        self.added, self.merged = SampledPositions(**state["added"]), SampledPositions(**state["merged"])
