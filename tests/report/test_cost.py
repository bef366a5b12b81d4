"""The cost of accuracy: times between probes, pairs that differ in one thing, fronts, and what is missing."""

from __future__ import annotations

import csv
import json
import math
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st

from ambiguous_wild.core import AwError
from ambiguous_wild.report.cost_changes import changes
from ambiguous_wild.report.cost_curves import (
    Curve,
    MeanAndDeviation,
    Point,
    curves_of,
    first_time,
    pareto,
    points,
    summary,
    timeline,
    times_to_reach,
)
from ambiguous_wild.report.cost_plots import draw_all, spread_out
from ambiguous_wild.report.cost_recommend import recommend
from ambiguous_wild.report.cost_report import cost_report, to_text, write_report
from ambiguous_wild.report.cost_runs import read_cost_runs
from tests.harness.fake_runs import failed, save
from tests.report.board_runs import change_result
from tests.report.fake_cost import RISING, cost_run, curves, read, rising

HOSTILE = "=cmd|$x_1$<script>\x1b[31m"


def test_time_to_reach_lies_between_two_probes(tmp_path: Path) -> None:
    probes = [*RISING[:2], (25.0, None), RISING[2]]
    cost_run(tmp_path, "a", psnr=(20.0,), train_s=40.0, probes=probes)  # type: ignore[arg-type]
    (run,) = read(tmp_path).runs
    assert run.points == tuple(RISING)
    for psnr, seconds in ((14.0, 15.0), (19.0, 30.0), (20.0, 40.0)):
        assert first_time(run, psnr) == (seconds, False)
    assert first_time(run, 9.0) == (10.0, True)  # reached by the first probe: an upper bound
    assert math.isnan(first_time(run, 20.01)[0])
    falling = [(10.0, 10.0), (20.0, 20.0), (30.0, 15.0)]  # the first time counts
    cost_run(tmp_path / "b", "b", psnr=(15.0,), train_s=30.0, probes=falling)
    assert first_time(read(tmp_path / "b").runs[0], 15.0) == (15.0, False)


def test_who_is_shown_the_truth_sets_no_target(tmp_path: Path) -> None:
    rising(tmp_path, "refinesplat")
    truth = cost_run(tmp_path, "3dgs+truth", psnr=(30.0,), train_s=40.0, probes=[(10.0, 29.0), (40.0, 30.0)])
    assert {row.psnr for row in times_to_reach(curves(tmp_path))} == {17.0, 19.0, 19.5}
    assert {row.psnr for row in times_to_reach(curves(truth))} == {27.0, 29.0, 29.5}


def test_a_time_is_missing_where_one_run_never_gets_there(tmp_path: Path) -> None:
    for seed, end in ((0, 20.0), (1, 18.5)):
        rising(tmp_path, "a", seed=seed, end=end)
    low, high = times_to_reach(curves(tmp_path), [14.0, 19.0])
    assert low.minutes == MeanAndDeviation(0.25, 0.0) and (low.reached, low.runs) == (2, 2)
    assert math.isnan(high.minutes.mean) and (high.reached, high.runs) == (1, 2)
    (with_setup,) = cost_report(read(tmp_path), targets=[14.0], setup=True).reach
    assert with_setup.minutes.mean == pytest.approx(20.0 / 60.0)


def test_of_several_lengths_the_one_that_is_there_first_is_told(tmp_path: Path) -> None:
    rising(tmp_path / "40s", "a", budget_s=40.0)
    probes = [(10.0, 8.0), (40.0, 16.0), (80.0, 22.0)]
    cost_run(tmp_path / "80s", "a", psnr=(22.0,), train_s=80.0, budget_s=80.0, probes=probes)
    found = curves(tmp_path)
    assert [(c.name, c.length.text) for c in found] == [("a", "40 s"), ("a", "80 s")]
    by_target = {r.target: r for r in times_to_reach(found, [18.0, 21.0, 30.0])}
    assert by_target["18 dB"].length == "40 s" and by_target["18 dB"].minutes.mean == pytest.approx(20 / 60)
    assert by_target["21 dB"].length == "80 s"
    assert by_target["30 dB"].reached == 0


