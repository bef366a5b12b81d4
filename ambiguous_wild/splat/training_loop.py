"""The loop around `Trainer.step`: the clock, probes and timeline, checkpoints, rollbacks, and Ctrl-C."""

from __future__ import annotations

import logging
import signal
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from typing import Any

from ambiguous_wild.splat.trainer import Trainer
from ambiguous_wild.splat.training_records import ROWS
from ambiguous_wild.splat.watchdog import NonFinite

LOG = logging.getLogger(__name__)
Tick = Callable[[Trainer], object]  # called after an iteration, with the clock stopped


class Stopped(KeyboardInterrupt):
    """Ctrl-C during training; the checkpoint holds the run as it was after its last iteration."""


@contextmanager
def defer_interrupt() -> Iterator[Callable[[], bool]]:
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


def train(trainer: Trainer, tick: Tick | None = None) -> None:
    """Train to the end, with checkpoints and probes on schedule.

    Args:
        trainer: where it stands, new or resumed.
        tick: called after every iteration with the clock stopped (progress bars).

    Raises:
        NonFinite: a value is not finite; the message names view, iteration and parameters.
        Stopped: Ctrl-C was pressed; the iteration was completed and saved.
    """
    if trainer.config.on_nonfinite == "rollback" and not trainer.checkpoint_path.exists():
        trainer.save()  # so that even the first iteration can be rolled back
    LOG.info("training")
    meter = None if trainer.done else trainer.meter
    if meter is not None:
        meter.begin(trainer.clock.now())
    last_save = time.monotonic()
    try:
        with defer_interrupt() as interrupted:
            while not (trainer.done and _save_if_finite(trainer)):
                if trainer.done:
                    continue  # the run was rolled back, and its last checkpoint is checked
                advance(trainer, tick)
                if interrupted():
                    _save_if_finite(trainer)
                    raise Stopped
                if time.monotonic() - last_save > trainer.config.checkpoint_every_s and not trainer.done:
                    _save_if_finite(trainer)
                    last_save = time.monotonic()
    finally:
        if meter is not None:
            meter.end()


def advance(trainer: Trainer, tick: Tick | None = None) -> None:
    """Run one iteration with its bookkeeping, or roll back if a value is not finite."""
    if trainer.marks is None:
        trainer.marks = _marks(trainer)
    trainer.clock.start()
    try:
        loss = trainer.step()
    except NonFinite as error:
        trainer.clock.stop()
        _roll_back(trainer, error)
        return
    trainer.clock.stop()
    trainer.timeline.loss(loss)
    # Marks are compared with those of the last step, not with the clock before this one: under a budget
    # the clock may pass a mark between two steps.
    before, passed = trainer.marks, _marks(trainer)
    done, meter = trainer.progress(trainer.iteration), trainer.meter
    calibrating = meter is not None and meter.due(trainer.clock.now(), done)
    if passed != before or calibrating:
        trainer.clock.settle_stopped()
        passed = _marks(trainer)
    trainer.marks = passed
    if passed != before:
        # right after an opacity reset the renders are nearly empty
        reset = trainer.density.last_reset == trainer.iteration
        _add_row(trainer, probing=passed[0] > before[0] and not reset)
    if tick is not None:
        tick(trainer)
    if meter is not None and calibrating:
        meter.calibrate(trainer.clock.now())


def _marks(trainer: Trainer) -> tuple[int, int]:
    """Return how many probes and timeline rows are due since the start of the run."""
    now = (trainer.iteration, trainer.clock.now())
    return trainer.run_schedule.marks(trainer.config.probes, *now), trainer.run_schedule.marks(ROWS, *now)


def _save_if_finite(trainer: Trainer) -> bool:
    """Save, unless a parameter is not finite: that is handled as a finding of the last step."""
    try:
        trainer.check_parameters()
    except NonFinite as error:
        _roll_back(trainer, error)
        return False
    trainer.save()
    return True


def _roll_back(trainer: Trainer, error: NonFinite) -> None:
    """Store what reproduces a finding of the watchdog; then roll back, or raise the finding.

    A rollback restores the last checkpoint and leaves the photo out for the rest of its epoch. The clock
    is not set back.
    """
    watchdog = trainer.watchdog
    where = watchdog.snapshot(trainer.checkpoint_path, error)
    if not watchdog.rolls_back:
        raise watchdog.final_error(error, where)
    spent, rollbacks = trainer.clock, list(watchdog.rollbacks)
    trainer.resume()
    trainer.clock = spent
    epoch = trainer.run_schedule.epoch(error.finding.iteration)
    watchdog.note_rollback(error, rollbacks, epoch=epoch, iteration=trainer.iteration)
    trainer.save()


def _add_row(trainer: Trainer, *, probing: bool) -> None:
    """Add a row to the timeline, with the test PSNR if a probe is due."""
    row = trainer.timeline.add(trainer.iteration, len(trainer.gaussians), trainer.clock)
    if probing and trainer.probe is not None:
        spent = dict(trainer.clock.parts_s)
        row["psnr_probe"] = trainer.probe(trainer.picture)
        trainer.clock.parts_s = spent
        LOG.debug(
            "iteration %d: test PSNR %.2f dB, %d Gaussians, %.1f ms/iteration",
            trainer.iteration, row["psnr_probe"], len(trainer.gaussians), trainer.ms_per_iteration,
        )  # fmt: skip
