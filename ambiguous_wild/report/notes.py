"""Write the notes below a comparison: runs that are missing, failed, unfinished or not comparable."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pandas as pd

from ambiguous_wild.core.config import flatten
from ambiguous_wild.core.errors import counted, shortlist
from ambiguous_wild.core.grouping import grouped
from ambiguous_wild.harness.labels import IN_FOLDER
from ambiguous_wild.harness.measures import STATIC_PIXELS, Measure, measure
from ambiguous_wild.harness.result_file import NOT_BEGUN, Options
from ambiguous_wild.harness.store import Runs, config_section, read_config
from ambiguous_wild.methods.graft import members
from ambiguous_wild.methods.registry import all_methods, knows_truth
from ambiguous_wild.report.plain_formats import UNEQUAL, UNFITTED
from ambiguous_wild.report.table_layout import DOUBTFUL

LENGTHS_DIFFER = 1.1  # a note is written if the longest training has this many times the shortest's steps
REFERENCE = "reference_s"  # comparable between machines; other times are not
CONDITIONS = {
    "effects": "effects",
    "length": "lengths",
    "fit": "protocols",
    "features": "features",
    "start": "starts",
    "training": "settings of training",
}
IDENTITIES = CONDITIONS | {  # runs of one method on a scene that differ in one of them have no mean
    "scene_hash": "version of the scene",
    "source": "version of the method's file",
    "options_hash": "options",
    "device": "device",
    "unrecorded": "settings that no config.yaml records",
}
FITTED = {
    "fitted": "colours fitted on the left half of each test photo, the right half measured",
    "read": "colours read from the left half of each test photo, the right half measured",
    "plain": "nothing fitted, the right half measured",
    "unknown": "the right half measured; what was fitted is not recorded",
    "full": "whole test photos measured, nothing fitted",
}


def notes(
    runs: Runs, columns: Sequence[Measure], methods: Sequence[str], scenes: Sequence[str]
) -> tuple[str, ...]:
    """Return all notes, one line each, the most serious first."""
    return (
        *unequal(runs.runs),
        *_mixed(runs.runs, columns),
        *_failed(runs),
        *_absent(runs, methods, scenes),
        *(f"incomplete: {i.folder}: {i.reason}" for i in runs.incomplete),
        *_not_ranked(runs),
        *_references(runs, methods),
        *_fitted(runs),
        *_unfitted(runs),
        *_missing(runs, columns),
        *_no_masks(runs, columns),
        *_infinite(runs, columns),
        *_not_comparable(runs, columns),
        *_about(runs, methods),
        *time_notes(runs.runs, columns),
    )


def unequal(frame: pd.DataFrame) -> list[str]:
    """Return a line for each condition that differs between methods on a scene, and one for shared effects.

    Args:
        frame: `Runs.runs`.
    """
    done = frame[frame["status"] == "ok"]
    lines = []
    for column, what in CONDITIONS.items():
        given = done[done[column].astype(str) != ""]  # a method without features is not another condition
        apart = [scene for scene, of in given.groupby("scene") if of[column].astype(str).nunique() > 1]
        if apart:
            rows = given[given["scene"].isin(apart)].groupby("method")[column]
            each = [f"{method}: {' or '.join(dict.fromkeys(map(str, values)))}" for method, values in rows]
            lines.append(
                f"{UNEQUAL}: {what} differ on {shortlist(map(str, apart))}: {shortlist(each, limit=12)}; a "
                "rank may be due to this and not to the method"
            )
        elif column == "effects" and len(given):
            scenes = given.groupby("scene")[column].first()
            each = [f"{names} ({shortlist(of.index)})" for names, of in scenes.groupby(scenes)]
            all_of = str(scenes.iloc[0]) if len(each) == 1 else "; ".join(each)
            lines.append(f"all methods trained with effects: {all_of}")
    return lines


def mixed_scenes(frame: pd.DataFrame) -> frozenset[str]:
    """Return scenes whose test photos may hold distractors."""
    return frozenset(frame[(frame["status"] == "ok") & (frame["test_photos"] != "")]["scene"])


def _mixed(frame: pd.DataFrame, columns: Sequence[Measure]) -> list[str]:
    """Return a line for each reason to doubt test photos, with the scenes, and what is ranked instead."""
    rows = frame[(frame["status"] == "ok") & (frame["test_photos"] != "")]
    ranked = [
        f"{c.label}, over pixels that {STATIC_PIXELS[c.key]}" for c in columns if c.key in STATIC_PIXELS
    ]
    instead = f"ranked is {'; and '.join(ranked)}" if ranked else ""
    why = f"{DOUBTFUL} is not ranked, as a model that draws distractors gains by it"
    return [
        f"{reason} ({shortlist(sorted(set(of['scene'])))}): {'; '.join(filter(None, (why, instead)))}"
        for reason, of in rows.groupby("test_photos")
    ]


def _failed(runs: Runs) -> list[str]:
    frame = runs.runs[runs.runs["status"] == "failed"]
    return [f"failed: {r.method} on {r.scene}, seed {r.seed}: {r.error}" for r in frame.itertuples()]


def _absent(runs: Runs, methods: Sequence[str], scenes: Sequence[str]) -> list[str]:
    done = set(zip(runs.runs["method"], runs.runs["scene"]))
    lacking = grouped(methods, lambda method: tuple(s for s in scenes if (method, s) not in done))
    return [
        f"no result: {', '.join(names)} on {shortlist(absent)}; no mean over scenes"
        for absent, names in lacking.items()
        if absent
    ]


def _not_ranked(runs: Runs) -> list[str]:
    done = set(zip(runs.runs["method"], runs.runs["scene"]))
    open_runs = Counter((i.method, i.scene) for i in runs.incomplete)
    return [
        f"not ranked: {method} on {scene}: {counted(count, 'run')} incomplete"
        for (method, scene), count in open_runs.items()
        if (method, scene) in done
    ]


def _references(runs: Runs, methods: Sequence[str]) -> list[str]:
    names = [method for method in methods if knows_truth(runs.method_of(method))]
    return [f"references, not ranked: {shortlist(names)} (exact masks or clean photos)"] if names else []


def _fitted(runs: Runs) -> list[str]:
    """Return what each method used of test photos; no lines if all runs were measured on whole photos."""
    ok = runs.runs[runs.runs["status"] == "ok"]
    if not len(ok) or set(ok["fit"]) == {"full"}:
        return []
    lines = []
    for kind, text in FITTED.items():
        of = ok[ok["fit"] == kind]
        scenes = sorted(set(of["scene"]))
        where = "" if len(scenes) == ok["scene"].nunique() else f" of {shortlist(scenes)}"
        if scenes:
            lines.append(f"test photos{where}: {shortlist(sorted(set(of['method'])), limit=30)}: {text}")
    return lines


def _unfitted(runs: Runs) -> list[str]:
    """Return a line where colour effects were learnt and whole test photos are measured without any fit."""
    ok = runs.runs[runs.runs["status"] == "ok"]
    concerned = ok[(ok["fit"] == "full") & ok["effects"].str.contains("appearance|exposure")]
    scenes = shortlist(sorted(set(concerned["scene"])))
    why = "renders have the mean look of the train photos; PSNR affine or --protocol half compares without"
    return [f"{UNFITTED} ({scenes}): {why} this difference"] if len(concerned) else []


def _about(runs: Runs, methods: Sequence[str]) -> list[str]:
    """Return the options of methods, and of donors of grafts, that their notes name, with the runs' values.

    A note without an option is the same under every table, and stands in docs/fidelity.md.
    """
    entries = all_methods()
    shown = {runs.method_of(method): method for method in reversed(methods)}
    said: dict[str, list[str]] = {}
    for name in dict.fromkeys(member for method in methods for member in members(runs.method_of(method))):
        if name not in entries or "{" not in entries[name].note:
            continue
        own = runs.runs[[name in members(runs.method_of(method)) for method in runs.runs["method"]]]
        options = [_options_of(Path(folder), name) for folder in own["folder"]]
        said.setdefault(entries[name].about(options), []).append(
            shown.get(name, name).partition(IN_FOLDER)[0]
        )
    return [f"{', '.join(names)}: {note}" for note, names in said.items()]


def _options_of(folder: Path, name: str) -> Options:
    """Return the options of a method in a run, by dotted names; a graft has them below its places."""
    config = read_config(folder)
    options = config_section(config, "options")
    written = str(config.get("method"))
    if "=" in written:
        host, _, rest = written.rpartition("@")
        places = {"host": host} | dict(pair.split("=", 1) for pair in rest.split(",") if "=" in pair)
        options = next((config_section(options, p) for p, member in places.items() if member == name), {})
    elif "host" in options:  # a graft that is the variant of an ablation: the method is its donor
        options = next((value for place, value in options.items() if place != "host"), {})
    return flatten(options) if isinstance(options, dict) else {}


def _missing(runs: Runs, columns: Sequence[Measure]) -> list[str]:
    """Return a line for each metric and reason; it names the runs unless all of them are concerned."""
    lines = []
    ok = runs.runs[runs.runs["status"] == "ok"]
    for column in columns:
        rows = runs.missing[runs.missing["metric"] == column.key]
        for reason, group in rows.groupby("reason", sort=False):
            names = [f"{r.method} on {r.scene}" for r in group.itertuples()]
            who = "" if len(group) >= len(ok) else f" for {shortlist(dict.fromkeys(names))}"
            lines.append(f"missing: {column.key}{who}: {reason}")
        # runs without a value and without a reason have a line too
        explained = set(zip(rows["scene"], rows["method"], rows["seed"]))
        images = runs.images[runs.images["metric"] == column.key]
        have = explained | set(zip(images["scene"], images["method"], images["seed"]))
        others = [r for r in ok.itertuples() if (r.scene, r.method, r.seed) not in have]
        if len(images) and others:
            who = shortlist(dict.fromkeys(f"{r.method} on {r.scene}" for r in others))
            lines.append(f"missing: {column.key} for {who}: it was not measured; 'aw rescore' adds it")
        gaps = images[images["value"].isna()]
        unexplained = [r for r in gaps.itertuples() if (r.scene, r.method, r.seed) not in explained]
        if unexplained:
            names = [f"{r.image} ({r.method} on {r.scene})" for r in unexplained]
            lines.append(f"missing: {column.key}, no reason given, for {shortlist(names)}")
    return lines


def _no_masks(runs: Runs, columns: Sequence[Measure]) -> list[str]:
    """Return a line for each reason why methods have no masks on scenes with exact ones."""
    without = runs.runs[(runs.runs["status"] == "ok") & (runs.runs["no_masks"] != "")]
    shown = any(column.key.startswith("mask_") for column in columns)
    return [
        f"no mask IoU: {shortlist(dict.fromkeys(f'{r.method} on {r.scene}' for r in of.itertuples()))}: {why}"
        for why, of in without.groupby("no_masks")
        if shown or str(why).startswith(NOT_BEGUN)
    ]


def _infinite(runs: Runs, columns: Sequence[Measure]) -> list[str]:
    """Return a line for each metric, method and scene whose mean leaves out values that are not finite."""
    rows = runs.images[runs.images["metric"].isin([c.key for c in columns])]
    lines = []
    for (metric, method, scene), of in rows.groupby(["metric", "method", "scene"]):
        finite = int(np.isfinite(of["value"].dropna()).sum())
        if finite < of["value"].notna().sum():
            count = f"{finite} of {len(of)} values"
            lines.append(f"{metric} of {method} on {scene}: mean of {count}; the others are not finite")
    return lines


def metric_versions(frame: pd.DataFrame) -> dict[str, dict[str, set[str]]]:
    """Return metrics that runs measured by different functions: key -> method -> functions of its runs."""
    found: dict[str, dict[str, set[str]]] = {}
    for method, of_run in zip(frame["method"], frame.get("metric_functions", ())):
        for key, function in of_run.items():
            found.setdefault(key, {}).setdefault(str(method), set()).add(function)
    return {key: of for key, of in found.items() if len(set.union(*of.values())) > 1}


def mixed_runs(frame: pd.DataFrame) -> dict[tuple[str, str], list[str]]:
    """Return by (method, scene) in what runs of a method differ beside the seed; "": between scenes."""
    done = frame[frame["status"] == "ok"]
    mixed = {}
    for (method, scene), of in done.groupby(["method", "scene"]):
        if differ := _differ(of, [column for column in IDENTITIES if column in of]):
            mixed[str(method), str(scene)] = differ
    for method, of in done.groupby("method"):
        if differ := _differ(of.groupby("scene").first(), ["source", "options_hash"]):
            mixed[str(method), ""] = differ
    return mixed


def _differ(runs: pd.DataFrame, columns: Sequence[str]) -> list[str]:
    return [IDENTITIES[column] for column in columns if runs[column].astype(str).nunique() > 1]


def scenes_apart(runs: Runs) -> frozenset[str]:
    """Return scenes on which runs measured different pixels: another protocol, other photos or files."""
    ok, apart = runs.runs[runs.runs["status"] == "ok"], set()
    for scene, group in ok.groupby("scene"):
        images = runs.images[runs.images["scene"] == scene].groupby(["method", "seed"])["image"]
        photos = {frozenset(names) for _, names in images}
        if group["scene_hash"].nunique() > 1 or (group["fit"] == "full").nunique() > 1 or len(photos) > 1:
            apart.add(str(scene))
    return frozenset(apart)


def _not_comparable(runs: Runs, columns: Sequence[Measure]) -> list[str]:
    lines = [
        f"{UNEQUAL}: {measure(key).label} comes from different functions ({shortlist(sorted(of))}): it is "
        "not ranked, and runs of a method that differ so have no mean; 'aw rescore RUNS --metric-file FILE' "
        "measures all with one"
        for key, of in metric_versions(runs.runs).items()
    ]
    ok = runs.runs[runs.runs["status"] == "ok"]
    for scene, group in ok.groupby("scene"):
        if group["scene_hash"].nunique() > 1:
            lines.append(
                f"{UNEQUAL}: results for {scene} come from {group['scene_hash'].nunique()} versions of "
                "the scene (scene_hash differs); run them again on one"
            )
        images = runs.images[runs.images["scene"] == scene].groupby(["method", "seed"])["image"]
        if len({frozenset(names) for _, names in images}) > 1:
            lines.append(f"{UNEQUAL}: methods were measured on different test images of {scene}")
    for (of_method, on), differ in mixed_runs(runs.runs).items():
        lines.append(
            f"{UNEQUAL}: runs of {of_method} on {on or 'all scenes'} differ in {', '.join(differ)}, so they "
            "have no mean: give their folders one at a time"
        )
    if "iterations" in ok and not any("lengths differ" in line for line in unequal(ok)):
        lengths = ok["iterations"].astype(float)
        longest = lengths[np.isfinite(lengths)].groupby(ok["method"]).max()
        if len(longest) and longest.max() > LENGTHS_DIFFER * longest.min():
            each = shortlist((f"{m} {n:.10g}" for m, n in longest.items()), limit=12)
            lines.append(f"trainings differ in length (iterations): {each}")
    shows_cost = any(not c.quality for c in columns)
    if shows_cost and "device" in ok and ok["device"].nunique() > 1:
        each = shortlist(sorted({f"{m} {d}" for m, d in zip(ok["method"], ok["device"])}), limit=12)
        lines.append(f"costs were measured on different devices: {each}")
    if ok["version"].nunique() > 1:
        lines.append(
            f"{UNEQUAL}: results of different versions of ambiguous_wild: "
            + ", ".join(sorted(set(ok["version"])))
        )
    elif ok["code_hash"].nunique() > 1:
        lines.append(f"{UNEQUAL}: results of {ok['code_hash'].nunique()} states of ambiguous_wild's code")
    seeds = ok.groupby("method")["seed"].nunique()
    if seeds.nunique() > 1:
        each = shortlist((f"{method} {count}" for method, count in seeds.items()), limit=12)
        lines.append(f"{UNEQUAL}: methods have different numbers of seeds: {each}")
    return lines


def untimed(frame: pd.DataFrame) -> dict[tuple[str, str], str]:
    """Return by (method, scene) why times are not ranked: a run was not alone, or not calibrated.

    Args:
        frame: `Runs.runs`.
    """
    done = frame[frame["status"] == "ok"]
    reasons: dict[tuple[str, str], str] = {}
    for row in done[done["timing"] != "alone"].itertuples():
        reasons.setdefault((str(row.method), str(row.scene)), f"{row.timing}: {row.timing_reason}")
    return reasons


def incomparable(frame: pd.DataFrame, columns: Sequence[Measure]) -> frozenset[str]:
    """Return the keys of timed columns whose values come from different machines or calibrations."""
    alone = frame[(frame["status"] == "ok") & (frame["timing"] == "alone")]
    differ = {
        REFERENCE: alone["timing_kernel"].nunique() > 1,
        "": alone["hardware"].nunique() > 1,
    }
    return frozenset(c.key for c in columns if c.timed and differ[REFERENCE if c.key == REFERENCE else ""])


def time_notes(frame: pd.DataFrame, columns: Sequence[Measure]) -> list[str]:
    """Return a line for each reason why times are not ranked."""
    if not any(c.timed for c in columns):
        return []
    total = len(frame[frame["status"] == "ok"].groupby(["method", "scene"]))
    lines = []
    for of in grouped(untimed(frame).items(), lambda item: re.sub(r"[\d.]+", "", item[1])).values():
        who = "all" if len(of) == total else shortlist(f"{method} on {scene}" for (method, scene), _ in of)
        lines.append(f"times not ranked: {who} ({max(reason for _, reason in of)})")
    unranked = incomparable(frame, columns)
    if unranked - {REFERENCE}:
        machines = sorted(set(frame[frame["timing"] == "alone"]["hardware"]))
        lines.append(
            f"times of different machines are ranked by reference seconds only: {shortlist(machines, 4)}"
        )
    if REFERENCE in unranked:
        lines.append("reference seconds of CPU and GPU are not ranked against each other")
    return lines
