"""Continue runs: from a shorter one, or with masks corrected by hand."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from ambiguous_wild.core import AwError
from ambiguous_wild.core.config import from_plain
from ambiguous_wild.harness.cell import Cell
from ambiguous_wild.harness.cell_run import different_keys, is_finished, may_continue
from ambiguous_wild.harness.result_file import Continued
from ambiguous_wild.harness.store import read_config
from ambiguous_wild.io.corrections import CORRECTIONS, CorrectionsFile
from ambiguous_wild.splat import checkpoint
from ambiguous_wild.splat.train_config import TrainConfig


def with_corrections(cells: Sequence[Cell], path: Path) -> list[Cell]:
    """Return the cells with masks corrected by hand.

    Raises:
        AwError: several scenes, or the file is not of the scene or damaged.
    """
    if len({cell.scene_id for cell in cells}) > 1:
        raise AwError(f"--corrections {path} is of one scene: bench the scenes one by one")
    file = CorrectionsFile.of(path)
    file.masks(cells[0].scene)
    if programs := sorted({cell.method.name for cell in cells if cell.method.program is not None}):
        raise AwError(f"--corrections: the external program {', '.join(programs)} takes no masks from us")
    return [replace(cell, corrections=file) for cell in cells]


def as_continued(cell: Cell, folder: Path) -> Cell:
    """Return the cell as the continuation of the run in `folder`; unchanged where there is none to continue.

    A finished run that was trained at least as long is kept: then the cell has its length. Without
    corrections of its own the cell takes those of the run.

    Raises:
        AwError: the run cannot be continued, or no iteration is left in which the corrections could act.
    """
    config = read_config(folder)
    saved = folder / "checkpoint" / "last.safetensors"
    if "config_hash" not in config or not saved.is_file():
        return cell
    earlier: tuple[Continued, ...] = tuple(config.get("continued", ()))
    corrections = cell.corrections
    if corrections is None and config.get("corrections"):
        corrections = CorrectionsFile.of(folder / CORRECTIONS)
    same = replace(cell, continued=earlier, corrections=corrections)
    keys = different_keys(config, same.config)
    if not keys:
        return same
    if keys == ["train.max_gaussians"] or not all(map(may_continue, keys)):
        return cell  # another run, which is refused
    if cell.method.passes > 1 or cell.method.program is not None:
        raise AwError(
            f"{folder} cannot be continued: {cell.method.name} trains twice or is an external program; "
            "choose another -o"
        )
    state = checkpoint.load(saved)
    iteration = int(state["iteration"])
    if cell.train.share_done(iteration, float(state["elapsed_s"])) >= 1.0 and is_finished(folder):
        if any(key.startswith("corrections.") for key in keys):
            raise AwError(
                f"{folder} was trained for {iteration} iterations, and none is left in which the corrections "
                "could act: give a larger --iterations or --budget"
            )
        return replace(same, train=from_plain(TrainConfig, config["train"], "train"))
    before: Continued = {"iteration": iteration, "config_hash": config["config_hash"]}
    return replace(same, continued=(*earlier, before))
