"""What every result holds, whoever made it: a training run, a program, or a failure."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from ambiguous_wild import __version__
from ambiguous_wild.core.config import to_plain
from ambiguous_wild.harness.result_file import SCHEMA

if TYPE_CHECKING:
    from ambiguous_wild.harness.cell import Cell


def result_of(cell: Cell, **measured: Any) -> dict[str, Any]:
    """The result of a cell: what identifies it, and what was measured; nothing where nothing was.

    Args:
        cell: what ran.
        measured: any of status, error, per_image, missing, masks, facts, cost (see `store.FIELDS`).
    """
    nothing: dict[str, Any] = {"per_image": [], "missing": {}, "masks": None, "facts": {}, "cost": {}}
    return {
        "schema": SCHEMA,
        "method": cell.method.name,
        "scene": cell.scene.name,
        "seed": cell.train.seed,
        "status": "ok",
        "error": None,
        "options": to_plain(cell.options),
        **nothing,
        **measured,
        "config_hash": cell.identity,
        "scene_hash": cell.scene_id,
        "version": __version__,
    }
