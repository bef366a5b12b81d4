"""Measure the load of the machine while a run trains, and convert its time to reference seconds.

The trainer calls the meter with its clock stopped: before the first step, at intervals, and after the last
step. Each time a calibration kernel is timed. None of this is part of the training time.
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

import numpy as np
import torch
from filelock import FileLock, Timeout

from ambiguous_wild.core.config import State
from ambiguous_wild.core.machine import allowed_cores
from ambiguous_wild.harness.result_file import Cost, TimeRecord
from ambiguous_wild.harness.timing import Verdict, in_reference_seconds
from ambiguous_wild.splat.calibration import KERNELS, CalibrationResult, calibration

_STAT = Path("/proc/stat")
_IDLE = (3, 4)  # fields of a line of /proc/stat: idle, waiting for a disk
_GUEST = (8, 9)  # counted in user and nice already
# The error of one calibration is a tenth, on a busy machine a fifth, so a run needs about 20 of them.
# Time between two calibrations: SHARE of the training so far, but from MIN_S to EVERY_S.
MIN_S = 1.0
SHARE = 1 / 10
EVERY_S = 15.0
OTHERS = 0.1  # a run is contended if others use more than this share of the processors that it needs
VARIED = 1.3  # or if the machine is this many times slower in one part of the training than in another
MIN_GAIN = 0.15  # extra processors that several threads must get, to be distinguished from one thread
PARTS = 5  # parts of the training that are compared
PART_SAMPLES = 4  # fewest calibrations of a part
COVERED = 0.9  # share of the training that must lie between the first and the last calibration


def busy_s() -> float | None:
    """Return the seconds that the allowed processors have worked since the machine started; None = unknown.

    Time that a hypervisor gave to other machines is included.
    """
    allowed = {f"cpu{k}" for k in allowed_cores()}
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
    """Return the processor seconds of this process and of its children that have ended."""
    times = os.times()
    return time.process_time() + times.children_user + times.children_system


def hardware_name(device: str) -> str:
    """Return a name for the hardware that runs on this device share: the processors, or a GPU's identity."""
    if not device.startswith("cuda"):
        return "cpu"
    index = torch.device(device).index or 0
    try:
        name = getattr(torch.cuda.get_device_properties(index), "uuid", None)
    except (RuntimeError, AssertionError):  # a torch without CUDA
        name = None
    return f"GPU-{name}" if name is not None else str(index)


class ActiveRuns:
    """Announce a run of this program to others on the same hardware, and count them."""

    def __init__(self, unit: str, folder: Path | None = None) -> None:
        """
        Args:
            unit: name of the shared hardware, see `hardware_name`.
            folder: where every run has a locked file; None = a folder of this user on this machine.
        """
        safe = "".join(c if c.isalnum() or c == "-" else "-" for c in unit)
        self.folder = (_own_folder() if folder is None else folder) / safe

    @contextmanager
    def announced(self) -> Iterator[None]:
        """Let others count this run until the `with` ends; the system unlocks files of killed processes."""
        lock = None
        with contextlib.suppress(OSError):  # if the temporary folder cannot be written, no run is counted
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
        """Return the number of runs now, this one included; files of ended processes are removed."""
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


def _own_folder() -> Path:
    try:
        user = getpass.getuser()
    except (OSError, KeyError, ImportError):
        user = "user"
    return Path(tempfile.gettempdir()) / f"ambiguous_wild-runs-{user}"


