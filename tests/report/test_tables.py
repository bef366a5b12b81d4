"""Comparisons: what is averaged, what is missing, who is first; and four formats that keep names text."""

from __future__ import annotations

import csv
import io
import math
from pathlib import Path

import numpy as np
import pytest

from ambiguous_wild.core import AwError
from ambiguous_wild.harness.measures import MEASURES, measure
from ambiguous_wild.harness.store import read_runs
from ambiguous_wild.report import papers, plain_formats
from ambiguous_wild.report.comparison import comparison
from ambiguous_wild.report.papers import cost_at_the_end
from ambiguous_wild.report.plain_formats import fitted, to_long_csv, to_markdown, to_text, to_wide_csv
from ambiguous_wild.report.table_layout import Table, TableCell
from ambiguous_wild.report.typeset import to_html as html_of
from ambiguous_wild.report.typeset import to_latex as latex_of
from tests.harness.fake_runs import failed, fake_result, save, start


def cell(tables: list[Table], method: str, key: str, which: int = 0) -> TableCell:
    row = next(r for r in tables[which].rows if r.name == method)
    return row.cells[keys(tables).index(key)]


def keys(tables: list[Table]) -> list[str]:
    return [c.measure.key for c in tables[0].columns]


def to_latex(tables: list[Table]) -> str:
    return latex_of([cost_at_the_end(tables)])


RENDERERS = {"text": to_text, "markdown": to_markdown, "csv": to_wide_csv, "latex": to_latex}


def table_of(tmp_path: Path, *results: dict, **options) -> list[Table]:  # type: ignore[no-untyped-def, type-arg]
    return comparison(read_runs(save(tmp_path, *results)), **options)


def test_mean_over_images_then_seeds_then_scenes(tmp_path: Path) -> None:
    table = table_of(
        tmp_path,
        fake_result("a", "one", 0, (10.0, 20.0)),
        fake_result("a", "one", 1, (20.0, 20.0)),
        # Four images: a mean over all images at once would weigh this scene double.
        fake_result("a", "two", 0, (30.0, 30.0, 30.0, 34.0)),
        fake_result("a", "two", 1, (31.0, 31.0, 31.0, 31.0)),
    )
    assert [t.columns[0].scene for t in table] == ["", "one", "two"]
    assert cell(table, "a", "psnr", 1).value == 17.5
    assert cell(table, "a", "psnr", 1).spread == pytest.approx(np.std([15.0, 20.0], ddof=1))
    assert cell(table, "a", "psnr", 2).value == 31.0
    mean = cell(table, "a", "psnr")
    assert mean.value == 24.25
    assert mean.spread == pytest.approx(np.std([(15 + 31) / 2, (20 + 31) / 2], ddof=1))
    assert cell(table, "a", "train_s").value == 10.5
    assert table[0].rows[0].runs == 4


def test_one_scene_is_one_block_without_spread(tmp_path: Path) -> None:
    table = table_of(tmp_path, fake_result("a"))
    assert [t.columns[0].scene for t in table] == ["yard"]
    assert math.isnan(cell(table, "a", "psnr").spread)
    assert "±" not in to_text(table)


def test_interval_over_the_images_of_a_scene(tmp_path: Path) -> None:
    table = table_of(tmp_path, fake_result("a", psnr=(10.0, 20.0, 30.0)), fake_result("b", psnr=(5.0,)))
    found = cell(table, "a", "psnr")
    half = 4.302653 * 10.0 / math.sqrt(3.0)  # Student's t of 2 degrees of freedom
    assert found.value == 20.0 and (found.low, found.high) == pytest.approx((20.0 - half, 20.0 + half))
    assert math.isnan(cell(table, "b", "psnr").low)


@pytest.mark.parametrize(
    ("key", "order"), [("psnr", "cbad"), ("train_s", "abcd"), ("iterations", ""), ("fps", "dcba")]
)
def test_first_second_third_follow_the_direction_of_merit(key: str, order: str, tmp_path: Path) -> None:
    psnr = {"a": 20.0, "b": 21.0, "c": 22.0, "d": 19.0}
    results = []
    for i, (method, value) in enumerate(psnr.items()):
        results.append(fake_result(method, psnr=(value,)))
        results[-1]["cost"] |= {
            "train_s": 10.0 + i,
            "iterations": 100 + i,
            "fps": 5.0 + i,
            "reference_s": 1.0,
        }
    table = table_of(tmp_path, *results, metrics=[key])
    ranks = {m: cell(table, m, key).rank for m in psnr}
    assert ranks == {m: (order.index(m) + 1 if m in order[:3] else None) for m in psnr}


