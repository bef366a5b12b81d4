"""One method on one scene with one seed: train, render the test views, measure, write the run folder."""

from __future__ import annotations

import os
import shutil
from pathlib import Path

import yaml

from ambiguous_wild.harness.running.cell import Cell, CellReport, Overwrite
from ambiguous_wild.harness.running.environment import environment
from ambiguous_wild.harness.running.external import run_program
from ambiguous_wild.harness.running.provenance import with_provenance
from ambiguous_wild.harness.running.result_file import FAILED, RESULT, write_result
from ambiguous_wild.harness.running.run_folder import (
    CONFIG,
    EFFECTS,
    ENVIRONMENT,
    TRACEBACK,
    error_line,
    is_finished,
    record_failure,
    refuse_other_config,
    refuse_strange_folder,
)
from ambiguous_wild.harness.running.training import Tick, train_and_measure
from ambiguous_wild.io.atomic import sweep, write_json, write_text
from ambiguous_wild.io.lock import folder_lock


def run_cell(
    cell: Cell,
    folder: Path,
    *,
    cache_dir: Path,
    overwrite: Overwrite = "missing",
    tick: Tick | None = None,
    pictures: bool = True,
) -> CellReport:
    """Train and measure, or find that it is done.

    Args:
        cell: what to run.
        folder: the run folder.
        cache_dir: for features and instance masks shared between runs.
        overwrite: "missing" keeps a finished run and resumes a stopped one, "always" starts anew,
            "never" leaves a folder that exists as it is.
        tick: called after every iteration.
        pictures: draw what the method saw into pictures/; changes no other file.

    Raises:
        AwError: the folder holds a run of another configuration, or is in use.
        Exception: the run failed; failed.json says why.
    """
    folder = Path(os.path.realpath(folder))  # one lock and one place, whatever links lead to it
    if folder.exists() and overwrite == "never":
        return CellReport(folder, "skipped")
    with folder_lock(folder, f"aw bench --method {cell.method.name}"):
        if folder.exists():
            refuse_strange_folder(folder)
            if overwrite == "always":
                shutil.rmtree(folder)
            else:
                refuse_other_config(folder, cell)
                if is_finished(folder):
                    return CellReport(folder, "kept")
        _begin(cell, folder)
        try:
            if cell.method.program is not None:
                result = run_program(cell, folder)
            else:
                result = train_and_measure(cell, folder, cache_dir, tick, pictures)
            write_result(folder / RESULT, with_provenance(result, cell))
        except Exception as error:
            record_failure(cell, folder, error)
            raise
    return CellReport(folder, "trained", result=result)


def run_isolated(
    cell: Cell,
    folder: Path,
    *,
    cache_dir: Path,
    overwrite: Overwrite = "missing",
    tick: Tick | None = None,
    pictures: bool = True,
) -> CellReport:
    """`run_cell`, with the same arguments; an error becomes a report, so that the next cell can run."""
    try:
        return run_cell(cell, folder, cache_dir=cache_dir, overwrite=overwrite, tick=tick, pictures=pictures)
    except Exception as error:
        return CellReport(folder, "failed", error=error_line(error))


def _begin(cell: Cell, folder: Path) -> None:
    """Make the folder, without what an earlier attempt left half-written, and write the settings."""
    folder.mkdir(parents=True, exist_ok=True)
    sweep(folder)
    for name in (FAILED, TRACEBACK):
        (folder / name).unlink(missing_ok=True)
    config = cell.config | {"config_hash": cell.identity}
    write_text(folder / CONFIG, yaml.safe_dump(dict(config), sort_keys=False, allow_unicode=True))
    write_json(folder / ENVIRONMENT, environment(cell.device))
    cell.chosen.write(folder / EFFECTS)
