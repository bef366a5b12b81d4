"""Cost in reference seconds, what is said of it, and the recommended setting."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner

from ambiguous_wild.cli.cost import command
from ambiguous_wild.core import AwError
from ambiguous_wild.report import cost_recommend as advice
from ambiguous_wild.report.cost_changes import changes
from ambiguous_wild.report.cost_curves import timeline, times_to_reach
from ambiguous_wild.report.cost_plots import draw_front
from ambiguous_wild.report.cost_recommend import additive, in_words, recommend, value_at, words_of
from ambiguous_wild.report.cost_report import cost_report, plain_data, to_text
from tests.report.fake_cost import ALONE, BUSY, RISING, cost_run, curves, read, rising
from tests.tiny_scene import write_tiny_scene


def test_times_are_those_of_the_reference_machine(tmp_path: Path) -> None:
    # twice as slow as the reference machine, then as fast
    samples = [[0.0, 0.5], [20.0, 0.5], [20.0, 0.25], [40.0, 0.25]]
    rising(tmp_path, "a", timing=ALONE | {"samples": samples, "kernel_reference_s": 0.25}, reference_s=30.0)
    found = read(tmp_path)
    (run,) = found.runs
    assert found.reference and run.train_s == 30.0
    assert [at for at, _ in run.points] == [5.0, 10.0, 30.0]
    assert run.setup_s == 2.5
    text = to_text(cost_report(found))
    assert "reference seconds of training to reach a test PSNR" in text


def test_runs_without_calibration_keep_the_wall_and_are_not_ranked(tmp_path: Path) -> None:
    rising(tmp_path, "a")
    cost_run(tmp_path, "b", psnr=(21.0,), train_s=50.0, probes=RISING, timing=None)
    found = read(tmp_path)
    assert not found.reference
    report = cost_report(found)
    points = {p.curve: p for p in report.points}
    assert points["a"].pareto_front and not points["b"].pareto_front
    assert "not calibrated" in points["b"].not_ranked
    assert any("wall seconds" in note for note in report.notes)


def test_contended_runs_are_a_range_and_never_on_the_front(tmp_path: Path) -> None:
    for seed, seconds in ((0, 129.0), (1, 168.0), (2, 230.0)):
        cost_run(tmp_path, "a", seed=seed, psnr=(25.0,), train_s=seconds, timing=BUSY, effects=("exposure",))
        cost_run(tmp_path / "n", "a", seed=seed, psnr=(24.0,), train_s=100.0, probes=[(50.0, 20.0)])
    report = cost_report(read(tmp_path))
    points = {p.curve: p for p in report.points}
    busy = points["a + exposure"]
    assert not busy.pareto_front and points["a plain"].pareto_front
    assert (busy.minutes_low * 60.0, busy.minutes_high * 60.0) == (129.0, 230.0)
    assert "3 of 3 runs contended: 2 runs shared the machine" in busy.not_ranked
    text = to_text(report)
    assert "2.15 to 3.83" in text and "not ranked" in text
    (change,) = report.changes
    assert change.db.mean == 1.0 and math.isnan(change.db_per_minute) and change.not_ranked
    data = plain_data(report)
    assert data["curves"][0]["not_ranked"] or data["curves"][1]["not_ranked"]
    reach = next(row for row in report.reach if row.curve == "a + exposure" and row.reached)
    assert reach.not_ranked and reach.minutes_high * 60.0 == 230.0


def test_resolution_gaussians_and_parts_are_changes_of_their_own(tmp_path: Path) -> None:
    cost_run(tmp_path / "1", "a", psnr=(20.0,), train_s=60.0, train={"resolution": "coarse-to-fine"})
    cost_run(tmp_path / "2", "a", psnr=(21.0,), train_s=90.0, ms=200.0, train={"resolution": "full"})
    cost_run(tmp_path / "3", "b", psnr=(20.0,), train_s=60.0, train={"max_gaussians": 5000})
    cost_run(tmp_path / "4", "b", psnr=(20.5,), train_s=75.0, ms=200.0, train={"max_gaussians": 20000})
    cost_run(tmp_path / "5", "c", psnr=(22.0,), train_s=90.0, options={"x": 1, "y": 1})
    cost_run(tmp_path / "5", "c@parts-without", psnr=(21.0,), train_s=60.0, options={"x": 0, "y": 0})
    found = {change.kind: change for change in changes(read(tmp_path).runs)}
    assert found.keys() == {"resolution", "gaussians", "part"}
    assert (found["resolution"].before, found["resolution"].after) == ("coarse-to-fine", "full")
    assert found["resolution"].db_per_minute == pytest.approx(2.0)
    assert (found["gaussians"].before, found["gaussians"].after) == ("5000", "20000")
    assert found["gaussians"].db_per_minute == pytest.approx(2.0)
    part = found["part"]
    assert (part.method, part.before, part.after) == ("c", "as it is", "parts-without")
    assert part.db.mean == -1.0 and part.minutes.mean == pytest.approx(-0.5)


# -- the recommended setting ------------------------------------------------------------------------


def grid(root: Path, scenes: dict[str, float]) -> None:
    """Two methods and two numbers of Gaussians, 30 s and 300 s: `fast` is better at 30 s, `good` at 300 s."""
    ends = {("fast", 30.0): 2.0, ("fast", 300.0): 3.0, ("good", 30.0): 0.0, ("good", 300.0): 6.0}
    for scene, level in scenes.items():
        for (method, seconds), gain in ends.items():
            for count, more in ((5000, -0.5), (20000, 0.0)):
                cost_run(
                    root / f"{seconds:g}" / str(count), method, scene, psnr=(20.0 + level + gain + more,),
                    train_s=seconds, budget_s=seconds, train={"max_gaussians": count},
                    scene_hash=scene, reproduce=f"aw bench --method {method} --scene /x/{scene} --seed 0 "
                    f"--budget {seconds:g}s --effects none --max-gaussians {count}",
                )  # fmt: skip


def test_the_setting_that_is_best_within_the_budget_is_recommended(tmp_path: Path) -> None:
    grid(tmp_path, {"one": 0.0, "two": 5.0, "three": -3.0})
    runs = read(tmp_path).runs
    short, long = recommend(runs, "new", 30.0), recommend(runs, "new", 300.0)
    assert short.choices[0].name == "fast max_gaussians=20000"
    assert long.choices[0].name == "good max_gaussians=20000" and not long.own
    assert [c.behind for c in long.choices] == pytest.approx([0.0, 0.5, 3.0, 3.5])
    assert long.command("my scene") == (
        "aw bench --method good --effects none --max-gaussians 20000 --scene 'my scene' --budget 300s"
    )
    # a machine of half the speed needs the setting for half the time
    assert recommend(runs, "new", 60.0, speed=0.5).choices[0].name == short.choices[0].name
    text = in_words(long, "my scene")
    assert "for new within 5 min on this machine: good" in text and "3.00 dB less" in text
    unknown = replace(long.choices[0], ms_per_iteration=math.nan, gaussians=math.nan)
    text = in_words(replace(long, choices=(unknown,)), "s")
    assert "nan" not in text and "MB, set-up" in text  # an external program reports no more
    assert "within 60 s on this machine (30 s of the reference machine)" in in_words(
        recommend(runs, "new", 60.0, speed=0.5), "s"
    )


def test_scenes_that_a_setting_lacks_do_not_favour_it(tmp_path: Path) -> None:
    cost_run(tmp_path, "a", "easy", psnr=(30.0,), train_s=60.0)
    cost_run(tmp_path, "b", "easy", psnr=(31.0,), train_s=60.0)
    cost_run(tmp_path, "b", "hard", psnr=(20.0,), train_s=60.0)
    found = recommend(read(tmp_path).runs, "new", 60.0)
    assert [c.name for c in found.choices] == ["b", "a"]  # by their means it would be the other way round
    assert found.choices[1].behind == pytest.approx(1.0)


def test_a_scene_that_was_measured_is_judged_by_its_own_runs(tmp_path: Path) -> None:
    grid(tmp_path, {"one": 0.0})
    cost_run(tmp_path / "own", "fast", "mine", psnr=(40.0,), train_s=200.0, scene_hash="mine")
    cost_run(tmp_path / "own", "good", "mine", psnr=(35.0,), train_s=200.0, scene_hash="mine")
    found = recommend(read(tmp_path).runs, "other name", 300.0, scene_hash="mine")
    assert found.own and found.choices[0].method == "fast" and found.choices[0].psnr == 40.0


def test_busy_runs_references_and_lengths_above_the_budget_do_not_count(tmp_path: Path) -> None:
    cost_run(tmp_path, "slow", psnr=(40.0,), train_s=600.0)
    cost_run(tmp_path, "busy", psnr=(39.0,), train_s=50.0, timing=BUSY)
    cost_run(tmp_path, "3dgs+truth", psnr=(38.0,), train_s=50.0)
    cost_run(tmp_path, "plain", psnr=(20.0,), train_s=50.0)
    found = recommend(read(tmp_path).runs, "new", 60.0)
    assert [c.name for c in found.choices] == ["plain"]
    assert "2 runs shared the machine" in found.notes[0]
    with pytest.raises(AwError, match="the shortest took 50 s"):
        recommend(read(tmp_path).runs, "new", 10.0)


def test_psnr_between_two_lengths_lies_on_a_line_over_log_time(tmp_path: Path) -> None:
    for seconds, psnr in ((30.0, 20.0), (300.0, 24.0)):
        cost_run(tmp_path / f"{seconds:g}", "a", psnr=(psnr,), train_s=seconds, budget_s=seconds)
    values = [value_at(curves(tmp_path), "yard", at) for at in (30.0 * math.sqrt(10.0), 3000.0, 10.0, 29.5)]
    assert values == pytest.approx([22.0, 24.0, math.nan, 20.0], nan_ok=True)  # budgets are met to a step
    assert math.isnan(value_at(curves(tmp_path), "absent", 100.0))


def test_parts_of_settings_and_scenes_are_found_again() -> None:
    rng = np.random.default_rng(0)
    setting, scene = rng.normal(size=4), 10.0 * rng.normal(size=5)
    values = {
        (str(i), str(j)): float(setting[i] + scene[j]) for i in range(4) for j in range(5) if (i + j) % 4
    }
    parts, rest = additive(values)
    np.testing.assert_allclose(np.diff([parts[str(i)] for i in range(4)]), np.diff(setting), atol=1e-9)
    assert all(abs(value) < 1e-9 for value in rest.values())


def test_the_words_of_a_setting_are_not_those_of_a_stranger(tmp_path: Path) -> None:
    cost_run(tmp_path, "a", reproduce="aw bench --method a --scene x --evil 'rm -rf /' --set a.k=2 --seed 3")
    (run,) = read(tmp_path).runs
    assert words_of(run) == ("--method", "a", "--set", "a.k=2")
    cost_run(tmp_path / "old", "b", effects=("exposure",))
    cost_run(tmp_path / "bad", "c", reproduce="aw bench 'unfinished")
    words = {r.method: words_of(r) for r in read(tmp_path).runs}
    assert words["b"] == ("--method", "b", "--effects", "exposure")
    assert words["c"] == ("--method", "c", "--effects", "none")


def test_the_command_recommends(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    scene = write_tiny_scene(tmp_path / "scene")
    grid(tmp_path / "runs", {"one": 0.0, "two": 1.0})
    monkeypatch.setattr(advice, "speed_here", lambda found: 2.0)
    words = [str(tmp_path / "runs"), "--recommend", str(scene), "150s"]
    done = CliRunner().invoke(command, words)
    assert done.exit_code == 0, done.output
    assert "good max_gaussians=20000" in done.output.splitlines()[0]
    told = json.loads(CliRunner().invoke(command, [*words, "--json"]).stdout)
    assert told["reference_s"] == 300.0 and told["command"].endswith("--budget 150s")
    monkeypatch.chdir(tmp_path)
    error = CliRunner().invoke(command, words[:3])
    assert error.exit_code == 2 and "'--recommend' requires 2 arguments" in error.stderr
    assert not (tmp_path / "cost").exists()


def test_fps_and_ms_are_those_of_the_result_and_absent_where_a_run_was_not_alone(tmp_path: Path) -> None:
    samples = [[0.0, 0.5], [40.0, 0.02]]  # the last one alone would make 1500 frames a second of 30
    rising(tmp_path, "a", timing=ALONE | {"samples": samples, "kernel_reference_s": 0.25}, reference_s=80.0)
    rising(tmp_path, "b", timing=BUSY | {"samples": samples, "kernel_reference_s": 0.25}, reference_s=80.0)
    report = cost_report(read(tmp_path))
    numbers = {
        p.curve: [p.numbers[key].mean for key in ("ms_per_iteration", "fps", "gaussians")]
        for p in report.points
    }
    assert report.reference and numbers["a"] == [100.0, 30.0, 1234.0]
    assert np.isnan(numbers["b"][:2]).all() and numbers["b"][2] == 1234.0
    assert "ref FPS" not in to_text(report) and "ref ms/iter" not in to_text(report)


def test_runs_of_another_scene_or_metric_are_neither_ranked_nor_averaged(tmp_path: Path) -> None:
    record = {"label": "tint", "better": "lower", "digits": 2, "partial": False, "source": "1" * 64}
    for method, seed, more in (("a", 0, {}), ("a", 1, {}), ("b", 0, {"scene_hash": "t"})):
        record = record | {"source": str(seed) * 64}
        run = cost_run(tmp_path, method, seed=seed, metrics={"tint": record}, probes=RISING, **more)
        assert run.is_dir()
    report = cost_report(read(tmp_path))
    points = {p.curve: p for p in report.points}
    assert not any(p.pareto_front for p in report.points)
    assert "differ in the scene's version" in points["a"].not_ranked and math.isnan(
        points["a"].numbers["tint"].mean
    )
    assert any("left out: tint comes from different functions" in note for note in report.notes)
    cost_run(tmp_path / "2", "b", seed=1, probes=RISING)
    report = cost_report(read(tmp_path))
    assert math.isnan(
        {p.curve: p for p in report.points}["b"].psnr.mean
    )  # seeds of two versions of the scene
    (curve,) = (curve for curve in curves(tmp_path) if curve.method == "b")
    assert not len(timeline(curve, ("yard",))[0])
    assert "differ beside the seed" in times_to_reach([curve])[0].missing


def test_names_in_a_plot_stand_beside_error_bars(tmp_path: Path) -> None:
    for seed, (early, late) in enumerate(((50.0, 100.0), (70.0, 140.0))):
        cost_run(tmp_path, "a", seed=seed, train_s=early)
        cost_run(tmp_path, "b", seed=seed, train_s=late, psnr=(25.0,))
    figure = draw_front(cost_report(read(tmp_path)))
    panel = figure.axes[0]
    names = {text.get_text(): text for text in panel.texts}
    spread = np.std([50.0, 70.0], ddof=1)
    assert names["a"].xy[0] == pytest.approx(60.0 + spread) and names["a"].get_ha() == "left"
    assert names["b"].xy[0] == pytest.approx(120.0 - 2 * spread) and names["b"].get_ha() == "right"


def test_where_test_photos_may_hold_distractors_the_report_says_so(tmp_path: Path) -> None:
    cost_run(tmp_path, "a", facts={"test_photos": "test photos may hold distractors: every 8th photo tests"})
    told = "every 8th photo tests (yard): a model that draws distractors gains PSNR by it"
    assert told in to_text(cost_report(read(tmp_path)))
    narrow = to_text(cost_report(read(tmp_path)), 60)
    assert max(map(len, narrow.splitlines())) <= 60 and "part 1 of" in narrow
