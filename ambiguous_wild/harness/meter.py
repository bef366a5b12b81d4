"""Measures how busy the machine is while a run trains, and what its time is worth elsewhere.

The trainer calls the meter with its clock stopped: before the first step, now and then, after the last one.
Each time a calibration kernel is timed. Its work and the record's are no part of the training time.
"""

from __future__ import annotations

import contextlib
import getpass
import math
import os
import tempfile
import time
import uuid
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import torch
from filelock import FileLock, Timeout

from ambiguous_wild.harness.result_file import Cost, TimeRecord
from ambiguous_wild.harness.timing import Verdict, in_reference_seconds
from ambiguous_wild.splat.calibration import KERNELS, Reading, calibration

_STAT = Path("/proc/stat")
_IDLE = (3, 4)  # fields of a line of /proc/stat: idle, waiting for a disk
_GUEST = (8, 9)  # counted in user and nice already


def cores() -> int:
    """Processors that this process may use."""
    return len(_allowed()) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def busy_s() -> float | None:
    """Seconds that these processors have worked since the machine started, for anybody; None = not known.

    What a hypervisor gave to other machines counts as work of others.
    """
    allowed = {f"cpu{k}" for k in _allowed()}
    try:
        lines = [line.split() for line in _STAT.read_text(encoding="ascii").splitlines()]
        rows = [[int(n) for n in line[1:]] for line in lines if line and line[0] in allowed]
    except (OSError, ValueError):
        return None
    if not rows:
        return None
    ticks = sum(n for row in rows for k, n in enumerate(row) if k not in _IDLE and k not in _GUEST)
    return ticks / float(os.sysconf("SC_CLK_TCK"))


def own_s() -> float:
    """Processor seconds of this process and of its children that have ended."""
    times = os.times()
    return time.process_time() + times.children_user + times.children_system


def unit(device: str) -> str:
    """What runs on this device share: the processors, or one GPU by its identity."""
    return _gpu_name(device) if device.startswith("cuda") else "cpu"


class Presence:
    """Says that a run of ours works here, and counts the others that say so."""

    def __init__(self, unit: str, folder: Path | None = None) -> None:
        """
        Args:
            unit: runs with the same one share it, see `unit`.
            folder: where runs leave a locked file each; None = one of this user on this machine.
        """
        safe = "".join(c if c.isalnum() or c == "-" else "-" for c in unit)
        self.folder = (_own_folder() if folder is None else folder) / safe

    @contextmanager
    def here(self) -> Iterator[None]:
        """Be counted meanwhile; the system frees the file even of a process that was killed."""
        lock = None
        with contextlib.suppress(OSError):  # a temporary folder that cannot be written: nobody is counted
            self.folder.mkdir(parents=True, exist_ok=True)
            path = self.folder / f"{os.getpid()}-{uuid.uuid4().hex[:8]}.lock"
            lock = FileLock(path, timeout=1.0, thread_local=False)
            with contextlib.suppress(Timeout):
                lock.acquire()
        try:
            yield
        finally:
            if lock is not None:
                with contextlib.suppress(OSError):
                    lock.release()
                    Path(lock.lock_file).unlink(missing_ok=True)

    def count(self) -> int:
        """Runs here now, this one included; files of processes that are gone are removed."""
        try:
            paths = sorted(self.folder.glob("*.lock"))
        except OSError:
            return 1
        return max(1, sum(_is_held(path) for path in paths))


def _is_held(path: Path) -> bool:
    lock = FileLock(path, timeout=0.0, thread_local=False)
    try:
        lock.acquire()
    except Timeout:
        return True
    except OSError:
        return False
    with contextlib.suppress(OSError):
        path.unlink(missing_ok=True)
        lock.release()
    return False


def _allowed() -> set[int]:
    if hasattr(os, "sched_getaffinity"):
        return set(os.sched_getaffinity(0))
    return set(range(os.cpu_count() or 1))


def _gpu_name(device: str) -> str:
    import torch

    index = torch.device(device).index or 0
    try:
        name = getattr(torch.cuda.get_device_properties(index), "uuid", None)
    except (RuntimeError, AssertionError):  # a torch without CUDA
        name = None
    return f"GPU-{name}" if name is not None else str(index)