def test_unequal_effects_are_a_column_and_a_note_of_every_format(tmp_path: Path) -> None:
    on = {"effects": ["exposure", "skybox"]}
    unequal = table_of(tmp_path / "u", fake_result("a", facts=on), fake_result("b"))
    for name, render in RENDERERS.items():
        text = render(unequal)
        assert "exposure, skybox" in text and "not comparable: effects" in text, name
    shown = [line for line in to_latex(unequal).splitlines() if not line.startswith("%")]
    assert any("not comparable: effects" in line for line in shown)
    equal = table_of(tmp_path / "e", fake_result("a", facts=on), fake_result("b", facts=on))
    assert "effects" not in keys(equal)
    assert "all methods trained with effects: exposure, skybox" in to_text(equal)
    assert not any("not comparable" in note for note in equal[-1].notes)


def test_colours_that_nobody_fitted_are_a_note_and_psnr_affine_is_shown(tmp_path: Path) -> None:
    whole: dict[str, object] = {"effects": ["appearance", "skybox"]}
    half = whole | {"protocol": "half", "fitted": {"effects": ["appearance"], "steps": 128}}
    more = {"ssim": 0.5, "flip": 0.2, "psnr_affine": 21.1, "psnr_covered": 19.0, "lpips_vgg": 0.3}
    rows = [{"name": "0.png", "psnr": 16.4, "lpips_alex": 0.2, **more}]
    for facts, said in ((whole, 1), ({"effects": ["exposure"]}, 1), (half, 0), ({"effects": ["skybox"]}, 0)):
        runs = [fake_result(m, facts=facts, per_image=rows, missing={}) for m in ("a", "b")]
        table = table_of(tmp_path / f"{len(list(tmp_path.iterdir()))}", *runs)
        for render in (to_text, to_markdown, html_of):
            assert render(table).count("colours of test photos are not fitted (yard)") == said, facts
        assert ("psnr_affine" in keys(fitted(table, 60))) == bool(said)
        assert len(to_text(fitted(table, 60)).splitlines()[1]) <= 60


def test_unequal_features_and_protocols_are_named(tmp_path: Path) -> None:
    half = {"protocol": "half", "fitted": {"steps": 0}}
    table = table_of(
        tmp_path,
        fake_result("a", options={"masks": {"features": "dino"}}),
        fake_result("b", options={"features": "none"}, facts=half),
        fake_result("c"),
    )
    notes = "\n".join(table[-1].notes)
    assert "not comparable: features differ on yard: a: dino, b: none;" in notes
    assert "not comparable: protocols differ on yard" in notes


def test_settings_code_and_seeds_that_differ_are_said(tmp_path: Path) -> None:
    other = {"options": {"every": 2}, "code_hash": "1" * 64}
    save(tmp_path, fake_result("a"), fake_result("a", seed=1, **other), fake_result("b"))
    (tmp_path / "yard/b/seed0/config.yaml").write_text("train: {max_gaussians: 50, iterations: 7, probes: 0}")
    notes = "\n".join(comparison(read_runs(tmp_path))[-1].notes)
    assert "not comparable: runs of a on yard differ in options, so they have no mean" in notes
    assert "settings of training differ on yard: a: not recorded" in notes
    assert "2 states of ambiguous_wild's code" in notes and "numbers of seeds: a 2, b 1" in notes
    for seed in (0, 1):
        settings = f"train: {{max_gaussians: null, seed: {seed}}}"
        (tmp_path / f"yard/a/seed{seed}/config.yaml").write_text(settings)
    notes = "\n".join(comparison(read_runs(tmp_path))[-1].notes)
    assert "settings of training differ on yard: a: max_gaussians auto, b: max_gaussians 50" in notes
    layouts = to_wide_csv(comparison(read_runs(tmp_path))), to_long_csv(papers.paper(read_runs(tmp_path)))
    for row in (row for text in layouts for row in csv.DictReader(io.StringIO(text))):
        for what in ("differ in options", "settings of training", "states of", "numbers of seeds"):
            assert what in row["note"]


