"""Run one cell in its folder: check what the folder holds, train or keep, record a failure."""

from __future__ import annotations

import logging
import os
import traceback
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Literal

import yaml

from ambiguous_wild import __version__
from ambiguous_wild.core import AwError
from ambiguous_wild.core.config import flatten
from ambiguous_wild.core.errors import disk_line, logged_to
from ambiguous_wild.harness.callbacks import outcome_line, run_name
from ambiguous_wild.harness.cell import (
    Cell,
    CellReport,
    Overwrite,
    RunOptions,
    environment,
    method_file,
    provenance,
)
from ambiguous_wild.harness.external_runs import run_program
from ambiguous_wild.harness.pictures import ROWS
from ambiguous_wild.harness.result_file import (
    CONFIG,
    FAILED,
    IGNORED,
    RESULT,
    STOPPED,
    RunConfig,
    artefact_hashes,
    check_whole,
    read_result,
    write_result,
)
from ambiguous_wild.harness.store import read_config
from ambiguous_wild.harness.training import FOLDER as FIRST_PASS
from ambiguous_wild.harness.training import train_and_measure
from ambiguous_wild.io import plain_yaml
from ambiguous_wild.io.corrections import CORRECTIONS
from ambiguous_wild.io.files import folder_lock, remove, sweep, write_json, write_text
from ambiguous_wild.io.mask_reasons import FILE as REASONS
from ambiguous_wild.methods.external_process import DONE, LOGS, WORK
from ambiguous_wild.methods.references import error_location
from ambiguous_wild.splat.training_loop import Tick
from ambiguous_wild.splat.watchdog import FOLDER as NONFINITE

ENVIRONMENT = "env.json"
TRACEBACK = "traceback.txt"
LOG_FILE = "log.txt"
EFFECTS = "effects.json"
# all that a run writes into its folder
OURS = (
    RESULT, FAILED, TRACEBACK, CONFIG, CORRECTIONS, ENVIRONMENT, LOG_FILE, EFFECTS, FIRST_PASS, STOPPED, ROWS,
    WORK, LOGS, NONFINITE, "checkpoint", "export", "masks", "pictures", "point_cloud.ply", "renders",
    REASONS, "timeline.csv",
)  # fmt: skip
# Files that a run writes before there is anything worth keeping in its folder.
_WORTHLESS = {CONFIG, CORRECTIONS, ENVIRONMENT, EFFECTS, FAILED, TRACEBACK, LOG_FILE}
LOG = logging.getLogger(__name__)
Flat = Mapping[str, object]  # a configuration with dotted keys, "train.seed"


def is_finished(folder: Path) -> bool:
    """Return whether the folder has a result that can be read; a run with a damaged one is made again."""
    if not (folder / RESULT).is_file():
        return False
    try:
        read_result(folder / RESULT)
    except AwError:
        return False
    return True


def existing_outcome(
    folder: Path, overwrite: Overwrite, config: RunConfig
) -> Literal["kept", "skipped"] | None:
    """Return the outcome of an earlier run, "kept" or "skipped"; None if the run must be made."""
    if overwrite == "never":
        return "skipped" if folder.exists() else None
    if not is_finished(folder) or replaces_earlier(folder, overwrite, config) or _continues(folder, config):
        return None
    return "kept"


def _continues(folder: Path, config: RunConfig) -> bool:
    """Return whether a run of this configuration goes on from the one in the folder."""
    earlier = config.get("continued", [])
    return bool(earlier) and read_config(folder).get("config_hash") == earlier[-1]["config_hash"]


def replaces_earlier(folder: Path, overwrite: Overwrite, config: RunConfig) -> bool:
    """Return whether an earlier run in the folder is replaced: always, or where the method's file changed."""
    if overwrite != "changed":
        return overwrite == "always"
    keys = different_keys(read_config(folder), config)
    return "source" in keys and all(key == "source" or key.startswith("options.") for key in keys)


def different_keys(config: Mapping[str, Any], other: Mapping[str, Any]) -> list[str]:
    """Return the dotted keys that decide a result and differ, the method's file ("source") first."""
    before, now = flatten(dict(config)), flatten(dict(other))
    ignored = {f"{part}.{key}" for part, keys in IGNORED.items() for key in keys} | {"config_hash"}
    keys = [k for k in before.keys() | now.keys() if before.get(k) != now.get(k) and k not in ignored]
    return sorted(keys, key=lambda k: (k != "source", k))