def test_default_targets_hang_on_the_best_of_each_scene(tmp_path: Path) -> None:
    rising(tmp_path, "a", "one")
    cost_run(tmp_path, "a", "two", psnr=(30.0,), train_s=40.0, probes=[(20.0, 20.0), (40.0, 30.0)])
    rows = {(r.scene, r.target): r for r in times_to_reach(curves(tmp_path))}
    assert rows["one", "best - 1 dB"].psnr == 19.0 and rows["two", "best - 1 dB"].psnr == 29.0
    mean = rows["", "best - 1 dB"]
    assert mean.minutes.mean == pytest.approx((30.0 + 38.0) / 2 / 60) and math.isnan(mean.psnr)


def test_failed_and_absent_cells_make_means_missing_and_are_named(tmp_path: Path) -> None:
    for method, scene, end in (
        ("a", "one", 20.0),
        ("b", "one", 20.0),
        ("c", "one", 20.0),
        ("a", "two", 22.0),
    ):
        rising(tmp_path, method, scene, end=end)
    lost = {k: v for k, v in failed("b", "two").items() if k not in ("method", "scene", "seed", "options")}
    cost_run(tmp_path, "b", "two", psnr=(), **lost)
    report = cost_report(read(tmp_path), targets=[15.0])
    psnr = {p.curve: p.psnr.mean for p in report.points}
    assert psnr["a"] == 21.0 and math.isnan(psnr["b"]) and math.isnan(psnr["c"])
    assert [p.curve for p in report.points if p.pareto_front] == ["a"]
    minutes = {r.curve: r.minutes.mean for r in report.reach if not r.scene}
    assert math.isfinite(minutes["a"]) and math.isnan(minutes["b"]) and math.isnan(minutes["c"])
    notes = "\n".join(report.notes)
    assert "failed: b on two" in notes and "no run: c" in notes and "on two" in notes


def test_runs_that_were_measured_differently_are_said(tmp_path: Path) -> None:
    for method, scene, fields in (
        ("a", "one", {}), ("b", "one", {"scene_hash": "1" * 64}),
        ("a", "two", {}), ("b", "two", {"psnr": (20.0, 21.0, 22.0)}),
        ("a", "same", {}), ("b", "same", {}),
    ):  # fmt: skip
        cost_run(tmp_path, method, scene, **fields)
    notes = "\n".join(read(tmp_path).notes)
    assert (
        notes.count("not comparable") == 2 and "runs on one differ" in notes and "runs on two differ" in notes
    )


def test_what_started_elsewhere_is_not_recommended(tmp_path: Path) -> None:
    cost_run(tmp_path, "a", "yard", effects=("skybox",))
    started = cost_run(tmp_path, "b", "yard")
    config = yaml.safe_load((started / "config.yaml").read_text()) | {"start": {"sha256": "ab" * 32}}
    (started / "config.yaml").write_text(yaml.safe_dump(config))
    change_result(started, lambda result: result["facts"].update(start="s.ply (abababab)"))
    runs = read(tmp_path)
    notes = "\n".join(runs.notes)
    assert "not comparable: runs on yard differ in start" in notes
    assert "differ in their effects (a: skybox; b: none)" in notes
    with pytest.raises(AwError, match="nothing can be recommended: runs on yard differ in start"):
        recommend(runs.runs, "yard", 60.0)


def test_settings_that_share_no_scene_are_not_compared(tmp_path: Path) -> None:
    for method, scene, psnr in (("a", "yard", 30.0), ("b", "porch", 20.0), ("c", "porch", 21.0)):
        cost_run(tmp_path, method, scene, psnr=(psnr,))
    found = recommend(read(tmp_path).runs, "square", 600.0)
    assert [choice.method for choice in found.choices] == ["c", "b"]
    assert "not compared, as they share no scene with the others: a" in found.notes


def test_plans_of_one_scene_that_differ_make_no_seeds(tmp_path: Path) -> None:
    for seed, effects in enumerate([("skybox",), ("exposure",)]):
        run = cost_run(tmp_path, "a", seed=seed, effects=effects)
        (run / "effects.json").write_text('{"asked": "auto"}')
    assert {run.asked for run in read(tmp_path).runs} == {"skybox", "exposure"}