@pytest.mark.parametrize("scenes", [("yard",), ("room", "yard")])
def test_runs_of_versions_of_a_methods_file_have_no_mean(tmp_path: Path, scenes: tuple[str, ...]) -> None:
    results = [fake_result(method, s, seed) for method in "ab" for s in scenes for seed in (0, 1)]
    save(tmp_path, *results)
    for result in results:  # b was edited, between its seeds or between the scenes
        edited = result["scene"] == "room" if len(scenes) > 1 else result["seed"] == 1
        folder = tmp_path / result["scene"] / result["method"] / f"seed{result['seed']}"
        source = "b2" if edited and result["method"] == "b" else "b1"
        (folder / "config.yaml").write_text(f"source: {source}")
    table = comparison(read_runs(tmp_path))
    (named,) = {note for note in table[-1].notes if note.startswith("not comparable: runs of b on")}
    assert "version of the method's file, so they have no mean" in named and named in to_text(table)
    states = {row.name: row.cells[0].state for row in table[0].rows}
    assert states == {"a": "ok", "b": "missing"}


def test_equal_in_print_shares_the_rank(tmp_path: Path) -> None:
    runs = [fake_result(m, psnr=(p,)) for m, p in (("a", 20.001), ("b", 20.002), ("c", 19.0))]
    table = table_of(tmp_path, *runs, metrics=["psnr", "gaussians"])
    assert [cell(table, m, "psnr").rank for m in "abc"] == [1, 1, 3]
    # All alike: there is no first.
    assert [cell(table, m, "gaussians").rank for m in "abc"] == [None] * 3


def test_an_infinite_psnr_enters_no_mean_and_no_rank(tmp_path: Path) -> None:
    first = (("a", (math.inf, 20.0)), ("b", (30.0, 20.0)))
    runs = [fake_result(m, "one", psnr=p) for m, p in first] + [
        fake_result(m, "two", psnr=(20.0,)) for m in "ab"
    ]
    table = table_of(tmp_path, *runs)
    assert cell(table, "a", "psnr").value == 20.0 and cell(table, "a", "psnr").rank == 2
    assert cell(table, "b", "psnr").value == 22.5 and cell(table, "b", "psnr").rank == 1
    assert "psnr of a on one: mean of 1 of 2 values; the others are not finite" in to_text(table)
    only = table_of(tmp_path / "only", fake_result("a", psnr=(math.inf,)), fake_result("b", psnr=(20.0,)))
    assert cell(only, "a", "psnr").state == "missing" and cell(only, "b", "psnr").rank is None


def test_a_mean_over_a_missing_scene_is_missing_and_said(tmp_path: Path) -> None:
    runs = [fake_result(m, s) for m, s in (("a", "one"), ("a", "two"), ("c", "one"))]
    table = table_of(tmp_path, *runs, fake_result("b", "one", psnr=(40.0, 40.0)))
    assert cell(table, "b", "psnr").state == "missing"
    assert cell(table, "a", "psnr").rank is None  # alone: nothing to be first of
    assert cell(table, "b", "psnr", 2).state == "absent"
    assert cell(table, "b", "psnr", 1).rank == 1
    assert "no result: b, c on two; no mean over scenes" in table[-1].notes


def test_a_failed_seed_fails_its_cell(tmp_path: Path) -> None:
    runs = [fake_result(m, s) for m, s in (("a", "two"), ("b", "one"), ("b", "two"))]
    table = table_of(tmp_path, fake_result("a", "one", 0, (50.0,)), failed("a", "one", 1), *runs)
    assert cell(table, "a", "psnr").state == "failed" and cell(table, "a", "psnr", 1).state == "failed"
    assert cell(table, "a", "psnr", 2).state == "ok"
    assert cell(table, "b", "psnr", 1).rank is None
    assert "failed: a on one, seed 1: loss is not finite" in table[-1].notes
    assert "failed" in to_text(table).splitlines()[3]


def test_where_every_run_failed_the_table_says_so(tmp_path: Path) -> None:
    table = table_of(tmp_path, failed("a"), failed("b"))
    assert {c.state for row in table[0].rows for c in row.cells} == {"failed"}
    for render in RENDERERS.values():
        assert "failed" in render(table)


def test_a_method_with_an_unfinished_seed_shows_its_mean_but_no_rank(tmp_path: Path) -> None:
    start(tmp_path, "a", "one", 1)
    methods = {"a": 50.0, "b": 20.0, "c": 10.0}
    table = table_of(
        tmp_path, *(fake_result(m, s, psnr=(p,)) for m, p in methods.items() for s in ("one", "two"))
    )
    assert cell(table, "a", "psnr", 1).value == 50.0
    ranks = [[cell(table, m, "psnr", block).rank for m in "abc"] for block in range(3)]
    assert ranks == [[None, 1, 2], [None, 1, 2], [1, 2, 3]]  # mean, one, two
    assert "not ranked: a on one: 1 run incomplete" in table[-1].notes