def record_failure(cell: Cell, folder: Path, error: BaseException) -> None:
    """Write failed.json, and the traceback unless the error is one that users can mend."""
    if not isinstance(error, (AwError, OSError)):
        write_text(folder / TRACEBACK, "".join(traceback.format_exception(error)))
    write_result(folder / FAILED, {**cell.result(error=error_line(error)), **provenance(cell)})


def error_line(error: BaseException) -> str:
    """Return the error as one line; where it comes from a user's method, with the line in its file."""
    if isinstance(error, AwError):
        return str(error)
    if isinstance(error, OSError):
        return disk_line(error)
    return f"{type(error).__name__}: {error}{error_location(error)}"


def check_folder(cell: Cell, folder: Path, overwrite: Overwrite) -> bool:
    """Return whether an earlier run in an existing folder is replaced.

    Raises:
        AwError: the folder holds foreign files, or a run of another configuration.
    """
    _refuse_foreign_folder(folder)
    anew = replaces_earlier(folder, overwrite, cell.config)
    if not anew:
        refuse_other_config(folder, cell)
    return anew


def _refuse_foreign_folder(folder: Path) -> None:
    """Raise AwError if the folder holds files but no run of this package."""
    if not folder.is_dir():
        raise AwError(f"{folder} is a file, not a run folder; choose another -o")
    names = {p.name for p in folder.iterdir() if not p.name.startswith(".")}
    if names and not names & {RESULT, FAILED, TRACEBACK} and not _is_our_config(folder / CONFIG):
        raise AwError(
            f"{folder} holds other files and no run of this program (no config.yaml with a config_hash); "
            "choose another -o"
        )


def _is_our_config(path: Path) -> bool:
    """Return whether the file holds the settings of a run; a damaged file may do so."""
    if not path.is_file():
        return False
    try:
        return "config_hash" in plain_yaml.read_mapping(path)
    except AwError:
        return True


def describe_change(key: str, before: Flat, now: Flat, cell: Cell) -> str:
    """Return one difference in words of the command line."""
    if key == "source":
        return f"{_file_name(cell)} has changed since this run"
    if key == "scene.sha256":
        return "the scene's files, test photos or size differ"
    if key == "continued":
        return f"it {'went' if before.get(key) else 'did not go'} on from a shorter one"
    default = "full" if key == "protocol" else None  # a config leaves out the full protocol
    return f"{key} was {before.get(key, default)}, is {now.get(key, default)}"


def _file_name(cell: Cell) -> str:
    return getattr(method_file(cell.method), "name", cell.method.name)


def _hint_for_weights(cell: Cell, keys: Sequence[str], before: Flat) -> str:
    """Return a hint where weights that were added or removed since then changed a default; else ""."""
    for key in (name.removeprefix("options.") for name in keys):
        if key in cell.method.by_machine() and f"options.{key}" in before:
            same = f"--set {cell.method.name.partition('@')[0]}.{key}={before[f'options.{key}']}"
            return f"; the default depends on the weights on this machine: {same} keeps the earlier value"
    return ""


def _is_begun(folder: Path) -> bool:
    """Return whether a run in the folder came to its first checkpoint; before, there is nothing to lose."""
    present = {p.name for p in folder.iterdir() if not p.name.startswith(".")}
    if not (folder / WORK / DONE).exists():
        present -= {WORK, LOGS}  # left by an external program that has not finished training
    return CONFIG in present and not present <= _WORTHLESS


def refuse_other_code(folder: Path, cell: Cell) -> None:
    """Raise AwError if the folder has another seed of the cell's method, trained with another file of it."""
    if _is_begun(folder) and read_config(folder).get("source", "") != cell.method.source_hash:
        raise AwError(
            f"{_file_name(cell)} has changed since the run {folder}, and tables average seeds; choose "
            "another -o, or give all seeds in one command with --overwrite changed"
        )


