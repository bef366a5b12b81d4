"""A run from its first to its last iteration: the clock, probes, the timeline, checkpoints, rollbacks."""

from __future__ import annotations

import logging
import signal
import threading
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, Protocol

import torch
from torch import Tensor

from ambiguous_wild.core import AwError, Camera
from ambiguous_wild.core.config import State
from ambiguous_wild.splat import checkpoint
from ambiguous_wild.splat.gaussians import Gaussians
from ambiguous_wild.splat.optim import SplatAdam
from ambiguous_wild.splat.pace import Pace, TrainConfig
from ambiguous_wild.splat.rendered import Rendered
from ambiguous_wild.splat.step import TrainData
from ambiguous_wild.splat.training_records import ROWS, Clock, Timeline, clock_for
from ambiguous_wild.splat.watchdog import DeviceFiniteCheck, NonFinite, Watchdog

LOG = logging.getLogger(__name__)
Probe = Callable[[Callable[[Camera], Tensor]], float]


class Stopped(KeyboardInterrupt):
    """Ctrl-C during training; the checkpoint holds the run as it was after its last iteration."""


@contextmanager
def deferred() -> Iterator[Callable[[], bool]]:
    """Defer Ctrl-C inside of the context; yields a function that tells whether it was pressed.

    A second Ctrl-C interrupts at once. Outside of the main thread, or if another handler is installed for the
    signal, nothing changes.
    """
    main = threading.current_thread() is threading.main_thread()
    if not main or signal.getsignal(signal.SIGINT) is not signal.default_int_handler:
        yield lambda: False
        return
    noted = threading.Event()

    def note(number: int, frame: Any) -> None:
        noted.set()
        signal.signal(signal.SIGINT, signal.default_int_handler)
        with suppress(RuntimeError):  # the signal may interrupt a write to the same stream
            LOG.warning("stopping: the model is measured and saved, Ctrl-C again to quit")

    signal.signal(signal.SIGINT, note)
    try:
        yield noted.is_set
    finally:
        signal.signal(signal.SIGINT, signal.default_int_handler)


class RunObserver(Protocol):
    """Watches the machine while a run trains; it is called with the run's clock stopped."""

    def begin(self, trained_s: float) -> None: ...

    def due(self, trained_s: float, progress: float) -> bool: ...

    def look(self, trained_s: float) -> None: ...

    def end(self, trained_s: float) -> None: ...

    def state_dict(self) -> State: ...

    def load_state_dict(self, state: State) -> None: ...


