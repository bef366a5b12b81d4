"""What stands below a table: doubts about test photos, missing masks, times, and networks of methods."""

import csv
import io
from pathlib import Path
from typing import Any

import yaml

from ambiguous_wild.harness.ablation_study import plan_study, report
from ambiguous_wild.harness.store import read_runs
from ambiguous_wild.methods import MethodEntry, register, registry
from ambiguous_wild.report import papers
from ambiguous_wild.report.ablation_report import markdown_of
from ambiguous_wild.report.comparison import comparison
from ambiguous_wild.report.plain_formats import fitted, to_long_csv, to_wide_csv
from ambiguous_wild.report.typeset import to_html as html_of
from ambiguous_wild.splat.train_config import TrainConfig
from tests.harness.fake_runs import fake_result, save
from tests.report.test_tables import RENDERERS, cell, keys, table_of, to_latex
from tests.tiny_scene import write_tiny_scene

MIXED = {"test_photos": "test photos may hold distractors: every 8th photo tests"}


def ghosts(consistent: bool = True, **changes: Any) -> list[dict[str, Any]]:
    """Runs on a scene whose test photos hold distractors: the one that draws them has more PSNR."""
    runs = []
    for method, psnr, true in (("3dgs", 22.0, 19.0), ("a", 21.0, 23.0), ("b", 20.0, 21.0)):
        rows = [{"name": f"{k}.png", "psnr": psnr + k, "ssim": psnr / 30} for k in range(3)]
        for row in rows if consistent else []:
            row["psnr_consistent"] = true
        runs.append(fake_result(method, per_image=rows, facts=MIXED, missing={}, **changes))
    return runs


def test_the_note_names_the_pixels_of_each_metric_that_is_ranked_instead(tmp_path: Path) -> None:
    runs = ghosts()
    for run in runs:
        for row in run["per_image"]:
            row["psnr_valid"] = 20.0
    table = papers.in_blocks(read_runs(save(tmp_path, *runs)))
    (note,) = [note for note in table[-1].notes if "ranked is" in note]
    assert "PSNR valid, over pixels that the masks of test photos keep" in note
    assert "PSNR consistent, over pixels that other photos show alike" in note


def test_the_model_with_the_ghosts_is_not_first_where_test_photos_may_hold_distractors(
    tmp_path: Path,
) -> None:
    table = papers.in_blocks(read_runs(save(tmp_path, *ghosts())))
    for method in ("3dgs", "a", "b"):
        assert cell(table, method, "psnr").rank is None and cell(table, method, "ssim").rank is None
        assert not cell(table, method, "psnr").tie
    assert [cell(table, m, "psnr_consistent").rank for m in ("3dgs", "a", "b")] == [3, 1, 2]
    assert cell(table, "a", "fps").rank is None  # equal
    (note,) = [note for note in table[-1].notes if "distractors" in note]
    assert note == (
        "test photos may hold distractors: every 8th photo tests (yard): † is not ranked, as a model that "
        "draws distractors gains by it; ranked is PSNR consistent, over pixels that other photos show alike"
    )
    for name, render in (RENDERERS | {"html": html_of}).items():
        text = render(table)
        assert "test photos may hold distractors" in text, name
        assert ("PSNR†" in text or r"PSNR\dag{}" in text) or name == "csv"
        assert "PSNR consistent†" not in text and "MB†" not in text
    shown = [line for line in to_latex(table).splitlines() if not line.startswith("%")]
    assert any("test photos may hold distractors" in line for line in shown)
    (paper,) = papers.paper(read_runs(tmp_path))
    heads = [c.label for c in paper.columns]
    assert heads[:3] == ["PSNR†↑", "PSNR consistent↑", "SSIM†↑"]
    for text in (to_wide_csv(table), to_long_csv([paper])):
        assert all("† is not ranked" in row["note"] for row in csv.DictReader(io.StringIO(text)))
    assert "psnr_consistent" in keys(fitted(table, 40))


def test_without_such_a_metric_nothing_is_ranked_by_photos_with_distractors(tmp_path: Path) -> None:
    clean = [fake_result(m, "clean", psnr=(p,)) for m, p in (("3dgs", 20.0), ("a", 21.0), ("b", 22.0))]
    table = table_of(tmp_path, *ghosts(consistent=False, scene="mixed"), *clean)
    ranks = [[cell(table, m, "psnr", which).rank for m in ("3dgs", "a", "b")] for which in range(3)]
    assert ranks == [[None] * 3, [3, 2, 1], [None] * 3]  # the mean, clean, mixed
    labels = [t.columns[0].label for t in table]
    assert labels == ["PSNR†↑", "PSNR↑", "PSNR†↑"]
    (note,) = [note for note in table[-1].notes if "distractors" in note]
    assert note.endswith("gains by it") and "(mixed)" in note


def test_why_there_is_no_mask_iou_stands_below(tmp_path: Path) -> None:
    short = {"no_masks": "masks had not begun at 200 iterations"}
    scored = fake_result("mine", masks={"iou": 0.5, "precision": 0.6, "recall": 0.7, "images": 2})
    none = fake_result("3dgs", facts={"no_masks": "the method makes no masks"})
    late = [fake_result(m, facts=short) for m in ("refinesplat", "robustsplat")]
    notes = table_of(tmp_path / "some", scored, none, *late)[-1].notes
    assert "no mask IoU: 3dgs on yard: the method makes no masks" in notes
    assert (
        "no mask IoU: refinesplat on yard, robustsplat on yard: masks had not begun at 200 iterations"
        in notes
    )
    notes = table_of(tmp_path / "absent", none, *late)[-1].notes  # no run has masks: there is no column
    assert [note for note in notes if note.startswith("no mask IoU")] == [
        "no mask IoU: refinesplat on yard, robustsplat on yard: masks had not begun at 200 iterations"
    ]


