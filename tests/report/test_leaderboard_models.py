"""`aw leaderboard publish --models`: pages of the models behind the entries."""

from __future__ import annotations

import json
import re
import shutil
from pathlib import Path
from urllib.parse import parse_qs, urlsplit

import pytest

from ambiguous_wild.core import AwError
from ambiguous_wild.report import board_edit
from tests.chromium import Browser, needs_chromium
from tests.report.board_runs import add, aw, own_scene
from tests.viewing.wall_runs import write_shown_run

HOSTILE = "</script><img src=x onerror=alert(1)>/.."


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("board")
    for name in ("porch", "yard"):
        scene = own_scene(root / name)
        for seed in (1, 2):
            write_shown_run(root / "runs", scene, "3dgs", seed, noise=20.0, count=300)
        write_shown_run(root / "runs", scene, HOSTILE, noise=5.0, count=300)
    done = add(root / "board", root / "runs", dataset="Tiny")
    assert done.exit_code == 0, done.output
    return root


def facts(page: Path) -> dict:
    found = re.search(r'<script id="data" type="application/json">(.*?)</script>', page.read_text(), re.S)
    assert found is not None
    return json.loads(found[1])


def test_every_entry_leads_to_its_model(root: Path, tmp_path: Path) -> None:
    site = tmp_path / "site"
    done = aw("publish", "--board", root / "board", "-o", site, "--models", root / "runs")
    assert done.exit_code == 0 and "2 pages with models" in done.output
    assert sorted(p.name for p in (site / "models").iterdir()) == ["tiny-porch.html", "tiny-yard.html"]
    labels = [m["label"] for m in facts(site / "models" / "tiny-porch.html")["models"]]
    assert len(labels) == 2 and labels[0].startswith("3dgs (") and labels[1].startswith(HOSTILE)
    data = facts(site / "index.html")
    links = [(r["scene"], data["models"][r["result_hash"]]) for r in data["runs"]]
    assert len(links) == 6 and all(
        link.startswith(f"models/tiny-{scene}.html#left=") for scene, link in links
    )
    assert "<img" not in (site / "models" / "tiny-porch.html").read_text()
    # Without --models an earlier page's models go, and nothing of them is left in the page.
    assert aw("publish", "--board", root / "board", "-o", site).exit_code == 0
    assert not (site / "models").exists() and facts(site / "index.html")["models"] == {}


def test_each_state_of_a_scene_has_a_page(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(board_edit, "difference_from_suite", lambda scene, dataset: "")
    for number, method in enumerate(("3dgs", "refinesplat")):
        scene = own_scene(tmp_path / str(number) / "porch")
        with (scene / "sparse/0/points3D.txt").open("a") as points:
            points.write(f"402 {number / 100} 0 4 9 9 9 0.5\n")
        write_shown_run(tmp_path / "runs" / str(number), scene, method, count=300)
    board, site = tmp_path / "board", tmp_path / "site"
    assert "2 added" in add(board, tmp_path / "runs", dataset="Tiny").output
    done = aw("publish", "--board", board, "-o", site, "--models", tmp_path / "runs")
    assert "2 pages with models" in done.output
    assert [len(facts(page)["models"]) for page in (site / "models").iterdir()] == [1, 1]
    assert len({link.partition("#")[0] for link in facts(site / "index.html")["models"].values()}) == 2


def test_entries_without_a_model_are_named(root: Path, tmp_path: Path) -> None:
    shutil.copytree(root / "runs" / "porch", tmp_path / "some")
    done = aw("publish", "--board", root / "board", "-o", tmp_path / "site", "--models", tmp_path / "some")
    assert done.exit_code == 0 and "no model of 3dgs" in done.output and "on yard" in done.output
    assert [p.name for p in (tmp_path / "site" / "models").iterdir()] == ["tiny-porch.html"]
    with pytest.raises(AwError):
        aw("publish", "--board", root / "board", "-o", tmp_path / "other", "--models", tmp_path / "none")
    assert not (tmp_path / "other").exists()


@needs_chromium
def test_the_link_opens_the_model(root: Path, tmp_path: Path) -> None:
    site = tmp_path / "site"
    aw("publish", "--board", root / "board", "-o", site, "--models", root / "runs")
    with Browser(tmp_path / "profile", webgl=True) as page:
        page.open((site / "index.html").as_uri())
        page.click("button.open")
        href = page.run("document.querySelector('.run a').href")
        page.open(href)
        page.until("document.getElementById('busy').textContent === '' && Boolean(over.mesh)")
        wanted = parse_qs(urlsplit(href).fragment)["left"][0]
        assert page.run("DATA.models[state.left].label") == wanted
        assert page.run("state.left !== state.right")
        assert page.errors == []