def refuse_other_config(folder: Path, cell: Cell) -> None:
    """Raise AwError if the folder was made by another configuration; the error names what differs.

    Raises:
        AwError: also where a finished run lacks files.
    """
    path = folder / CONFIG
    if is_finished(folder):
        result = read_result(folder / RESULT)
        if not path.is_file() and result["config_hash"] != cell.identity:
            raise AwError(
                f"{folder} holds a run of another configuration, and lacks its {CONFIG}, which would say "
                "what differs; choose another -o, or replace it with --overwrite always"
            )
        check_whole(folder, result)
    if not _is_begun(folder):
        return
    try:
        before = flatten(plain_yaml.read_mapping(path))
    except AwError as error:
        raise AwError(f"{error}; start anew with --overwrite always") from None
    if before.get("config_hash") == cell.identity or _continues(folder, cell.config):
        return
    now = flatten(dict(cell.config))
    keys = different_keys(before, now)
    changes = ", ".join(describe_change(key, before, now, cell) for key in keys[:4]) or "its hash"
    how = "changed" if replaces_earlier(folder, "changed", cell.config) else "always"
    iterations = before.get("train.iterations")
    budgets = before.get("train.budget_s"), cell.train.budget_s
    shorter = budgets == (None, None) and isinstance(iterations, int) and cell.train.iterations < iterations
    may = keys and all(map(may_continue, keys)) and not shorter
    longer = ", continue it with --overwrite longer" if may else ""
    raise AwError(
        f"{folder} holds a run of another configuration ({changes}); choose another -o{longer}, or "
        f"replace it with --overwrite {how}{_hint_for_weights(cell, keys, before)}"
    )


def may_continue(key: str) -> bool:
    """Return whether a run can go on with another value of this setting: its length, size or corrections."""
    of_length = ("train.iterations", "train.budget_s", "train.max_gaussians", "continued")
    return key in of_length or key.startswith("corrections.")


def run_cell(cell: Cell, folder: Path, options: RunOptions, tick: Tick | None = None) -> CellReport:
    """Train and measure a cell, or keep its finished run; an error becomes a report, so that others can run.

    Args:
        cell: what to run.
        folder: the run folder.
        options: how the run is made and kept.
        tick: called after every iteration.
    """
    place = Path(os.path.realpath(folder))  # one lock and one folder, whatever links lead to it
    try:
        if place.exists() and options.overwrite == "never":
            return CellReport(place, "skipped")
        with folder_lock(place, f"aw bench --method {cell.method.name}"):
            if not _prepare_folder(cell, place, options.overwrite):
                return CellReport(place, "kept")
            with logged_to(_log_file(place / LOG_FILE)):
                LOG.debug("%s, configuration %s, version %s", run_name(cell), cell.identity[:12], __version__)
                try:
                    if cell.method.program is not None:
                        result = run_program(cell, place)
                    else:
                        result = train_and_measure(cell, place, options, tick)
                    write_result(
                        place / RESULT,
                        {**result, **artefact_hashes(place, result["per_image"]), **provenance(cell)},
                    )
                except (Exception, SystemExit) as error:
                    record_failure(cell, place, error)
                    LOG.debug("failed: %s", error_line(error))
                    raise
                except KeyboardInterrupt as stop:
                    LOG.debug(str(stop) or "interrupted")
                    raise
                report = CellReport(place, "trained", result=result)
                LOG.debug(outcome_line(report))
                return report
    except (Exception, SystemExit) as error:  # a user's method may call sys.exit
        where = "" if isinstance(error, (AwError, OSError)) else f"; traceback: {folder / TRACEBACK}"
        return CellReport(folder, "failed", error=error_line(error) + where)


def _log_file(path: Path) -> logging.Handler:
    """Return a log handler that appends records with their time to a file."""
    handler = logging.FileHandler(path, encoding="utf-8")
    handler.setFormatter(logging.Formatter("%(asctime)s %(message)s", "%Y-%m-%d %H:%M:%S"))
    return handler


def _prepare_folder(cell: Cell, folder: Path, overwrite: Overwrite) -> bool:
    """Check or empty the folder and write the settings; False where it holds the finished run already."""
    if folder.exists():
        if check_folder(cell, folder, overwrite):
            for name in OURS:  # what a user put beside them stays
                remove(folder / name)
        elif is_finished(folder):
            if not _continues(folder, cell.config):
                return False
            (folder / RESULT).unlink()  # it is no longer that of the checkpoint
    folder.mkdir(parents=True, exist_ok=True)
    sweep(folder)
    for name in (FAILED, TRACEBACK):
        (folder / name).unlink(missing_ok=True)
    config = cell.config | {"config_hash": cell.identity}
    write_text(folder / CONFIG, yaml.safe_dump(dict(config), sort_keys=False, allow_unicode=True))
    write_json(folder / ENVIRONMENT, environment(cell.device))
    cell.chosen.write(folder / EFFECTS)
    if cell.corrections is not None:
        cell.corrections.copy(folder / CORRECTIONS)
    return True
