"""What tables say about a method below its rows."""

from pathlib import Path

import yaml

from ambiguous_wild.harness.running.store import read_runs
from ambiguous_wild.harness.tables.comparison import comparison
from ambiguous_wild.methods import MethodEntry, register, registry
from tests.harness.fake_runs import fake_result, save


def notes_of(root: Path, *methods: tuple[str, dict]) -> list[str]:  # type: ignore[type-arg]
    save(root, *(fake_result(name) for name, _ in methods))
    for name, options in methods:
        folder = "".join(c if c.isalnum() else "_" for c in name)
        config = {"method": name, "options": options}
        (root / "yard" / folder / "seed0" / "config.yaml").write_text(yaml.safe_dump(config))
    return list(comparison(read_runs(root)).notes)


def test_refinesplat_is_said_to_be_weight_free(tmp_path):
    (note,) = [n for n in notes_of(tmp_path, ("3dgs", {}), ("refinesplat", {})) if "weight-free" in n]
    assert note.startswith("refinesplat: ")
    assert not [n for n in notes_of(tmp_path / "other", ("3dgs", {})) if "weight-free" in n]


def test_the_papers_method_names_the_networks_of_its_runs(tmp_path):
    options = {"features": "sceneconv", "instances": "graph", "mask": {"w2": None}}
    notes = notes_of(tmp_path, ("refinesplat-paper", options))
    assert any("features sceneconv, instances graph" in n for n in notes)
    nothing = notes_of(tmp_path / "old", ("refinesplat-paper", {}))
    assert any("features not recorded" in n for n in nothing)


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


def test_a_note_of_a_plugin_may_hold_options(tmp_path, monkeypatch):
    monkeypatch.setattr(registry, "_registered", {})
    register(MethodEntry("mine", "", "m:f", note="of size {size}"))
    assert "mine: of size 3" in notes_of(tmp_path, ("mine", {"size": 3}))