def test_an_effect_is_measured_on_pairs_that_differ_in_it_alone(tmp_path: Path) -> None:
    for seed in (0, 1):
        for name, effects, gain, extra in (("n", (), 0.0, 0.0), ("e", ("exposure",), 1.5, 30.0),
                                           ("b", ("exposure", "poses"), 1.0, 90.0)):  # fmt: skip
            cost_run(tmp_path / name, "a", seed=seed, psnr=(20.0 + gain + seed, 22.0 + gain), effects=effects,
                     train_s=60.0 + extra, ms=100.0 + extra)  # fmt: skip
    cost_run(tmp_path / "other", "a", seed=7, psnr=(40.0, 40.0), effects=("exposure",))  # has no partner
    found = {c.name: c for c in changes(read(tmp_path).runs)}
    assert found.keys() == {"exposure", "poses"}
    exposure, poses = found["exposure"], found["poses"]
    assert (exposure.pairs, exposure.db.mean, exposure.db.spread) == (2, 1.5, 0.0)
    assert exposure.minutes.mean == pytest.approx(0.5) and exposure.ms_per_iteration.mean == pytest.approx(
        30.0
    )
    assert exposure.db_per_minute == pytest.approx(3.0)
    assert exposure.db_low == exposure.db_high == 1.5  # every picture gains the same
    assert poses.db.mean == -0.5 and poses.db_per_minute == pytest.approx(-0.5)


def test_a_refresh_interval_is_turned_towards_what_costs_more(tmp_path: Path) -> None:
    for every, psnr, seconds in ((1, 21.0, 120.0), (10, 20.5, 60.0)):
        options = {"mask": {"mask_every": every}, "other": 3}
        cost_run(tmp_path / str(every), "a", psnr=(psnr,), train_s=seconds, ms=seconds, options=options)
    cost_run(tmp_path / "two", "a", psnr=(30.0,), options={"mask": {"mask_every": 1}, "other": 4}, ms=1.0)
    found = {(c.kind, c.name): c for c in changes(read(tmp_path).runs)}
    interval = found["interval", "mask.mask_every"]
    assert (interval.before, interval.after) == ("10", "1")
    assert interval.db_per_minute == pytest.approx(0.5)
    assert found["option", "other"].pairs == 1  # mask_every 1 in both
    assert len(found) == 2  # nothing of runs that differ in two


def test_runs_of_an_ablation_are_pairs_of_their_method(tmp_path: Path) -> None:
    cost_run(tmp_path, "a", psnr=(20.0,), options={"merge_every": 0}, ms=1.0)
    cost_run(tmp_path, "a@density-merging", psnr=(21.0,), options={"merge_every": 1}, train_s=90.0, ms=2.0)
    cost_run(tmp_path, "a@mask=b", psnr=(25.0,), options={"merge_every": 2}, ms=3.0)  # is another method
    (change,) = changes(read(tmp_path).runs)
    assert change.method == "a" and change.db.mean == 1.0


def test_labels_name_curves_changes_and_points_in_their_order(tmp_path: Path) -> None:
    for name, psnr, train_s in (("a", 20.0, 60.0), ("3dgs+truth", 30.0, 50.0), ("b", 22.0, 70.0)):
        cost_run(tmp_path / "n", name, psnr=(psnr,), train_s=train_s, probes=RISING)
    cost_run(tmp_path / "e", "a", psnr=(21.0,), effects=("exposure",), probes=RISING)
    runs = read_cost_runs([tmp_path], labels=["3dgs+truth=Oracle", "a=Ours"])
    report = cost_report(runs)
    assert [point.curve for point in report.points] == ["b", "Oracle", "Ours + exposure", "Ours plain"]
    assert [change.method for change in report.changes] == ["Ours"]
    assert not report.points[1].pareto_front  # still known as a reference
    draw_all(report, tmp_path)
    drawn = (tmp_path / "front.svg").read_text(encoding="utf-8")
    assert "<!-- Oracle -->" in drawn and "truth" not in drawn
    with pytest.raises(AwError, match="unknown method 'c'"):
        read_cost_runs([tmp_path], labels=["c=Ours"])


def test_under_a_budget_both_take_as_long_and_no_rate_is_given(tmp_path: Path) -> None:
    for name, effects, psnr, seconds in (("n", (), 20.0, 60.01), ("e", ("exposure",), 21.0, 60.03)):
        cost_run(tmp_path / name, "a", psnr=(psnr,), effects=effects, train_s=seconds, budget_s=60.0)
    (change,) = changes(read(tmp_path).runs)
    assert change.db.mean == 1.0 and change.same_time and math.isnan(change.db_per_minute)
    assert "same time" in to_text(cost_report(read(tmp_path)))


