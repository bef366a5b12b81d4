"""Pairs of methods: what is compared, by which unit, what is said where no test can say anything; labels."""

from __future__ import annotations

import csv
import io
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from click.testing import CliRunner
from scipy.stats import ttest_1samp, ttest_rel

from ambiguous_wild.cli.table import table_command
from ambiguous_wild.core import AwError
from ambiguous_wild.harness.store import read_runs
from ambiguous_wild.metrics.stats import mean_interval
from ambiguous_wild.report import papers
from ambiguous_wild.report.pairs import Counts, compared, names_of, p_text, pair_table
from tests.harness.fake_runs import failed, fake_result, save
from tests.report.test_notes import ghosts

GAIN = {"mine": 1.0, "robustsplat": 0.6, "3dgs": 0.0}


def many(scenes: int, seeds: int = 1, images: int = 6) -> list[dict[str, Any]]:
    rng, found = np.random.default_rng(5), []
    for s in range(scenes):
        photos = rng.normal(24.0, 2.0, images)
        for method, gain in GAIN.items():
            own = photos + rng.normal(gain, 0.3) + rng.normal(0.0, 0.3, images)
            found += [fake_result(method, f"s{s}", k, tuple(own + rng.normal(0, 0.1))) for k in range(seeds)]
    return found


def psnr(results: list[dict[str, Any]], method: str, scene: str) -> np.ndarray:
    return np.array([[i["psnr"] for i in r["per_image"]] for r in results
                     if (r["method"], r["scene"]) == (method, scene)])  # fmt: skip


def test_intervals_and_p_are_those_of_scipy(tmp_path: Path) -> None:
    results = many(5)
    (pair, other), _ = compared(read_runs(save(tmp_path, *results)), ["mine", "3dgs", "robustsplat"],
                                metrics=["psnr"])  # fmt: skip
    means = [[psnr(results, m, f"s{s}").mean() for s in range(5)] for m in ("mine", "3dgs")]
    expected = ttest_rel(*means)
    assert pair.scenes.mean == pytest.approx(np.mean(means[0]) - np.mean(means[1]))
    assert (pair.scenes.low, pair.scenes.high) == pytest.approx(tuple(expected.confidence_interval()))
    assert pair.scenes.p == pytest.approx(expected.pvalue) and pair.scenes.count == 5
    assert pair.scenes.p < other.scenes.p
    assert pair.p_holm == pytest.approx(2 * pair.scenes.p) and other.p_holm == max(
        other.scenes.p, pair.p_holm
    )
    assert pair.images.low < pair.scenes.mean < pair.images.high and pair.images.count == 30


def test_photos_with_distractors_compare_nobody(tmp_path: Path) -> None:
    """The model with the ghosts has more PSNR; over the pixels that other photos show alike it has less."""
    runs = [r for s in range(3) for r in ghosts(scene=f"s{s}")]
    pairs, notes = compared(read_runs(save(tmp_path, *runs)), ["a", "3dgs"])
    states = {pair.measure.key: pair.state for pair in pairs}
    assert states == {"psnr": "missing", "psnr_consistent": "ok", "ssim": "missing"}
    (fair,) = [pair for pair in pairs if pair.state == "ok"]
    assert fair.scenes.mean == pytest.approx(4.0)
    assert any("gains by it" in note for note in notes)
    assert not any("results are missing" in note for note in notes)
    names = [row.name for row in pair_table(pairs, notes).rows]
    assert names[0] == "3dgs, PSNR†↑"


def test_one_scene_has_an_interval_over_images_and_no_p(tmp_path: Path) -> None:
    results = many(1)
    pairs, notes = compared(read_runs(save(tmp_path, *results)), ["mine", "3dgs"])
    low, high = ttest_1samp(
        (psnr(results, "mine", "s0") - psnr(results, "3dgs", "s0"))[0], 0
    ).confidence_interval()
    assert (pairs[0].images.low, pairs[0].images.high) == pytest.approx((low, high))
    row = next(row for row in pair_table(pairs, notes).rows if row.name.startswith("3dgs, PSNR"))
    assert [cell.text(pairs[0].measure) for cell in row.cells[2:]] == ["—", "—", "6/0/0"]
    assert any("one scene says nothing of other scenes: no p" in note for note in notes)
    assert any("one seed of 3dgs, mine" in note for note in notes)


