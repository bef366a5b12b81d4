"""`aw methods` lists the registry, plugins included."""

from __future__ import annotations

import json
import re
from pathlib import Path

from ambiguous_wild.core import AwError
from ambiguous_wild.methods import registry
from tests.command_line import aw


def shown(*args: str) -> str:
    return aw("methods", *args).stdout


def test_every_method_is_listed_with_what_it_needs() -> None:
    out = shown()
    for name, entry in registry.all_methods().items():
        block = out[out.index(name) :]
        assert entry.summary.split()[0] in block
    assert f"{len(registry.all_methods())} methods" in out
    assert "needs: nothing beyond the core" in out and "Kerbl" in out


def test_json_holds_the_same_facts() -> None:
    rows = json.loads(shown("--json"))
    known = registry.all_methods()
    assert [r["name"] for r in rows] == sorted(known)
    for row in rows:
        entry = known[row["name"]]
        assert (row["summary"], row["paper"], row["needs"]) == (entry.summary, entry.paper, entry.needs)


def test_a_plugin_is_listed(tmp_path: Path) -> None:
    plugin = tmp_path / "mine.py"
    plugin.write_text(
        "'About the file.'\nfrom ambiguous_wild.methods import MethodEntry, register\n"
        "register(MethodEntry(name='mine', summary='my own', recipe='x:y', needs='a GPU'))\n"
    )
    out = shown("--plugin", str(plugin))
    assert "mine" in out and "needs: a GPU" in out
    plugin.write_text(plugin.read_text().replace("'x:y'", "lambda options: None"))
    full = shown("--plugin", str(plugin), "mine")
    assert "my own" in full and "About the file" not in full


def test_a_method_in_full_says_what_differs_and_its_options() -> None:
    out = shown("spotlesssplats")
    assert "Ours:" in out and "arXiv 2406.20055" in out and "Stable Diffusion" in out
    assert "features=labhog" in out and "upper=0.9" in out and "density.free_colour=8002" in out
    line = next(row for row in out.splitlines() if "upper=0.9" in row)
    assert "published also 0.8" in line


def test_papers_have_keys_for_a_bibliography() -> None:
    assert "\\cite{fu2025robustsplat}" in " ".join(shown("robustsplat").split())
    keys = {entry.name: entry.cite for entry in registry.BUILTIN if entry.cite}
    assert all(re.fullmatch(r"[a-z]+20\d\d[a-z0-9]+", key) for key in keys.values())
    assert {entry.name for entry in registry.BUILTIN if "arXiv" in entry.paper} - keys.keys() == {"uad"}


def test_every_builtin_method_is_described_in_full() -> None:
    for name, entry in registry.all_methods().items():
        (one,) = json.loads(shown(name, "--json"))
        assert one["name"] == name and one["about"], name
        assert {o["key"].split(".")[0] for o in one["options"]} == set(vars(entry.options())), name
    assert "masks-local" not in shown("refinesplat") and "ablations" in shown("refinesplat")
    assert "trainings" in shown("t-3dgs+2passes")


def test_options_of_refinesplats_masks_are_explained_however_their_lines_are_wrapped() -> None:
    (one,) = json.loads(shown("refinesplat", "--json"))
    said = {o["key"]: o["comment"] for o in one["options"]}
    assert "must see a surface" in said["mask.multiview.seen_by"]  # wrapped by the formatter
    assert said["first_look.consensus"].startswith("in a crowd")  # on the lines above
    assert [k for k in said if k.startswith(("mask.", "first_look.")) and not said[k]] == []


def test_the_table_agrees_with_what_recipes_build() -> None:
    from ambiguous_wild.methods.describe import BUILTIN_TRAITS
    from ambiguous_wild.splat.density import DensityControl
    from ambiguous_wild.splat.method_hooks import MaskPolicy
    from ambiguous_wild.splat.rendered import GSPLAT_SUMS, check_needs

    assert set(BUILTIN_TRAITS) == {entry.name for entry in registry.BUILTIN}
    for entry in registry.BUILTIN:
        traits, parts = BUILTIN_TRAITS[entry.name], entry.build(entry.options())
        own = type(parts.mask)
        masks = own.keep is not MaskPolicy.keep or own.predict is not MaskPolicy.predict
        assert bool(traits.masks) == masks, entry.name
        colours = any(effect.acts("shade") for effect in parts.effects)
        assert bool(traits.appearance) == colours, entry.name
        assert bool(traits.density) >= (parts.density is not DensityControl), entry.name
        try:
            check_needs(parts.density.needs, GSPLAT_SUMS)
            offered = True
        except AwError:
            offered = False
        assert traits.cpu_only != offered, entry.name


def test_the_table_has_a_line_a_method_and_says_unknown_of_others(tmp_path: Path) -> None:
    out = shown("--table")
    for name in registry.all_methods():
        assert any(line.startswith(name + " ") for line in out.splitlines()), name
    plugin = tmp_path / "mine.py"
    plugin.write_text(
        "from ambiguous_wild.methods import MethodEntry, register\n"
        "register(MethodEntry('mine', 'my own', 'ambiguous_wild.methods.threedgs:build'))\n"
    )
    rows = json.loads(shown("--table", "--json", "--plugin", str(plugin)))
    assert next(row for row in rows if row["method"] == "mine")["masks"] == "?"
