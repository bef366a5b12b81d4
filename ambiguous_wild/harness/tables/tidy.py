"""Every number of every run as one tidy pandas table: a row a method, scene, seed, image and metric."""

from __future__ import annotations

import math
from collections.abc import Sequence

import pandas as pd

from ambiguous_wild.core.errors import unknown
from ambiguous_wild.harness.measures import measure
from ambiguous_wild.harness.running.store import TEXT_OF_RUNS, Runs

COLUMNS = ("scene", "method", "seed", "image", "metric", "value", "better", "reason", "config_hash")
_KEYS = ["scene", "method", "seed"]
_NO_NUMBER = {*_KEYS, "images", *TEXT_OF_RUNS}
_TEXT = ("scene", "method", "image", "metric", "better", "reason", "config_hash")


def tidy(runs: Runs, *, metrics: Sequence[str] = (), scenes: Sequence[str] = ()) -> pd.DataFrame:
    """All runs as one table.

    Args:
        runs: from `store.read_runs`.
        metrics: only these; empty: all.
        scenes: only these; empty: all.

    Returns:
        Columns `COLUMNS`. A number of a whole run (cost, masks) has an empty image. A missing value is NaN
        and `reason` says why, where a run says it; a run that failed has one row, metric "failed". `better`
        is "higher", "lower" or empty.

    Raises:
        AwError: a metric or scene that no run has.
    """
    frame = pd.concat([_images(runs), _missing(runs), _whole(runs), _failed(runs)], ignore_index=True)
    frame = _only(_only(frame, "metric", metrics), "scene", scenes)
    frame["better"] = frame["metric"].map(lambda key: measure(str(key)).better or "")
    if len(runs.runs):  # no finished run: there are neither rows nor hashes
        frame = frame.merge(runs.runs[[*_KEYS, "config_hash"]], on=_KEYS, how="left")
    frame = frame.reindex(columns=list(COLUMNS)).fillna(dict.fromkeys(_TEXT, ""))
    return frame.sort_values([*_KEYS, "image"], kind="stable", ignore_index=True)


def _only(frame: pd.DataFrame, column: str, names: Sequence[str]) -> pd.DataFrame:
    known = sorted(frame[column].unique())
    for name in names:
        if name not in known:
            raise unknown(column, name, known)
    return frame[frame[column].isin(list(names))].copy() if names else frame


def _images(runs: Runs) -> pd.DataFrame:
    frame = runs.images.merge(runs.missing, on=[*_KEYS, "metric"], how="left")
    return frame.assign(reason=frame["reason"].where(frame["value"].isna(), ""))


def _missing(runs: Runs) -> pd.DataFrame:
    """Metrics that a run lacks as a whole and that have no row of any image."""
    key = [*_KEYS, "metric"]
    shown = set(runs.images[key].itertuples(index=False, name=None))
    gone = [row not in shown for row in runs.missing[key].itertuples(index=False, name=None)]
    return runs.missing[gone].assign(image="", value=math.nan)


def _whole(runs: Runs) -> pd.DataFrame:
    if not len(runs.runs):
        return pd.DataFrame()
    done = runs.runs[runs.runs["status"] == "ok"]
    numbers = [name for name in done.columns if name not in _NO_NUMBER]
    frame = done.melt(_KEYS, numbers, "metric", "value")
    # A cost that does not apply (memory of a GPU) and mask scores without a truth are no gaps.
    frame["value"] = pd.to_numeric(frame["value"], errors="coerce")
    return frame[frame["value"].notna()].assign(image="", reason="")


def _failed(runs: Runs) -> pd.DataFrame:
    if not len(runs.runs):
        return pd.DataFrame()
    lost = runs.runs[runs.runs["status"] == "failed"]
    return lost[_KEYS].assign(image="", metric="failed", value=math.nan, reason=lost["error"])