def test_no_interval_holds_an_impossible_difference(tmp_path: Path) -> None:
    """Student's t over two scenes does: masks differ by 0.2 and 0.8, 0.5 +- 12.7 * 0.3."""
    for scene, iou in (("s0", 0.3), ("s1", 0.9)):
        masks = [{"iou": v, "precision": v, "recall": v, "images": 2} for v in (iou, 0.1)]
        save(tmp_path, *(fake_result(m, scene, masks=mask) for m, mask in zip(("a", "b"), masks)))
    (pair,), _ = compared(read_runs(tmp_path), ["a", "b"], metrics=["mask_iou"])
    assert (pair.scenes.low, pair.scenes.high) == (-1.0, 1.0) and pair.scenes.mean == pytest.approx(0.5)
    free = mean_interval([0.2, 0.8])
    assert pair.scenes.p == pytest.approx(free.p) and free.within(-9, 9) == free and free.high > 4


def test_seeds_widen_the_interval_over_images(tmp_path: Path) -> None:
    results = many(1, seeds=3)
    for r in results:
        for image in r["per_image"] if r["method"] == "mine" else ():
            image["psnr"] += (0.0, 0.8, -0.8)[r["seed"]]
    (pair,), notes = compared(read_runs(save(tmp_path, *results)), ["mine", "3dgs"], metrics=["psnr"])
    difference = psnr(results, "mine", "s0").mean(axis=0) - psnr(results, "3dgs", "s0").mean(axis=0)
    low, high = ttest_1samp(difference, 0.0).confidence_interval()
    assert pair.images.low < low - 0.5 and pair.images.high > high + 0.5
    assert not any("one seed" in note for note in notes)


def test_wins_ties_and_losses_follow_the_direction_of_merit(tmp_path: Path) -> None:
    better = {"a": (1.0, 2.0, 2.001), "b": (2.0, 1.0, 2.0)}
    results = [fake_result(m, f"s{k}", psnr=(v, v)) for m, of in better.items() for k, v in enumerate(of)]
    for r in results:
        for image in r["per_image"]:
            image["flip"] = image["psnr"] / 10
    pairs, _ = compared(read_runs(save(tmp_path, *results)), ["a", "b"], metrics=["psnr", "flip"])
    assert pairs[0].won_scenes == pairs[1].won_scenes == Counts(1, 1, 1)
    pairs, _ = compared(read_runs(tmp_path), ["a", "b"], metrics=["psnr", "flip"], scenes=["s1"])
    assert pairs[0].won_images == Counts(2, 0, 0) and pairs[1].won_images == Counts(0, 0, 2)


def test_what_is_missing_or_measured_differently_is_not_compared(tmp_path: Path) -> None:
    lost = [r for r in many(3) if (r["method"], r["scene"]) != ("3dgs", "s1")]
    runs = read_runs(save(tmp_path / "lost", *lost, failed("robustsplat", "s2", 1)))
    pairs, notes = compared(runs, ["mine", "3dgs", "robustsplat"], metrics=["psnr"])
    assert [pair.state for pair in pairs] == ["missing", "failed"]
    assert any("--only chooses scenes" in note for note in notes)
    assert any("no result: 3dgs on s1" in n for n in notes) and any("failed: robustsplat" in n for n in notes)
    other = fake_result("3dgs", "s0", psnr=(20.0,) * 5)
    runs = read_runs(save(tmp_path / "other", *[r for r in many(1) if r["method"] != "3dgs"], other))
    (pair,), notes = compared(runs, ["mine", "3dgs"], metrics=["psnr"])
    assert pair.state == "missing" and any("different test images" in note for note in notes)


