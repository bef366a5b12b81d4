"""What every result holds, whoever made it: a training run, a program, or a failure."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from ambiguous_wild import __version__
from ambiguous_wild.core.config import to_plain
from ambiguous_wild.harness.running.records import Cost, ImageRow, MaskScores, RunResult
from ambiguous_wild.harness.running.result_file import SCHEMA

if TYPE_CHECKING:
    from ambiguous_wild.harness.running.cell import Cell


def finished_result(
    cell: Cell,
    *,
    per_image: list[ImageRow],
    missing: dict[str, str],
    masks: MaskScores | None,
    facts: dict[str, Any],
    cost: Cost,
) -> RunResult:
    """The result of a cell that was trained and measured.

    Args:
        cell: what ran.
        per_image: metrics of each test image.
        missing: why a metric is missing, by metric.
        masks: scores of the predicted masks, None without exact ones.
        facts: of the method, its effects and the watchdog.
        cost: what it took.
    """
    return _result(cell, per_image=per_image, missing=missing, masks=masks, facts=facts, cost=cost)


def failed_result(cell: Cell, error: str) -> RunResult:
    """The result of a cell that failed: its error, and no numbers."""
    return _result(cell, error=error, per_image=[], missing={}, masks=None, facts={}, cost={})


def _result(
    cell: Cell,
    *,
    error: str | None = None,
    per_image: list[ImageRow],
    missing: dict[str, str],
    masks: MaskScores | None,
    facts: dict[str, Any],
    cost: Cost,
) -> RunResult:
    return {
        "schema": SCHEMA,
        "method": cell.method.name,
        "scene": cell.scene.name,
        "seed": cell.train.seed,
        "status": "ok" if error is None else "failed",
        "error": error,
        "options": to_plain(cell.options),
        "per_image": per_image,
        "missing": missing,
        "masks": masks,
        "facts": facts,
        "cost": cost,
        "config_hash": cell.identity,
        "scene_hash": cell.scene_id,
        "version": __version__,
    }