def test_who_knows_the_truth_is_not_ranked(tmp_path: Path) -> None:
    best = {"3dgs+truth": 50.0, "mine@density=a,mask=truth": 40.0, "3dgs-clean": 45.0}
    rest = {"mine@mask=mask=truths": 30.0, "3dgs": 20.0}
    table = table_of(tmp_path, *(fake_result(m, psnr=(p,)) for m, p in (best | rest).items()))
    assert [cell(table, m, "psnr").rank for m in best] == [None] * 3
    assert [cell(table, m, "psnr").rank for m in rest] == [1, 2]
    (note,) = [n for n in table[-1].notes if n.startswith("references, not ranked")]
    assert all(m in note for m in best)


def test_missing_metrics_carry_their_reason_once(tmp_path: Path) -> None:
    table = table_of(tmp_path, fake_result("a"), fake_result("b"))
    assert "lpips_alex" not in keys(table)  # an empty column says nothing
    told = [n for n in table[-1].notes if "lpips_alex" in n]
    assert told == ["missing: lpips_alex: weights missing: put heads.pth into W"]


def test_a_column_that_was_asked_for_stays_though_it_is_empty(tmp_path: Path) -> None:
    table = table_of(tmp_path, fake_result("a"), metrics=("psnr", "lpips_alex"))
    assert cell(table, "a", "lpips_alex").state == "missing"


def test_scenes_where_a_measure_is_undefined_are_left_out_of_its_mean(tmp_path: Path) -> None:
    masked = {"iou": 0.8, "precision": 0.9, "recall": 0.85, "images": 2}
    nothing = {"iou": 0.0, "precision": 0.0, "recall": None, "images": 2}  # a pixel masked, no distractor
    scores = {"a": (masked, nothing), "b": ({**masked, "iou": 0.6}, nothing), "c": (None, None)}
    runs = [
        fake_result(m, scene, masks=of)
        for m, both in scores.items()
        for scene, of in zip(("one", "clean"), both)
    ]
    table = table_of(tmp_path, *runs)
    assert cell(table, "a", "mask_iou").value == 0.8 and cell(table, "b", "mask_iou").value == 0.6
    assert cell(table, "c", "mask_iou").state == "missing"  # it has no masks at all
    assert table[1].title == "clean"
    assert cell(table, "a", "mask_iou", 1).state == "missing"
    assert "undefined on clean, left out of the mean: mask IoU" in table[-1].notes
    # A gap that is no such case: no mean.
    (tmp_path / "more").mkdir()
    table = table_of(
        tmp_path / "more", fake_result("a", "one", masks=masked), fake_result("a", "two"),
        fake_result("b", "one", masks=masked), fake_result("b", "two", masks=masked),
    )  # fmt: skip
    assert cell(table, "a", "mask_iou").state == "missing" and cell(table, "b", "mask_iou").value == 0.8


@pytest.mark.parametrize("width", [40, 60, 100])
def test_text_fits_the_width_and_names_what_it_leaves_out(width: int, tmp_path: Path) -> None:
    more = {"flip": 0.2, "psnr_covered": 19.0, "ssim_inria": 0.7, "lpips_vgg": 0.3}
    rows = [{"name": "0.png", "psnr": 20.0, "ssim": 0.5, "lpips_alex": 0.2, **more}]
    table = table_of(
        tmp_path,
        *(fake_result(m, seed=k, per_image=rows, missing={}) for m in ("a", "longer") for k in (0, 1)),
    )
    shown = fitted(table, width)
    lines = to_text(shown).splitlines()
    aligned = [line for line in lines if line.startswith(("a ", "longer", "method", "─"))]
    assert len(aligned) == 4 and max(map(plain_formats.display_width, aligned)) <= width
    left = keys(shown)
    assert left[0] == "psnr" and "lpips_alex" in left and len(left) < len(table[0].columns)
    (note,) = [n for n in shown[-1].notes if n.startswith("not shown")]
    named = note.partition(": ")[2].partition("; ")[0].split(", ")
    assert named == [c.measure.label for c in table[0].columns if c.measure.key not in left]
    # The widest columns of all still leave one.
    assert keys(fitted(table, 1)) == ["psnr"]


