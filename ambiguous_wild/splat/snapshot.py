"""The whole state of a training run as one tree."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

from ambiguous_wild.core import AwError
from ambiguous_wild.splat.clock import clock_for

if TYPE_CHECKING:
    from ambiguous_wild.splat.trainer import Trainer


def take(trainer: Trainer) -> dict[str, Any]:
    """Everything that decides how the run goes on; parts that are not there leave no key."""
    rollbacks = trainer.watchdog.state_dict()
    others = trainer.drawing.state_dict()
    return {
        "iteration": trainer.iteration,
        "elapsed_s": trainer.clock.now(),
        "setup_s": trainer.setup_s,
        "parts_s": trainer.clock.parts_s,
        "cpu_s": trainer.clock.cpu_s,
        **({} if trainer.meter is None else {"meter": trainer.meter.state_dict()}),
        **trainer.field.state_dict(),
        **({"fields": others} if others else {}),
        "mask": trainer.parts.mask.state_dict(),
        **({} if trainer.effects is None else {"effects": trainer.effects.state_dict()}),
        "timeline": trainer.timeline.rows,
        "loss": [float(trainer.timeline.loss_sum), trainer.timeline.loss_count],
        "skipped": sorted(trainer.skipped),
        **({"rollbacks": rollbacks} if rollbacks else {}),
    }


def restore(trainer: Trainer, state: dict[str, Any], path: Path) -> None:
    """Go on from what `take` gave.

    Raises:
        AwError: a key is missing; names the file.
    """
    try:
        device = trainer.data.device
        trainer.field.load_state_dict(state, device)
        if trainer.drawing.others:
            trainer.drawing.load_state_dict(state["fields"], device)
        trainer.parts.mask.load_state_dict(state["mask"])
        if trainer.effects is not None:
            trainer.effects.load_state_dict(state["effects"])
        trainer.iteration = state["iteration"]
        trainer.setup_s = state["setup_s"]
        trainer.clock = clock_for(trainer.data.device, state["elapsed_s"], dict(state["parts_s"]))
        trainer.clock.cpu_s = state.get("cpu_s", 0.0)
        if trainer.meter is not None and "meter" in state:
            trainer.meter.load_state_dict(state["meter"])
        trainer.forget_marks()
        trainer.timeline.rows = list(state["timeline"])
        trainer.timeline.loss_sum, trainer.timeline.loss_count = state["loss"]
        trainer.note_skipped(state["skipped"])
        trainer.watchdog.load_state_dict(state.get("rollbacks", []))
    except (KeyError, TypeError) as error:
        raise AwError(f"checkpoint {path} lacks {error}; train again with --overwrite always") from None
