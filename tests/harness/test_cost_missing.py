"""The cost report where runs have no probes or scenes no runs: no mean, and why."""

from __future__ import annotations

import math
from pathlib import Path

import pytest

from ambiguous_wild.harness.cost.read import Found, read_cost_runs
from ambiguous_wild.harness.cost.report import cost_report, to_text
from tests.harness.fake_cost import cost_run

RISING = [(10.0, 10.0), (20.0, 18.0), (40.0, 20.0)]


def read(folder: Path) -> Found:
    return read_cost_runs([folder])


@pytest.mark.parametrize(
    ("timeline", "reason"),
    [
        ("wall_s,psnr_probe\n40,\n", "no probes in {}"),
        ("x,y\n1,2\n", "{} is damaged (no column wall_s and psnr_probe)"),
        (None, "no probes in {}"),
    ],
)
def test_no_mean_of_a_crossing_and_of_the_end_of_a_run(
    tmp_path: Path, timeline: str | None, reason: str
) -> None:
    for seed in (0, 1):
        lost = cost_run(tmp_path, "a", seed=seed, psnr=(20.0,), train_s=40.0, probes=RISING) / "timeline.csv"
    lost.unlink() if timeline is None else lost.write_text(timeline)
    report = cost_report(read(tmp_path), targets=[14.0])
    (row,) = report.reach
    assert math.isnan(row.minutes.mean) and math.isnan(row.minutes.spread)
    assert row.missing == reason.format(lost)
    text = to_text(report)
    assert f"{row.missing} (a on yard, seed 1)" in text and "≤" not in text
    # without the other seed the end is an honest bound
    (alone,) = cost_report(read(lost.parent), targets=[14.0]).reach
    assert alone.bound and alone.minutes.mean == pytest.approx(40 / 60) and not alone.missing


def test_where_scenes_are_absent_the_mean_over_all_is_a_dash(tmp_path: Path) -> None:
    for scene in ("one", "two"):
        cost_run(tmp_path, "a", scene, psnr=(20.0,), train_s=40.0, probes=RISING)
    for seed, end in ((0, 20.0), (1, 18.5)):
        cost_run(
            tmp_path,
            "b",
            "one",
            seed,
            psnr=(end,),
            train_s=40.0,
            probes=[*RISING[:2], (40.0, end)],
            options={},
        )
    report = cost_report(read(tmp_path), targets=[15.0, 19.0])
    rows = [r for r in report.reach if r.curve == "b" and r.scene is None]
    assert [r.missing for r in rows] == ["no run on two"] * 2
    mean = to_text(report).split("(mean over all scenes)")[1].split("(one)")[0]
    (line,) = [line for line in mean.splitlines() if line.startswith("b ")]
    assert line.split() == ["b", "—", "—"]