def test_a_reason_that_concerns_some_names_them(tmp_path: Path) -> None:
    full = [{"name": "0.png", "psnr": 20.0, "ssim": 0.5, "lpips_alex": 0.2}]
    table = table_of(tmp_path, fake_result("a"), fake_result("b", per_image=full, missing={}))
    assert [cell(table, m, "lpips_alex").state for m in "ab"] == ["missing", "ok"]
    assert any(n.startswith("missing: lpips_alex for a on yard: weights") for n in table[-1].notes)


def test_a_null_without_a_reason_is_noted(tmp_path: Path) -> None:
    images = [{"name": "0.png", "psnr": 20.0, "ssim": 0.5}, {"name": "1.png", "psnr": 21.0, "ssim": None}]
    older = fake_result("c", per_image=[{"name": "0.png", "psnr": 20.0}], missing={})
    table = table_of(tmp_path, fake_result("a", per_image=images, missing={}), fake_result("b"), older)
    assert cell(table, "a", "ssim").state == cell(table, "c", "ssim").state == "missing"
    assert "missing: ssim for c on yard: it was not measured; 'aw rescore' adds it" in table[-1].notes
    assert "missing: ssim, no reason given, for 1.png (a on yard)" in table[-1].notes


@pytest.mark.parametrize("length", [math.inf, 1e300])
def test_a_length_that_is_no_number_of_iterations_is_refused_by_name(tmp_path: Path, length: float) -> None:
    odd = fake_result("b")
    odd["cost"]["iterations"] = length
    with pytest.raises(AwError, match=r"b/seed0/metrics.json is no result file.*cost\.iterations"):
        table_of(tmp_path, fake_result("a"), odd)


def test_what_cannot_be_compared_is_said(tmp_path: Path) -> None:
    other = fake_result("c", psnr=(1.0, 2.0, 3.0), scene_hash="other", version="0.2.0")
    other["cost"] |= {"device": "cuda", "iterations": 30_000}
    notes = "\n".join(table_of(tmp_path, fake_result("a"), fake_result("b"), other)[-1].notes)
    assert "come from 2 versions of the scene" in notes
    assert "different test images of yard" in notes
    assert "trainings differ in length (iterations): a 100, b 100, c 30000" in notes
    assert "different devices: a cpu, b cpu, c cuda" in notes
    assert "different versions of ambiguous_wild: 0.1.0, 0.2.0" in notes
    alike = table_of(tmp_path / "alike", fake_result("a"), fake_result("b"))[-1].notes
    assert not [n for n in alike if "differ" in n or "comparable" in n]


def test_incomplete_runs_are_below_the_table(tmp_path: Path) -> None:
    start(tmp_path, "z")
    table = table_of(tmp_path, fake_result("a"))
    for render in (to_text, to_markdown, to_latex):
        assert "still running" in render(table)
    with pytest.raises(AwError, match="no finished run"):
        comparison(read_runs(tmp_path / "yard" / "z"))


def test_columns_and_scenes_can_be_chosen(tmp_path: Path) -> None:
    results = [
        fake_result("a", s, masks={"iou": 0.5, "recall": 0.6, "images": 2}) for s in ("one", "two", "three")
    ]
    table = table_of(tmp_path, *results, metrics=["mask_iou", "psnr", "psnr"], scenes=["two"])
    assert keys(table) == ["mask_iou", "psnr"] and table[0].title == "two" and len(table) == 1
    assert cell(table, "a", "mask_iou").value == 0.5
    runs = read_runs(tmp_path)
    with pytest.raises(AwError, match="did you mean 'psnr'"):
        comparison(runs, metrics=["pnsr"])
    with pytest.raises(AwError, match="metric 'fit'"):
        comparison(runs, metrics=["fit"])
    with pytest.raises(AwError, match="did you mean 'three'"):
        comparison(runs, scenes=["thre"])


def test_a_metric_of_another_takes_its_family(tmp_path: Path) -> None:
    assert measure("psnr_distractor").better == "higher" and measure("lpips_squeeze").better == "lower"
    assert measure("psnrish").better is None and measure("psnr") is MEASURES["psnr"]
    images = [{"name": "0.png", "psnr": 20.0, "psnr_distractor": 12.0, "glare": 3.0}]
    table = table_of(tmp_path, fake_result("a", per_image=images), fake_result("b", per_image=images))
    assert {"psnr_distractor", "glare"} <= set(keys(table))