def test_times_that_were_not_alone_share_a_line_and_give_way_in_a_narrow_table(tmp_path: Path) -> None:
    busy = {
        method: fake_result(method, psnr=(psnr,), masks={"iou": 0.5, "recall": 0.5, "images": 1})
        for method, psnr in (("a", 20.0), ("b", 21.0))
    }
    for used, run in zip(("1.4", "1.5"), busy.values()):
        why = f"other programs used {used} of 2 processors"
        run["cost"]["timing"] = {"verdict": "contended", "reason": why, "kernel": "cpu-1"}
    table = table_of(tmp_path, *busy.values())
    lines = [note for note in table[-1].notes if note.startswith("times not ranked")]
    assert lines == ["times not ranked: all (contended: other programs used 1.5 of 2 processors)"]
    narrow = keys(fitted(table, 52))
    assert {"psnr", "ssim", "mask_iou"} <= {*narrow} and "train_s" not in narrow


def notes_of(root: Path, *methods: tuple[str, dict]) -> list[str]:  # type: ignore[type-arg]
    save(root, *(fake_result(name, options=options) for name, options in methods))
    for name, options in methods:
        folder = "".join(c if c.isalnum() else "_" for c in name)
        config = {"method": name, "options": options}
        (root / "yard" / folder / "seed0" / "config.yaml").write_text(yaml.safe_dump(config))
    return list(comparison(read_runs(root))[-1].notes)


def test_a_note_that_is_the_same_for_all_runs_stands_in_the_docs_alone(tmp_path):
    assert not [
        n for n in notes_of(tmp_path, ("3dgs", {}), ("refinesplat", {})) if n.startswith("refinesplat")
    ]
    about = registry.get_method("refinesplat").about([])
    assert about.startswith("weight-free; ") and "docs/fidelity.md" in about  # as 'aw methods' shows it
    assert "refinesplat" in (Path(__file__).parents[2] / "docs/fidelity.md").read_text()


def test_methods_with_equal_notes_share_a_line(tmp_path):
    both = {"features": "vgg16"}
    notes = notes_of(tmp_path, ("robustsplat", both), ("spotlesssplats", both))
    assert "robustsplat, spotlesssplats: features vgg16" in notes


def test_the_papers_method_names_the_networks_of_its_runs(tmp_path):
    options = {"features": "sceneconv", "instances": "graph", "mask": {"w2": None}}
    notes = notes_of(tmp_path, ("refinesplat-paper", options))
    assert any("features sceneconv, instances graph" in n for n in notes)
    nothing = notes_of(tmp_path / "old", ("refinesplat-paper", {}))
    assert any("features not recorded" in n for n in nothing)


def test_baselines_on_features_name_them(tmp_path):
    both = {"features": "vgg16", "instances": "graph"}
    for method, said in (("robustsplat", "features vgg16"), ("dronesplat", "instances graph")):
        assert f"{method}: {said}" in notes_of(tmp_path / method, (method, both))


def test_variants_and_grafts_are_their_methods(tmp_path):
    variant = {"features": "labhog", "instances": "graph"}
    graft = {"host": {"features": "x"}, "mask": {"features": "sceneconv", "instances": "graph"}}
    notes = notes_of(
        tmp_path,
        ("refinesplat-paper@masks-local", variant),
        ("robustsplat@mask=refinesplat-paper", graft),
    )
    (note,) = [n for n in notes if n.startswith("refinesplat-paper: ")]
    assert "features labhog/sceneconv, instances graph" in note


def test_a_graft_in_an_ablation_names_the_options_of_its_donor(tmp_path):
    options = {"host": {"features": "x"}, "mask": {"features": "sceneconv", "instances": "graph"}}
    notes = notes_of(tmp_path, ("refinesplat-paper@plug-in-wildgaussians-t-ent", options))
    assert any("features sceneconv, instances graph" in n for n in notes)


def test_another_method_in_an_ablation_gets_its_networks_and_the_report_names_them(tmp_path):
    scene = write_tiny_scene(tmp_path / "scene")
    for settings, features in ((["features=sceneconv", "lambda_id=0.5"], "sceneconv"), ([], "labhog")):
        study = plan_study(
            "refinesplat-paper",
            [scene],
            [0],
            TrainConfig(iterations=9),
            settings=settings,
            groups=["modules"],
        )
        (row,) = [row for row in study.rows if row.variant.name == "robustsplat"]
        assert row.cells[0].options.features == features
        own = "refinesplat-paper@modules-robustsplat"
        assert row.cells[0].method.name == (own if settings else "robustsplat")
        page = markdown_of(report(study, tmp_path / "runs"))
        (line,) = [line for line in page.splitlines() if line.startswith("| robustsplat")]
        assert f"`features={features}`" in line


def test_the_report_of_an_ablation_says_it_too(tmp_path):
    scene = write_tiny_scene(tmp_path / "scene")
    plan = plan_study("refinesplat-paper", [scene], [0], TrainConfig(iterations=9), groups=["alpha1"])
    data = report(plan, tmp_path / "runs")
    assert "features labhog, instances graph" in markdown_of(data)


def test_a_note_of_a_plugin_may_hold_options(tmp_path):
    register(MethodEntry("mine", "", "m:f", note="of size {size}"))
    assert "mine: of size 3" in notes_of(tmp_path, ("mine", {"size": 3}))