def test_names_with_commas_and_wrong_names(tmp_path: Path) -> None:
    graft = "3dgs@mask=mine,density=mine"
    runs = read_runs(
        save(tmp_path, *(fake_result(m) for m in ("3dgs", "mine", graft))), labels=["mine=Ours, full"]
    )
    assert names_of(f"Ours, full,{graft}, 3dgs", runs) == ["Ours, full", graft, "3dgs"]
    pairs, _ = compared(runs, names_of(f"mine,{graft}", runs))
    assert (pairs[0].method, pairs[0].other) == ("Ours, full", graft)
    for wrong, message in (
        ("mine,3dg", "did you mean '3dgs'"),
        ("mine", "two or more"),
        ("mine,mine", "each once"),
    ):
        with pytest.raises(AwError, match=message):
            compared(runs, names_of(wrong, runs))


@pytest.mark.parametrize(
    ("p", "text"), [(0.0, "<0.001"), (0.0312, "0.031"), (0.4567, "0.46"), (1.0, "1.00"), (np.nan, "—")]
)
def test_p_is_short(p: float, text: str) -> None:
    assert p_text(p) == text


def run(*words: str | Path) -> str:
    return CliRunner().invoke(table_command, [*map(str, words)], catch_exceptions=False).stdout


def test_the_command_writes_pairs_in_every_format(tmp_path: Path) -> None:
    save(tmp_path, *many(3, seeds=2))
    words = [tmp_path, "--compare", "mine,robustsplat", "--label", "mine=Ours", "--metric", "psnr"]
    text = run(*words)
    assert "differences of Ours to robustsplat" in text and "robustsplat, PSNR↑" in text
    assert max(map(len, text.splitlines()[:4])) <= 80
    latex = run(*words, "--format", "latex")
    assert "robustsplat, PSNR$\\uparrow$ & +" in latex and "{[}$-$" in latex
    assert "| robustsplat, PSNR↑ | +" in run(*words, "--format", "markdown")
    assert "<td>+" in run(*words, "--format", "html")
    (row,) = csv.DictReader(io.StringIO(run(*words, "--format", "csv")))
    assert (row["method"], row["other"], row["scenes"], row["images"]) == ("Ours", "robustsplat", "3", "18")
    assert float(row["images_low"]) < float(row["difference"]) < float(row["scenes_high"])
    assert 0 < float(row["p"]) <= float(row["p_holm"]) <= 1
    with pytest.raises(AwError, match="--compare is a table of its own"):
        run(*words, "--layout", "paper")


def test_labels_name_and_order_rows_notes_and_ranks(tmp_path: Path) -> None:
    results = [*many(2), *(fake_result("3dgs+truth", f"s{k}", psnr=(30.0,) * 6) for k in range(2))]
    labels = ["robustsplat=RobustSplat", "3dgs+truth=Oracle", "mine=Ours"]
    runs = read_runs(save(tmp_path, *results), labels=labels)
    for tables in (papers.in_blocks(runs), papers.paper(runs), papers.means(runs)):
        assert [row.name for row in tables[0].rows] == ["3dgs", "RobustSplat", "Oracle", "Ours"]
        assert tables[0].rows[3].cells[0].rank == 1 and tables[0].rows[2].cells[0].rank is None
        assert [row.cite for row in tables[0].rows] == ["", "fu2025robustsplat", "", ""]
        assert any(note.startswith("references, not ranked: Oracle") for note in tables[-1].notes)
        assert any(note.startswith("RobustSplat: features") for note in tables[-1].notes)
    latex = run(tmp_path, *(f"--label={label}" for label in labels), "--format", "latex")
    assert "RobustSplat~\\cite{fu2025robustsplat} &" in latex and "\n3dgs &" in latex
    with pytest.raises(AwError, match="unknown method 'mne'"):
        run(tmp_path, "--label", "mne=Ours")
    tidy = list(csv.DictReader(io.StringIO(run(tmp_path, "--label", "mine=Ours", "--format", "tidy"))))
    assert {row["method"] for row in tidy} == {"3dgs", "3dgs+truth", "robustsplat", "Ours"}
