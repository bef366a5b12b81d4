"""One method on one scene with one seed: its folder, whether that is ours and finished, and the run."""

from __future__ import annotations

import logging
import os
import shutil
import traceback
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Literal

import yaml

from ambiguous_wild import __version__
from ambiguous_wild.core import AwError
from ambiguous_wild.core.config import flatten
from ambiguous_wild.core.errors import logged_to
from ambiguous_wild.harness.callbacks import outcome_line, run_name
from ambiguous_wild.harness.cell import (
    IGNORED,
    Cell,
    CellReport,
    Overwrite,
    RunOptions,
    environment,
    file_of,
    provenance,
)
from ambiguous_wild.harness.external import run_program
from ambiguous_wild.harness.result_file import FAILED, RESULT, model_hash, read_result, write_result
from ambiguous_wild.harness.store import read_config
from ambiguous_wild.harness.training import Tick, train_and_measure
from ambiguous_wild.io import plain_yaml
from ambiguous_wild.io.files import folder_lock, sweep, write_json, write_text
from ambiguous_wild.methods.external_process import DONE, LOGS, WORK
from ambiguous_wild.methods.references import place_of

CONFIG = "config.yaml"
ENVIRONMENT = "env.json"
TRACEBACK = "traceback.txt"
LOG_FILE = "log.txt"
EFFECTS = "effects.json"
# What a run leaves before anything worth keeping exists in its folder.
_WORTHLESS = {CONFIG, ENVIRONMENT, EFFECTS, FAILED, TRACEBACK, LOG_FILE}
LOG = logging.getLogger(__name__)


def is_finished(folder: Path) -> bool:
    """Whether the folder has a result that can be read; a damaged one is made again."""
    if not (folder / RESULT).is_file():
        return False
    try:
        read_result(folder / RESULT)
    except AwError:
        return False
    return True


def left_alone(
    folder: Path, overwrite: Overwrite, config: Mapping[str, Any]
) -> Literal["kept", "skipped"] | None:
    """What a run becomes that need not be made: finished before, or to be left as it is; else None."""
    if overwrite == "never":
        return "skipped" if folder.exists() else None
    return "kept" if is_finished(folder) and not made_anew(folder, overwrite, config) else None


def made_anew(folder: Path, overwrite: Overwrite, config: Mapping[str, Any]) -> bool:
    """Whether an earlier run of the folder is to be replaced: always, or where the method's file changed."""
    if overwrite != "changed":
        return overwrite == "always"
    names = _different(read_config(folder), config)
    return "source" in names and all(k == "source" or k.startswith("options.") for k in names)


def _different(before: Mapping[str, Any], now: Mapping[str, Any]) -> list[str]:
    """Keys that decide the result and differ between two configurations, the method's file first."""
    ignored = {f"{part}.{key}" for part, keys in IGNORED.items() for key in keys} | {"config_hash"}
    old, new = flatten(dict(before)), flatten(dict(now))
    names = [k for k in old.keys() | new.keys() if old.get(k) != new.get(k) and k not in ignored]
    return sorted(names, key=lambda k: (k != "source", k))


def record_failure(cell: Cell, folder: Path, error: BaseException) -> None:
    """Write failed.json, and the traceback where the error is a fault of this package."""
    if not isinstance(error, (AwError, OSError)):
        write_text(folder / TRACEBACK, "".join(traceback.format_exception(error)))
    write_result(folder / FAILED, {**cell.result(error=error_line(error)), **provenance(cell)})


def error_line(error: BaseException) -> str:
    """One line that says what went wrong, with the line of a method's own file."""
    if isinstance(error, AwError):
        return str(error)
    if isinstance(error, OSError):
        return f"{error.filename or 'input or output'}: {error.strerror or error}"
    return f"{type(error).__name__}: {error}{place_of(error)}"


def refuse_strange_folder(folder: Path) -> None:
    """Raise AwError if the folder holds files, and no run of this package."""
    if not folder.is_dir():
        raise AwError(f"{folder} is a file, not a run folder; choose another -o")
    names = {p.name for p in folder.iterdir() if not p.name.startswith(".")}
    if names and not names & {RESULT, FAILED, TRACEBACK} and not _is_our_config(folder / CONFIG):
        raise AwError(
            f"{folder} is not empty and no run of ours (no config.yaml with a config_hash); choose another -o"
        )


def _is_our_config(path: Path) -> bool:
    """Whether it holds the settings of a run; a damaged file may, another program's does not."""
    if not path.is_file():
        return False
    try:
        return "config_hash" in plain_yaml.read_mapping(path)
    except AwError:
        return True