def test_a_sweep_names_every_curve_by_its_value_and_the_default_too(tmp_path: Path) -> None:
    for method, share in {"mine": 0.8, "mine@share-0.7": 0.7, "mine@share-0.9": 0.9}.items():
        cost_run(tmp_path, method, options={"share": share, "other": 1})
    names = [curve.name for curve in curves_of(read_cost_runs([tmp_path]).runs)]
    assert sorted(names) == ["mine share=0.7", "mine share=0.8", "mine share=0.9"]
    labelled = curves_of(read_cost_runs([tmp_path], labels=["mine=Ours"]).runs)
    assert {curve.name for curve in labelled} == {f"Ours share={share}" for share in (0.7, 0.8, 0.9)}
    cost_run(tmp_path, "mine@parts-none", options={"share": 0.8, "other": 0})
    names = [curve.name for curve in curves_of(read_cost_runs([tmp_path]).runs)]
    assert sorted(names) == ["mine", "mine@parts-none", "mine@share-0.7", "mine@share-0.9"]


@settings(max_examples=50, deadline=None)
@given(st.lists(st.tuples(st.integers(1, 6), st.integers(1, 6)), min_size=1, max_size=12))
def test_the_front_is_what_no_other_dominates(at: list[tuple[int, int]]) -> None:
    every = [("", math.nan, 1.0), *((str(i), float(psnr), float(m)) for i, (m, psnr) in enumerate(at))]
    made = [Point(c, "m", "", 1, MeanAndDeviation(psnr), MeanAndDeviation(m)) for c, psnr, m in every]
    front = {(p.minutes.mean, p.psnr.mean) for p in pareto(made, [p.minutes.mean for p in made])}
    expected = {
        (m, d) for m, d in at
        if not any((m2 <= m and d2 >= d) and (m2, d2) != (m, d) for m2, d2 in at)
    }  # fmt: skip
    assert front == expected


def test_spread_is_of_seeds_over_the_mean_over_scenes(tmp_path: Path) -> None:
    values = {("one", 0): 20.0, ("one", 1): 22.0, ("two", 0): 30.0, ("two", 1): 30.0}
    for (scene, seed), psnr in values.items():
        cost_run(tmp_path, "a", scene, seed, psnr=(psnr,))
    (point,) = points(curves(tmp_path))
    assert point.psnr.mean == 25.5
    assert point.psnr.spread == pytest.approx(np.std([25.0, 26.0], ddof=1))


def test_a_mean_timeline_exists_only_where_every_run_has_one(tmp_path: Path) -> None:
    rising(tmp_path, "a")
    cost_run(tmp_path, "a", seed=1, psnr=(24.0,), train_s=36.0, probes=[(12.0, 12.0), (36.0, 24.0)])
    (curve,) = curves(tmp_path)
    seconds, psnr = timeline(curve, ("yard",))
    assert (seconds[0], seconds[-1]) == (12.0, 36.0)
    assert psnr[0] == pytest.approx((11.6 + 12.0) / 2) and psnr[-1] == pytest.approx((19.6 + 24.0) / 2)
    assert len(timeline(curve, ("yard", "absent"))[0]) == 0
    assert math.isnan(summary(Curve("a", "a", curve.length, ()), ("yard",), lambda run: run.psnr).mean)


@settings(max_examples=50, deadline=None)
@given(st.lists(st.floats(0, 10), max_size=8), st.floats(0.1, 2))
def test_labels_keep_their_order_and_distance(heights: list[float], gap: float) -> None:
    placed = spread_out(heights, gap)
    order = sorted(range(len(heights)), key=lambda i: heights[i])
    assert all(placed[b] - placed[a] >= gap - 1e-6 for a, b in pairwise(order))
    if len(heights) == 1:
        assert placed == heights