class Meter:
    """The meter of one run; its state is in the checkpoint, so that a resumed run is judged as a whole."""

    def __init__(
        self,
        device: str,
        threads: int,
        *,
        read: Callable[[], CalibrationResult] | None = None,
        presence: ActiveRuns | None = None,
    ) -> None:
        """
        Args:
            device: "cpu" or "cuda".
            threads: number of threads of the training.
            read: makes one calibration; None = with the kernel of the device.
            presence: counts runs; None = those on this machine or GPU.
        """
        self.device, self.threads = device, threads
        self.kernel = KERNELS["cuda" if device.startswith("cuda") else "cpu"]
        self._read = read or (lambda: calibration(torch.device(device)).read())
        self.presence = presence or ActiveRuns(hardware_name(device))
        self._stack = ExitStack()
        self.samples: list[list[float]] = []  # trained seconds and the numbers of a Reading; NaN = missing
        self.runs = 1
        # of the intervals so far: seconds, processor seconds of this run, and of others
        self.wall_s = self.own_s = self.others_s = 0.0
        self.blind = False  # True if the work of other programs could not be measured
        self._since: tuple[float, float | None, float] | None = None

    @classmethod
    def of(cls, device: str) -> Meter:
        """Make the meter of a training in this process, with the number of threads it has."""
        import numba

        return cls(device, int(numba.get_num_threads()) if device == "cpu" else 1)

    # -- called by the trainer ---------------------------------------------------------------------

    def begin(self, trained_s: float) -> None:
        """Start measuring, before the first step of this process."""
        self._stack.enter_context(self.presence.announced())
        self._sample(trained_s)
        self._since = self._now()

    def due(self, trained_s: float, progress: float) -> bool:
        """Return whether a calibration is due after an iteration; `progress` in [0, 1]."""
        ago = trained_s - self.samples[-1][0]
        if progress >= 1.0:
            return ago > 0.0
        return ago >= min(max(MIN_S, SHARE * trained_s), EVERY_S)

    def calibrate(self, trained_s: float) -> None:
        """Calibrate, and add the work of others since the last calibration."""
        self._close()
        self._sample(trained_s)
        self._since = self._now()

    def end(self) -> None:
        """Stop measuring, after the last step or an error."""
        if self._since is not None:
            self._close()
        self._since = None
        self._stack.close()

    def state_dict(self) -> State:
        """Return plain values for a checkpoint, with the time since the last calibration."""
        wall, own, others, blind = self._interval()
        return {
            "samples": [list(sample) for sample in self.samples],
            "runs": self.runs,
            "wall_s": self.wall_s + wall,
            "own_s": self.own_s + own,
            "others_s": self.others_s + others,
            "blind": self.blind or blind,
        }

    def load_state_dict(self, state: State) -> None:
        """Continue from a checkpoint; at a rollback within a training the current numbers are kept."""
        if self._since is not None:
            return
        self.samples = [list(map(float, sample)) for sample in state["samples"]]
        self.runs, self.blind = int(state["runs"]), bool(state["blind"])
        self.wall_s, self.own_s, self.others_s = (float(state[k]) for k in ("wall_s", "own_s", "others_s"))

    # -- results -----------------------------------------------------------------------------------

    def cost(self, trained_s: float) -> Cost:
        """Return reference_s and the record of the time, for the cost of a run."""
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
            (seconds,) = in_reference_seconds(record["samples"], self.kernel.reference_s, [trained_s])
            cost["reference_s"] = float(seconds)
        return cost

    def parallel_share(self) -> float:
        """Return the share of the time in which several threads worked; NaN where it is unknown.

        It is interpolated: the number of processors that the training used lies between those that the
        calibration used on one thread and on all.
        """
        if not self.samples or self.wall_s <= 0.0:
            return math.nan
        _, _, many, serial_s, one = np.mean(np.array(self.samples), axis=0)
        if math.isnan(serial_s) or many - one < MIN_GAIN:
            return math.nan
        return float(np.clip((self.own_s / self.wall_s - one) / (many - one), 0.0, 1.0))

    def kernel_samples(self) -> list[list[float]]:
        """Return (seconds of training, seconds of the kernel, if it were as parallel as the training)."""
        share = self.parallel_share()
        if math.isnan(share):
            return [sample[:2] for sample in self.samples]
        kernel = self.kernel
        samples = []
        for at, seconds, _, serial_s, _ in self.samples:
            speed = share * kernel.reference_s / seconds
            speed += (1.0 - share) * kernel.serial_reference_s / serial_s
            samples.append([at, kernel.reference_s / speed])
        return samples

    def verdict(self, trained_s: float) -> tuple[Verdict, str]:
        """Return whether the run was alone, and the reason if it was not."""
        if self.runs > 1:
            where = "this GPU" if self.device.startswith("cuda") else "the machine"
            return "contended", f"{self.runs} runs shared {where}"
        others = self.others_s / self.wall_s if self.wall_s > 0.0 else 0.0
        total = len(allowed_cores())
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
            return "unknown", "the use by other programs cannot be measured here, and the run was short"
        return "alone", ""

    # -- internal ----------------------------------------------------------------------------------

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
        """Return the time since the last calibration: seconds, processor seconds of this run and of others,
        and whether those of others are unknown."""
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
    """Return slowest over fastest part of a training, by the medians of calibrations; 1 if there are few."""
    parts = min(PARTS, len(kernel_s) // PART_SAMPLES)
    if parts < 2:
        return 1.0
    medians = [float(np.median(part)) for part in np.array_split(np.asarray(kernel_s), parts)]
    return max(medians) / min(medians)