class Run(ABC):
    """What a trainer does around its steps; stops and resumes at any iteration with the same bits."""

    pace: Pace
    sentinel: DeviceFiniteCheck | None

    def __init__(self, data: TrainData, config: TrainConfig, folder: Path, probe: Probe | None) -> None:
        """
        Args:
            data: the training side.
            config: length and bookkeeping.
            folder: folder for checkpoint and timeline.
            probe: takes a function that renders a camera; returns PSNR in dB of the test views.
        """
        self.data, self.config, self.folder, self.probe = data, config, folder, probe
        names = [view.name for view in data.scene.train]
        self.watchdog = Watchdog(folder, config.on_nonfinite, config.seed, names)
        self.clock: Clock = clock_for(data.device)
        self.meter: RunObserver | None = None
        self._marks: tuple[int, int] | None = None  # probes and timeline rows due after the last step
        self.setup_s = 0.0  # seconds before the first step, in the process that began the run
        # "hash" of the run's configuration and "about", its name; empty = unknown
        self.whose: dict[str, str] = {}
        self.iteration = 0
        self.timeline = Timeline()
        self._skipped: set[int] = set()  # views that were fully masked at some step

    @property
    @abstractmethod
    def gaussians(self) -> Gaussians:
        """The static Gaussians: the model."""

    @property
    @abstractmethod
    def optimiser(self) -> SplatAdam:
        """The optimiser of the static Gaussians."""

    @abstractmethod
    def step(self) -> float | Tensor:
        """Run one iteration; returns its loss."""

    @abstractmethod
    def render(self, camera: Camera) -> Rendered:
        """Draw the model in its present state."""

    @abstractmethod
    def check_parameters(self) -> None:
        """Raise NonFinite for the last step if a parameter is not finite."""

    def state(self) -> State:
        """Return everything that decides how the run goes on; parts that are absent have no key.

        Subclasses add the state of the model.
        """
        rollbacks = self.watchdog.state_dict()
        return {
            **({"run": dict(self.whose)} if self.whose else {}),
            "iteration": self.iteration,
            "elapsed_s": self.clock.now(),
            "setup_s": self.setup_s,
            "parts_s": self.clock.parts_s,
            "cpu_s": self.clock.cpu_s,
            **({} if self.meter is None else {"meter": self.meter.state_dict()}),
            "timeline": self.timeline.rows,
            "loss": [float(self.timeline.loss_sum), self.timeline.loss_count],
            "skipped": sorted(self.skipped),
            **({"rollbacks": rollbacks} if rollbacks else {}),
        }

    def load_state(self, state: State) -> None:
        """Restore what `state` returned; exact, so that a resumed run gives the same bits.

        Raises:
            KeyError: a key is missing.
        """
        self.iteration = state["iteration"]
        self.setup_s = state["setup_s"]
        self.clock = clock_for(self.data.device, state["elapsed_s"], dict(state["parts_s"]))
        self.clock.cpu_s = state.get("cpu_s", 0.0)
        if self.meter is not None and "meter" in state:
            self.meter.load_state_dict(state["meter"])
        self._marks = None  # computed again from the new state
        self.timeline.rows = list(state["timeline"])
        self.timeline.loss_sum, self.timeline.loss_count = state["loss"]
        self._skipped = set(state["skipped"])
        self.watchdog.load_state_dict(state.get("rollbacks", []))

    def progress(self, iteration: int) -> float:
        """Return the share of the run done after `iteration` steps, in [0, 1]."""
        return self.pace.progress(iteration, self.clock.now())

    @property
    def done(self) -> bool:
        return self.progress(self.iteration) >= 1.0

    def train(self, *, tick: Callable[[Any], None] | None = None) -> None:
        """Train to the end, with checkpoints and probes on schedule.

        Args:
            tick: called after every iteration with the clock stopped (progress bars).

        Raises:
            NonFinite: a value is not finite; the message names view, iteration and parameters.
            Stopped: Ctrl-C was pressed; the iteration was completed and saved.
        """
        if self.config.on_nonfinite == "rollback" and not self.checkpoint_path.exists():
            self.save()  # so that even the first iteration can be rolled back
        LOG.info("training")
        meter = None if self.done else self.meter
        if meter is not None:
            meter.begin(self.clock.now())
        try:
            with deferred() as interrupted:
                self._loop(tick, interrupted)
        finally:
            if meter is not None:
                meter.end(self.clock.now())

    def _loop(self, tick: Callable[[Any], None] | None, interrupted: Callable[[], bool]) -> None:
        last_save = time.monotonic()
        while True:
            if self.done:
                if self._save_if_sound():
                    return
                continue  # the run was rolled back: train on
            self._advance(tick)
            if interrupted():
                self._save_if_sound()
                raise Stopped
            if time.monotonic() - last_save > self.config.checkpoint_every_s and not self.done:
                self._save_if_sound()
                last_save = time.monotonic()

    def _advance(self, tick: Callable[[Any], None] | None) -> None:
        """Run one iteration with its bookkeeping, or roll back if a value is not finite."""
        if self._marks is None:
            self._marks = self._checkpoint_counts()
        self.clock.start()
        try:
            loss = self.step()
        except NonFinite as error:
            self.clock.stop()
            self._undo(error)
            return
        self.clock.stop()
        self.timeline.loss(loss)
        # Marks are compared with those of the last step, not with the clock before this one: under a budget
        # the clock may pass a mark between two steps.
        before, passed = self._marks, self._checkpoint_counts()
        done, meter = self.progress(self.iteration), self.meter
        calibrating = meter is not None and meter.due(self.clock.now(), done)
        if passed != before or calibrating:
            self.clock.settle_stopped()
            passed = self._checkpoint_counts()
        self._marks = passed
        if passed != before:
            self._log(passed[0] > before[0])
        if tick is not None:
            tick(self)
        if meter is not None and calibrating:
            meter.look(self.clock.now())

    def _checkpoint_counts(self) -> tuple[int, int]:
        """Return how many probes and timeline rows are due since the start of the run."""
        now = (self.iteration, self.clock.now())
        return self.pace.marks(self.config.probes, *now), self.pace.marks(ROWS, *now)

    def _save_if_sound(self) -> bool:
        """Save, unless a parameter is not finite: that is handled as a finding of the last step."""
        try:
            self.check_parameters()
        except NonFinite as error:
            self._undo(error)
            return False
        self.save()
        return True

    def _undo(self, error: NonFinite) -> None:
        """Store what reproduces a finding of the watchdog; then roll back, or raise the finding.

        A rollback restores the last checkpoint and leaves the photo out for the rest of its epoch. The clock
        is not set back.
        """
        where = self.watchdog.keep(self.checkpoint_path, error)
        if not self.watchdog.undoes:
            raise self.watchdog.final(error, where)
        spent, rollbacks = self.clock, list(self.watchdog.rollbacks)
        self.resume()
        self.clock = spent
        epoch = self.pace.epoch(error.finding.iteration)
        self.watchdog.note_rollback(error, rollbacks, epoch=epoch, iteration=self.iteration)
        self.save()

    def _log(self, probing: bool) -> None:
        row = self.timeline.add(self.iteration, len(self.gaussians), self.clock)
        if probing and self.probe is not None:
            spent = dict(self.clock.parts_s)
            row["psnr_probe"] = self.probe(self.picture)
            self.clock.parts_s = spent
            LOG.debug(
                "iteration %d: test PSNR %.2f dB, %d Gaussians, %.1f ms/iteration",
                self.iteration, row["psnr_probe"], len(self.gaussians), self.ms_per_iteration,
            )  # fmt: skip

    @torch.no_grad()
    def picture(self, camera: Camera) -> Tensor:
        """Draw a picture [H, W, 3] between two steps; the run has the same bits as without it.

        Rows that are pending in the optimiser are brought up to date, as a later step would have done.
        """
        return self.render(camera).image

    def check_photos_used(self) -> None:
        """Raise AwError if nothing was learnt: the loss was 0 in every row of the timeline."""
        rows = self.timeline.rows
        if rows and all(row["loss"] == 0.0 for row in rows):
            masked = len(self.skipped)
            why = (
                f"{masked} of {len(self.data.scene.train)} train photos are masked all over: mask less, or "
                "mend masks/train (white is kept)"
                if masked
                else "check the masks, poses, focal lengths and points of the scene"
            )
            raise AwError(f"the loss stayed 0 over {self.iteration} iterations, so nothing was learnt; {why}")

    @property
    def ms_per_iteration(self) -> float:
        return 1e3 * self.clock.now() / max(self.iteration, 1)

    @property
    def skipped_views(self) -> list[str]:
        """Names of train photos that were fully masked at some step, which was then skipped."""
        return sorted(self.data.scene.train[i].name for i in self.skipped)

    @property
    def skipped(self) -> set[int]:
        """Indices of train photos that were fully masked at some step."""
        return self._skipped | (self.sentinel.empty_views() if self.sentinel is not None else set())

    @property
    def checkpoint_path(self) -> Path:
        return self.folder / "checkpoint" / "last.safetensors"

    def save(self) -> None:
        """Write the state and the timeline, each atomically."""
        checkpoint.save(self.checkpoint_path, self.state())
        self.timeline.write(self.folder / "timeline.csv")

    def resume(self) -> bool:
        """Load the last checkpoint, if there is one; returns whether there was.

        Raises:
            AwError: the checkpoint is incomplete, or belongs to another run; the message names the file.
        """
        path = self.checkpoint_path
        if not path.exists():
            return False
        state = checkpoint.load(path)
        other = state.get("run", self.whose)  # checkpoints of earlier versions do not hold it
        if self.whose and other != self.whose:
            raise AwError(
                f"checkpoint {path} is of another run ({other.get('about')}, configuration "
                f"{str(other.get('hash'))[:12]}), this one is {self.whose['about']}, configuration "
                f"{self.whose['hash'][:12]}; delete it, or train again with --overwrite always"
            )
        try:
            self.load_state(state)
        except (KeyError, TypeError) as error:
            raise AwError(f"checkpoint {path} lacks {error}; train again with --overwrite always") from None
        if self.sentinel is not None:
            self.sentinel.reset()
        return True