def _said(key: str, before: Mapping[str, Any], now: Mapping[str, Any], cell: Cell) -> str:
    """What changed, as the command line writes it: a config leaves out the full protocol."""
    if key == "source":
        return f"{getattr(file_of(cell.method), 'name', cell.method.name)} has changed since this run"
    was, is_now = (str(of.get(key, "full" if key == "protocol" else None)) for of in (before, now))
    return f"{key} was {was}, is {is_now}"


def _of_weights(cell: Cell, names: Sequence[str], before: Mapping[str, Any]) -> str:
    """What to do where weights that came or went since then changed a default; empty elsewhere."""
    for key in (name.removeprefix("options.") for name in names):
        if key in cell.method.by_machine() and f"options.{key}" in before:
            same = f"--set {cell.method.name.partition('@')[0]}.{key}={before[f'options.{key}']}"
            return f"; the default follows the weights on this machine: as before with {same}"
    return ""


def refuse_other_config(folder: Path, cell: Cell) -> None:
    """Raise AwError if the folder was made by another configuration; names the keys that differ."""
    path = folder / CONFIG
    present = {p.name for p in folder.iterdir() if not p.name.startswith(".")}
    if not (folder / WORK / DONE).exists():
        present -= {WORK, LOGS}  # of an external program that has not finished training
    if not path.exists() or present <= _WORTHLESS:
        return  # it stopped before the first checkpoint: there is nothing to lose
    try:
        old = plain_yaml.read_mapping(path)
    except AwError as error:
        raise AwError(f"{error}; start anew with --overwrite always") from None
    if old.get("config_hash") == cell.identity:
        return
    before, now = flatten(old), flatten(dict(cell.config))
    names = _different(old, cell.config)
    shown = ", ".join(_said(k, before, now, cell) for k in names[:4]) or "its hash"
    how = "changed" if made_anew(folder, "changed", cell.config) else "always"
    raise AwError(
        f"{folder} holds a run of another configuration ({shown}); "
        f"choose another -o, or replace it with --overwrite {how}{_of_weights(cell, names, before)}"
    )


def run_cell(cell: Cell, folder: Path, options: RunOptions, tick: Tick | None = None) -> CellReport:
    """Train and measure, or find that it is done; an error is a report, so that the next cell can run.

    Args:
        cell: what to run.
        folder: the run folder.
        options: how it is made and kept.
        tick: called after every iteration.
    """
    try:
        return _run(cell, Path(os.path.realpath(folder)), options, tick)
    except (Exception, SystemExit) as error:  # a method of one's own may call sys.exit
        where = "" if isinstance(error, (AwError, OSError)) else f"; traceback: {folder / TRACEBACK}"
        return CellReport(folder, "failed", error=error_line(error) + where)


def _run(cell: Cell, folder: Path, options: RunOptions, tick: Tick | None) -> CellReport:
    # `folder` is resolved: one lock and one place, whatever links lead to it
    if folder.exists() and options.overwrite == "never":
        return CellReport(folder, "skipped")
    with folder_lock(folder, f"aw bench --method {cell.method.name}"):
        if folder.exists():
            refuse_strange_folder(folder)
            if made_anew(folder, options.overwrite, cell.config):
                shutil.rmtree(folder)
            else:
                refuse_other_config(folder, cell)
                if is_finished(folder):
                    return CellReport(folder, "kept")
        _begin(cell, folder)
        with logged_to(_log_file(folder / LOG_FILE)):
            LOG.debug("%s, configuration %s, version %s", run_name(cell), cell.identity[:12], __version__)
            try:
                if cell.method.program is not None:
                    result = run_program(cell, folder)
                else:
                    result = train_and_measure(cell, folder, options, tick)
                write_result(folder / RESULT, {**result, **model_hash(folder), **provenance(cell)})
            except (Exception, SystemExit) as error:
                record_failure(cell, folder, error)
                LOG.debug("failed: %s", error_line(error))
                raise
            except KeyboardInterrupt as stop:
                LOG.debug(str(stop) or "interrupted")
                raise
            report = CellReport(folder, "trained", result=result)
            LOG.debug(outcome_line(report))
    return report


def _log_file(path: Path) -> logging.Handler:
    """Adds records to a file, with the time."""
    handler = logging.FileHandler(path, encoding="utf-8")
    handler.setFormatter(logging.Formatter("%(asctime)s %(message)s", "%Y-%m-%d %H:%M:%S"))
    return handler


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
