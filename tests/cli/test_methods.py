"""`aw methods` lists the registry, plugins included."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from click.testing import CliRunner

from ambiguous_wild.cli.methods import command
from ambiguous_wild.core import AwError
from ambiguous_wild.methods import registry


@pytest.fixture(autouse=True)
def registered(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(registry, "_registered", {})


def test_every_method_is_listed_with_what_it_needs() -> None:
    out = CliRunner().invoke(command, [], catch_exceptions=False).output
    for name, entry in registry.all_methods().items():
        block = out[out.index(name) :]
        assert entry.summary.split()[0] in block
    assert f"{len(registry.all_methods())} methods" in out
    assert "needs: nothing beyond the core" in out and "Kerbl" in out


def test_json_holds_the_same_facts() -> None:
    rows = json.loads(CliRunner().invoke(command, ["--json"], catch_exceptions=False).output)
    known = registry.all_methods()
    assert [r["name"] for r in rows] == sorted(known)
    for row in rows:
        entry = known[row["name"]]
        assert (row["summary"], row["paper"], row["needs"]) == (entry.summary, entry.paper, entry.needs)


def test_a_plugin_is_listed(tmp_path: Path) -> None:
    plugin = tmp_path / "mine.py"
    plugin.write_text(
        "from ambiguous_wild.methods import MethodEntry, register\n"
        "register(MethodEntry(name='mine', summary='my own', recipe='x:y', needs='a GPU'))\n"
    )
    out = CliRunner().invoke(command, ["--plugin", str(plugin)], catch_exceptions=False).output
    assert "mine" in out and "needs: a GPU" in out
    error = CliRunner().invoke(command, ["--plugin", str(tmp_path / "no.py")]).exception
    assert isinstance(error, AwError)