def test_csv_is_read_back_as_numbers(tmp_path: Path) -> None:
    import pandas as pd

    table = table_of(
        tmp_path, *(fake_result(m, s) for m in ("a", "b") for s in ("one", "two")), failed("c", "one")
    )
    frame = pd.read_csv(io.StringIO(to_wide_csv(table)))
    assert len(frame) == 9 and frame["psnr"].dtype == float
    mean = frame[frame["scene"].isna()].set_index("method")
    assert mean.loc["a", "psnr"] == 21.0 and mean.loc["a", "gaussians"] == 1234
    assert frame.set_index(["scene", "method"]).loc[("one", "c"), "status"] == "failed"
    assert frame.set_index(["scene", "method"]).loc[("two", "c"), "status"] == "absent"


def test_values_of_different_functions_are_neither_ranked_nor_averaged(tmp_path: Path) -> None:
    """Two files define a metric of one name: two methods are not ranked, seeds of one method have no mean."""

    def measured(method: str, seed: int, value: float, source: str) -> dict:
        record = {"label": "|grey|", "better": "lower", "digits": 2, "partial": False, "source": source * 64}
        result = fake_result(method, "one", seed)
        rows = [row | {"grey": value} for row in result["per_image"]]
        return result | {"per_image": rows, "metrics": {"grey": record}}

    table = table_of(tmp_path / "two", measured("a", 0, 0.8, "1"), measured("b", 0, 80.0, "2"))
    assert cell(table, "a", "grey").value == 0.8 and cell(table, "a", "grey").rank is None
    assert any("|grey| comes from different functions (a, b)" in note for note in table[-1].notes)
    assert r"\|grey\|" in to_markdown(table)
    table = table_of(
        tmp_path / "one", measured("a", 0, 0.8, "1"), measured("a", 1, 80.0, "2"), metrics=["grey"]
    )
    assert cell(table, "a", "grey").state == "missing"


def test_methods_of_two_protocols_are_not_ranked(tmp_path: Path) -> None:
    half = {"protocol": "half", "fitted": {"steps": 10}}
    table = table_of(tmp_path, fake_result("a", psnr=(20.0, 20.0)), fake_result("b", facts=half))
    assert {cell(table, m, "psnr").rank for m in "ab"} == {None}
    assert any(note.startswith("not comparable: protocols differ") for note in table[-1].notes)
    # the same right halves
    read = fake_result("b", psnr=(30.0, 30.0), facts=half | {"fitted": {"read_by": "gs-w"}})
    table = table_of(tmp_path / "half", fake_result("a", facts=half), read)
    assert {cell(table, m, "psnr").rank for m in "ab"} == {1, 2}


def test_rows_of_several_folders_are_their_methods(tmp_path: Path) -> None:
    """An upper bound and an unfinished method are not ranked, whatever their rows are called."""
    for folder in ("one", "two"):
        save(
            tmp_path / folder, *(fake_result(method, psnr=(30.0,)) for method in ("3dgs", "3dgs+truth", "b"))
        )
    start(tmp_path / "one", "b", seed=1)
    table = comparison(read_runs(tmp_path / "one", tmp_path / "two", tmp_path / "two" / "yard"))
    rows = {row.name: row for row in table[0].rows}
    assert len(rows) == 6  # the last folder is inside the second: no run is there twice
    for method in ("3dgs+truth in", "b in"):
        (row,) = (row for name, row in rows.items() if name.startswith(method) and "one" in name)
        assert all(cell.rank is None for cell in row.cells)
    assert any(note.startswith("references, not ranked: 3dgs+truth in") for note in table[-1].notes)


def test_what_is_not_recorded_equals_nothing(tmp_path: Path) -> None:
    """Neither a metric without a record, nor settings without a config.yaml."""
    rows = [{"name": "0.png", "psnr": 20.0, "ssim": 0.5, "tinge": 1.0}]
    table = table_of(
        tmp_path,
        *(fake_result(m, seed=s, config_hash=f"{m}{s}", per_image=rows) for m in "ab" for s in (0, 1)),
    )
    notes = "\n".join(table[-1].notes)
    assert "differ in settings that no config.yaml records, so they have no mean" in notes
    assert "tinge comes from different functions" in notes
    assert cell(table, "a", "psnr").state == "missing"


def test_options_that_differ_between_scenes_have_no_mean(tmp_path: Path) -> None:
    table = table_of(tmp_path, fake_result("a", "one"), fake_result("a", "two", options={"every": 2}))
    assert "runs of a on all scenes differ in options" in "\n".join(table[-1].notes)
    assert cell(table, "a", "psnr").state == "missing" and cell(table, "a", "psnr", 1).state == "ok"
