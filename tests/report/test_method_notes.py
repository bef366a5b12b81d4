"""What tables say about a method below its rows."""

from pathlib import Path

import yaml

from ambiguous_wild.harness.ablation_study import plan_study
from ambiguous_wild.harness.store import read_runs
from ambiguous_wild.methods import MethodEntry, register, registry
from ambiguous_wild.report.ablation_report import markdown_of, report
from ambiguous_wild.report.comparison import comparison
from ambiguous_wild.splat.pace import TrainConfig
from tests.harness.fake_runs import fake_result, save
from tests.tiny_scene import write_tiny_scene


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


def test_a_note_of_a_plugin_may_hold_options(tmp_path, monkeypatch):
    monkeypatch.setattr(registry, "registered", {})
    register(MethodEntry("mine", "", "m:f", note="of size {size}"))
    assert "mine: of size 3" in notes_of(tmp_path, ("mine", {"size": 3}))