def test_files_hold_what_is_printed_and_hostile_names_stay_text(tmp_path: Path) -> None:
    for length in (40.0, 80.0):
        more: dict[str, Any] = {"train_s": length, "budget_s": length, "probes": [(20.0, 18.0)]}
        cost_run(tmp_path / f"{length}", HOSTILE, psnr=(20.0,), **more)
    out = tmp_path / "out"
    report = cost_report(read(tmp_path), targets=[19.0], made_by="aw cost runs")
    written = [p.name for p in write_report(report, out) + draw_all(report, out)]
    assert {"cost.json", "cost.csv", "time-to-psnr.csv", "timelines.csv", "timelines.svg", "timelines.png",
            "budgets.png", "front.svg"} <= set(written) and "changes.csv" not in written  # fmt: skip
    data = json.loads((out / "cost.json").read_text())
    assert data["curves"][0]["minutes_std"] is None and data["made_by"] == "aw cost runs"
    rows = list(csv.DictReader((out / "cost.csv").open()))
    assert all(row["curve"].startswith("'=") for row in rows) and len(rows) == 2
    svg = (out / "timelines.svg").read_text()
    assert "<script" not in svg and "\x1b" not in svg
    assert "\x1b" not in to_text(report)


def test_only_an_earlier_report_is_taken_away(tmp_path: Path) -> None:
    out = tmp_path / "out"
    out.mkdir()
    for name in ("changes.csv", "notes.txt"):
        (out / name).write_text("mine")
    cost_run(tmp_path / "runs", "a")
    report = cost_report(read(tmp_path / "runs", tmp_path / "runs" / "yard"))  # a folder in a folder: one run
    assert [p.runs for p in report.points] == [1]
    with pytest.raises(AwError, match=r"changes\.csv exists"):  # nothing here was a report of ours
        write_report(report, out)
    assert (out / "changes.csv").read_text() == "mine"
    (out / "changes.csv").unlink()
    write_report(report, out)
    (out / "budgets.png").write_text("of a report")
    write_report(report, out)
    assert sorted(p.name for p in out.iterdir()) == ["cost.csv", "cost.json", "notes.txt", "time-to-psnr.csv",
                                                     "timelines.csv"]  # fmt: skip


def test_errors_say_what_to_do(tmp_path: Path) -> None:
    with pytest.raises(AwError, match="no run in"):
        read(tmp_path)
    save(tmp_path / "z", failed("b"))
    with pytest.raises(AwError, match="no finished run"):
        read(tmp_path)
    cost_run(tmp_path / "x", "a")
    cost_run(tmp_path / "y", "a")
    with pytest.raises(AwError, match="two runs of a"):
        read(tmp_path)
    with pytest.raises(AwError, match="unknown scene"):
        read_cost_runs([tmp_path / "x"], scenes=["gard"])


@pytest.mark.parametrize(
    ("timeline", "reason"),
    [
        ("wall_s,psnr_probe\n40,\n", "too few probes in {}"),
        ("x,y\n1,2\n", "{} is damaged (no column wall_s and psnr_probe)"),
        (None, "too few probes in {}"),
    ],
)
def test_no_mean_of_a_crossing_and_of_the_end_of_a_run(
    tmp_path: Path, timeline: str | None, reason: str
) -> None:
    for seed in (0, 1):
        lost = rising(tmp_path, "a", seed=seed) / "timeline.csv"
    lost.unlink() if timeline is None else lost.write_text(timeline)
    report = cost_report(read(tmp_path), targets=[14.0])
    (row,) = report.reach
    assert math.isnan(row.minutes.mean) and math.isnan(row.minutes.spread)
    assert row.missing == reason.format(lost)
    text = to_text(report)
    assert f"{row.missing} (a on yard, seed 1)" in text and "≤" not in text
    # without the other seed the end is an honest bound
    (alone,) = cost_report(read(lost.parent), targets=[14.0]).reach
    assert alone.upper_bound and alone.minutes.mean == pytest.approx(40 / 60) and not alone.missing


def test_where_scenes_are_absent_the_mean_over_all_is_a_dash(tmp_path: Path) -> None:
    for method, scene, seed, end in (("a", "one", 0, 20.0), ("a", "two", 0, 20.0), ("b", "one", 0, 20.0),
                                     ("b", "one", 1, 18.5)):  # fmt: skip
        rising(tmp_path, method, scene, seed, end=end)
    report = cost_report(read(tmp_path), targets=[15.0, 19.0])
    rows = [r for r in report.reach if r.curve == "b" and not r.scene]
    assert [r.missing for r in rows] == ["no run on two"] * 2
    mean = to_text(report).split("(mean over all scenes)")[1].split("(one)")[0]
    (line,) = [line for line in mean.splitlines() if line.startswith("b ")]
    assert line.split() == ["b", "—", "—"]