def _own_folder() -> Path:
    try:
        user = getpass.getuser()
    except (OSError, KeyError, ImportError):
        user = "user"
    return Path(tempfile.gettempdir()) / f"ambiguous_wild-runs-{user}"


# One calibration is off by a tenth, on a busy machine by a fifth: a run needs about 20 of them.
LEAST_S = 1.0  # of training between two calibrations
SHARE = 1 / 20  # of the training so far
EVERY_S = 15.0  # at most
OTHERS = 0.1  # a run is contended where others use more than this share of the processors that it needs
VARIED = 1.3  # or where the machine is this many times slower in one part of the training than in another
LEAST_GAIN = 0.15  # processors that several threads get more than one, or they are not told apart
PARTS = 5  # of the training that are compared
PART_SAMPLES = 4  # that a part has at least
COVERED = 0.9  # of the training must lie between the first and the last calibration


class Meter:
    """Of one run; its state lies in the run's checkpoint, so that a resumed run is judged as a whole."""

    def __init__(
        self,
        device: str,
        threads: int,
        *,
        read: Callable[[], Reading] | None = None,
        presence: Presence | None = None,
    ) -> None:
        """
        Args:
            device: "cpu" or "cuda".
            threads: that the training uses.
            read: calibrates once; None = with the kernel of the device.
            presence: counts runs; None = those of this machine or GPU.
        """
        self.device, self.threads = device, threads
        self.kernel = KERNELS["cuda" if device.startswith("cuda") else "cpu"]
        self._read = read or (lambda: calibration(torch.device(device)).read())
        self.presence = presence or Presence(unit(device))
        self._stack = ExitStack()
        self.samples: list[list[float]] = []  # trained seconds and the numbers of a Reading; NaN = none
        self.runs = 1
        # of the intervals so far: seconds, processor seconds of this run, and of others
        self.wall_s = self.own_s = self.others_s = 0.0
        self.blind = False  # others' work could not be measured
        self._since: tuple[float, float | None, float] | None = None

    @classmethod
    def of(cls, device: str) -> Meter:
        """Of a training in this process, with the threads that it was given."""
        import numba

        return cls(device, int(numba.get_num_threads()) if device == "cpu" else 1)

    # -- called by the trainer ---------------------------------------------------------------------

    def begin(self, trained_s: float) -> None:
        """Before the first step of this process."""
        self._stack.enter_context(self.presence.here())
        self._sample(trained_s)
        self._since = self._now()

    def due(self, trained_s: float, progress: float) -> bool:
        """Whether a calibration is due after an iteration; `progress` in [0, 1]."""
        ago = trained_s - self.samples[-1][0]
        if progress >= 1.0:
            return ago > 0.0
        return ago >= min(max(LEAST_S, SHARE * trained_s), EVERY_S)

    def look(self, trained_s: float) -> None:
        """Calibrate, and note what others did since the last time."""
        self._close()
        self._sample(trained_s)
        self._since = self._now()

    def end(self, trained_s: float) -> None:
        """After the last step, or where the training stops with an error."""
        if self._since is not None:
            self._close()
        self._since = None
        self._stack.close()

    def state_dict(self) -> dict[str, Any]:
        """Plain values for a checkpoint, the open interval included."""
        wall, own, others, blind = self._interval()
        return {
            "samples": [list(sample) for sample in self.samples],
            "runs": self.runs,
            "wall_s": self.wall_s + wall,
            "own_s": self.own_s + own,
            "others_s": self.others_s + others,
            "blind": self.blind or blind,
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Go on from a checkpoint; a rollback in the middle of a training keeps what was spent and seen."""
        if self._since is not None:
            return
        self.samples = [list(map(float, sample)) for sample in state["samples"]]
        self.runs, self.blind = int(state["runs"]), bool(state["blind"])
        self.wall_s, self.own_s, self.others_s = (float(state[k]) for k in ("wall_s", "own_s", "others_s"))

    # -- what it found -----------------------------------------------------------------------------

    def cost(self, trained_s: float) -> Cost:
        """reference_s and the record of the time, for the cost of a run."""
        verdict, reason = self.verdict(trained_s)
        record: TimeRecord = {
            "verdict": verdict,
            "reason": reason,
            "kernel": self.kernel.name,
            "kernel_reference_s": self.kernel.reference_s,
            "samples": self.kernel_samples(),
            "runs": self.runs,
        }
        share = self.parallel_share()
        if not math.isnan(share):
            record["parallel_share"] = share
        if self.wall_s > 0.0 and not self.blind:
            record["others"] = self.others_s / self.wall_s
        cost: Cost = {"timing": record}
        if self.samples:
            found = in_reference_seconds(record["samples"], self.kernel.reference_s, [trained_s])
            cost["reference_s"] = float(found[0])
        return cost

    def parallel_share(self) -> float:
        """Share of the time in which several threads worked; NaN where it cannot be told.

        From the processors that the training got, between those of the calibration on one thread and on all.
        """
        if not self.samples or self.wall_s <= 0.0:
            return math.nan
        _, _, many, serial_s, one = np.mean(np.array(self.samples), axis=0)
        if math.isnan(serial_s) or many - one < LEAST_GAIN:
            return math.nan
        return float(np.clip((self.own_s / self.wall_s - one) / (many - one), 0.0, 1.0))

    def kernel_samples(self) -> list[list[float]]:
        """(seconds of training, seconds of the kernel were it as parallel as the training)."""
        share = self.parallel_share()
        if math.isnan(share):
            return [sample[:2] for sample in self.samples]
        kernel = self.kernel
        found = []
        for at, seconds, _, serial_s, _ in self.samples:
            speed = share * kernel.reference_s / seconds
            speed += (1.0 - share) * kernel.serial_reference_s / serial_s
            found.append([at, kernel.reference_s / speed])
        return found

    def verdict(self, trained_s: float) -> tuple[Verdict, str]:
        """Whether the run was alone, and why not."""
        if self.runs > 1:
            where = "this GPU" if self.device.startswith("cuda") else "the machine"
            return "contended", f"{self.runs} runs shared {where}"
        others = self.others_s / self.wall_s if self.wall_s > 0.0 else 0.0
        total = cores()
        needed = min(self.threads, total)
        if others - (total - needed) > OTHERS * needed:
            return "contended", f"other programs used {others:.1f} of {total} processors"
        ratio = speed_ratio([sample[1] for sample in self.samples])
        if ratio > VARIED:
            return "contended", f"the machine's speed varied {ratio:.1f} times during the training"
        span = self.samples[-1][0] - self.samples[0][0] if self.samples else 0.0
        if span < COVERED * trained_s:
            share = 100.0 * span / trained_s if trained_s > 0.0 else 0.0
            return "unknown", f"calibrations cover {share:.0f} % of the training"
        if self.blind and len(self.samples) < 3:
            return "unknown", "this system does not tell what other programs used, and the run was short"
        return "alone", ""

    # -- inside ------------------------------------------------------------------------------------

    def _sample(self, trained_s: float) -> None:
        reading = self._read()
        serial_s = math.nan if reading.serial_s is None else reading.serial_s
        self.samples.append(
            [trained_s, reading.seconds, reading.processors, serial_s, reading.serial_processors]
        )
        self.runs = max(self.runs, self.presence.count())

    def _now(self) -> tuple[float, float | None, float]:
        return time.monotonic(), busy_s(), own_s()

    def _interval(self) -> tuple[float, float, float, bool]:
        """Since the last calibration: seconds, processor seconds of this run and of others, and whether
        those of others are unknown."""
        if self._since is None:
            return 0.0, 0.0, 0.0, False
        (begin, busy, own), (now, busy_now, own_now) = self._since, self._now()
        if busy is None or busy_now is None:
            return now - begin, own_now - own, 0.0, True
        return now - begin, own_now - own, max(busy_now - busy - (own_now - own), 0.0), False

    def _close(self) -> None:
        wall, own, others, blind = self._interval()
        self.wall_s, self.own_s, self.others_s = self.wall_s + wall, self.own_s + own, self.others_s + others
        self.blind = self.blind or blind


def speed_ratio(kernel_s: Sequence[float]) -> float:
    """Slowest over fastest part of a training, by the medians of their calibrations; 1 with too few."""
    parts = min(PARTS, len(kernel_s) // PART_SAMPLES)
    if parts < 2:
        return 1.0
    medians = [float(np.median(part)) for part in np.array_split(np.asarray(kernel_s), parts)]
    return max(medians) / min(medians)
