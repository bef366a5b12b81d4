"""The published page: its files; in a browser sorting, ranks, filters, plot, reported numbers, phone."""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from ambiguous_wild.core import AwError
from ambiguous_wild.report import board_publish as publishing
from ambiguous_wild.report.board import read_board
from ambiguous_wild.report.board_publish import Reported, facts
from tests.chromium import Browser, needs_chromium
from tests.report.board_page import choose, column, heads, names, ranks, said, tick, type_in
from tests.report.board_runs import aw, content, own_scene, write_run

HOSTILE = '=1+1</script><img src=x onerror="alert(1)">/../../etc'
REPORTED = (
    "table,method,setting,dataset,scene,metric,variant,value,mark,printed\n"
    f'tab:one,"{HOSTILE.replace(chr(34), chr(34) * 2)}",,Tiny,porch,psnr,unknown,99.90,1,99.90\n'
    "tab:one,3DGS,,Tiny,porch,psnr,unknown,11.10,,11.10\n"
    "tab:one,3DGS,,Elsewhere,hall,psnr,unknown,12.00,,12.00\n"
)


@pytest.fixture(scope="module")
def board(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two scenes; refinesplat is best and slowest, robustsplat lacks a scene, the last has a hostile name."""
    root = tmp_path_factory.mktemp("published")
    for name in ("porch", "yard"):
        scene = own_scene(root / name)
        for seed in (0, 1):
            write_run(root / "runs", scene, "3dgs", seed, noise=20.0, train_s=60.0, alone=True)
            write_run(root / "runs", scene, "refinesplat", seed, noise=5.0, train_s=600.0, alone=True)
        write_run(root / "runs", scene, HOSTILE, noise=10.0, train_s=300.0, size_b=300_000, alone=True)
        if name == "porch":
            write_run(
                root / "runs", scene, "robustsplat", noise=7.0, train_s=200.0, alone=True, cpu="Another"
            )
    done = aw("add", root / "runs", "--board", root / "board", "--dataset", "Tiny", "--images", 1)
    assert done.exit_code == 0, done.output
    (root / "board" / "reported").mkdir()
    (root / "board" / "reported" / "paper.csv").write_text(REPORTED)
    papers = '{"p": {"title": "<b>A paper</b>", "venue": "Venue 2026", "url": "https://example.org/p"}}'
    tables = '{"tab:one": {"paper": "p", "caption": "Main"}}'
    (root / "board" / "reported" / "sources.json").write_text(f'{{"papers": {papers}, "tables": {tables}}}')
    return root / "board"


def test_the_same_board_gives_the_same_bytes_and_copies_of_its_csvs(board: Path, tmp_path: Path) -> None:
    for name in ("a", "b"):
        aw("publish", "--board", board, "-o", tmp_path / name, "--reported")
    files = content(tmp_path / "a")
    assert files == content(tmp_path / "b")
    assert files["data/tiny.csv"] == (board / "measured" / "tiny.csv").read_bytes()
    assert b"\nreported," in files["data/reported.csv"] and b",\"'=1+1<" in files["data/reported.csv"]
    assert b"reported" not in files["data/all.csv"]
    # Two scenes with photo and renders; no name of a file leads anywhere.
    assert sum(name.endswith(".jpg") for name in files) == 2 + 4 + 3
    aw("publish", "--board", board, "-o", tmp_path / "a")
    assert "data/reported.csv" not in content(tmp_path / "a")


def test_halves_of_photos_where_the_scene_asks_for_them_are_no_setting_of_their_own(board: Path) -> None:
    entry = replace(read_board(board)[0], setting="9 iterations, half images, at most 5 Gaussians")
    shown = {}
    for dataset, scene in (("aw-sim", "coats"), ("aw-sim", "banners"), ("Tiny", "coats")):
        data = facts([replace(entry, dataset=dataset, scene=scene)], [], Reported(), [])
        shown[dataset, scene] = data["runs"][0]["setting"]
    assert shown.pop(("aw-sim", "coats")) == "9 iterations, at most 5 Gaussians"
    assert {*shown.values()} == {entry.setting}


def test_the_page_shows_methods_under_their_labels(board: Path, tmp_path: Path) -> None:
    done = aw("publish", "--board", board, "-o", tmp_path / "a", "--label", "refinesplat=Ours & co")
    assert done.exit_code == 0, done.output
    page = (tmp_path / "a" / "index.html").read_text(encoding="utf-8")
    (text,) = re.findall(r'<script id="data" type="application/json">(.*?)</script>', page, re.S)
    data = json.loads(text)
    assert {run["method"] for run in data["runs"]} == {"3dgs", "robustsplat", "Ours & co", HOSTILE}
    assert {row["method"] for row in data["images"]} >= {"Ours & co", ""} and "Ours & co" in data["methods"]
    assert all("Ours" not in run["reproduce"] for run in data["runs"])
    assert b"Ours" not in content(tmp_path / "a")["data/tiny.csv"]


def test_an_interrupted_publish_leaves_the_old_page(
    board: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    out = tmp_path / "site"
    aw("publish", "--board", board, "-o", out, "--title", "old")
    before = content(out)

    def broken(*_: object) -> str:
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(publishing, "page", broken)
        aw("publish", "--board", board, "-o", out, "--title", "new")
    assert content(out) == before and [p.name for p in tmp_path.iterdir()] == ["site"]
    # Killed between its two renames: the next call puts the old page back before anything else.
    (tmp_path / ".site.old-k3x_9abc").mkdir()
    os.replace(out, tmp_path / ".site.old-k3x_9abc" / "site")
    with monkeypatch.context() as patch:
        patch.setattr(publishing, "page", broken)
        aw("publish", "--board", board, "-o", out)
    assert content(out) == before


def test_what_is_not_a_page_of_ours_is_not_replaced(board: Path, tmp_path: Path) -> None:
    (tmp_path / "thesis.txt").write_text("mine")
    with pytest.raises(AwError, match=r"thesis\.txt.*choose another -o"):
        publishing.publish(board, tmp_path)
    assert content(tmp_path) == {"thesis.txt": b"mine"}


def test_files_that_no_publish_wrote_are_not_removed(board: Path, tmp_path: Path) -> None:
    publishing.publish(board, tmp_path / "site")
    (tmp_path / "site/data/mine.csv").write_text("mine")
    with pytest.raises(AwError, match=r"also holds data/mine\.csv"):
        publishing.publish(board, tmp_path / "site")
    (tmp_path / "site/data/mine.csv").unlink()
    (tmp_path / "link").symlink_to(tmp_path / "site")
    publishing.publish(board, tmp_path / "link", title="by a link")
    assert (tmp_path / "link").is_symlink() and b"by a link" in content(tmp_path / "site")["index.html"]
    (tmp_path / "nowhere").symlink_to(tmp_path / "gone")
    with pytest.raises(AwError, match="link to nowhere"):
        publishing.publish(board, tmp_path / "nowhere")


def test_a_changed_picture_is_not_published(board: Path, tmp_path: Path) -> None:
    shutil.copytree(board, tmp_path / "board")
    next((tmp_path / "board").rglob("*.jpg")).write_bytes(b"x")
    with pytest.raises(AwError, match="missing or changed"):
        publishing.publish(tmp_path / "board", tmp_path / "site")
    assert not (tmp_path / "site").exists()


def sort_order(page: Browser) -> list[tuple[str, str]]:
    return page.run(
        "[...document.querySelectorAll('#table thead th')].filter((t) => t.ariaSort !== 'none')"
        ".map((t) => [t.querySelector('.way').textContent, t.ariaSort])"
    )


@needs_chromium
def test_the_page_in_a_browser(board: Path, tmp_path: Path) -> None:
    # One start of the browser for everything: starting is what costs.
    aw("publish", "--board", board, "-o", tmp_path / "site", "--reported", "--title", "<b>T & T</b>")
    (tmp_path / "none" / "measured").mkdir(parents=True)
    aw("publish", "--board", tmp_path / "none", "-o", tmp_path / "empty")
    site = (tmp_path / "site" / "index.html").as_uri()
    with Browser(tmp_path / "profile") as page:
        page.open(site)
        assert page.run("document.querySelector('h1').textContent") == "<b>T & T</b>"
        assert "distractors" in said(page, "about") and "Kerbl" in said(page, "methods")
        assert page.run("document.querySelector('#table [data-key=train_s]')") is None  # main metrics fit
        page.run("state.metric = ALL; draw()")
        sorts(page)
        references_are_not_ranked(page)
        the_search_changes_no_rank(page)
        scenes_are_ticked(page)
        rows_open_and_stay_open(page)
        focus_is_never_covered(page)
        reported_stay_apart(page)
        plot(page)
        times_of_a_shared_machine_are_ranges(page)
        page.until("[...document.images].every((i) => i.loading === 'lazy' || i.naturalWidth > 0)")
        assert page.errors == [] and all(
            url.startswith(site.removesuffix("index.html")) for url in page.requests
        )
        the_choice_is_in_the_address(page, site)
        what_has_no_mean_is_a_note(page)
        on_a_phone(page, site)
        page.open((tmp_path / "empty" / "index.html").as_uri())
        assert page.run(
            "!document.getElementById('empty').hidden && document.getElementById('compare').hidden"
        )
        assert page.run("document.getElementById('measured').hidden") and page.errors == []


def of_page(board: dict, dataset: str, script: str) -> Any:
    """What the board page's code prints for a board, as JSON."""
    code = (
        f"const document = {{ getElementById: () => ({{ textContent: {json.dumps(json.dumps(board))} }}) }};"
        + (Path(publishing.__file__).parent / "page" / "page_data.js").read_text(encoding="utf-8")
        + f"state.dataset = '{dataset}'; {script}"
    )
    return json.loads(
        subprocess.run(["node", "-"], input=code, capture_output=True, text=True, check=True).stdout
    )


@pytest.mark.skipif(shutil.which("node") is None, reason="needs node")
def test_entries_that_differ_in_options_alone_are_told_apart_by_them() -> None:
    board = facts(read_board(Path(__file__).parents[2] / "leaderboard"), [], Reported(), [])
    script = "console.log(JSON.stringify(groups('aw-sim').map((g) => [g.method, g.about])))"
    entries = of_page(board, "aw-sim", script)
    length = "1000 iterations, effects auto"
    assert ["refinesplat-paper", f"{length}, features=labhog, instances=graph"] in entries
    assert ["robustsplat", f"{length}, features=efficientnet-lite0"] in entries
    assert ["3dgs", length] in entries
    for run in board["runs"]:
        run["reproduce"] = ""
    entries = of_page(board, "aw-sim", script)
    several = [about for method, about in entries if method == "robustsplat" and about.startswith(length)]
    assert len(several) > 1 and all("default options (" in about for about in several)
    assert len({tuple(entry) for entry in entries}) == len(entries)


@pytest.mark.skipif(shutil.which("node") is None, reason="needs node")
def test_an_infinite_value_of_the_shipped_board_enters_no_mean_and_no_rank() -> None:
    board = facts(read_board(Path(__file__).parents[2] / "leaderboard"), [], Reported(), [])
    measured = [
        run
        for run in board["runs"]
        if (run["dataset"], run["method"]) == ("aw-sim", "dronesplat") and "psnr_supported" in run["quality"]
    ]
    measured = [run for run in measured if run["setting"] == measured[0]["setting"]]
    lost = [run for run in measured if run["scene"] == measured[0]["scene"]]
    for run in lost:
        run["quality"]["psnr_supported"] = "inf"
    script = (
        "const key = 'psnr_supported', found = groups('aw-sim');"
        "const all = found.map((g) => summary(g, key, chosenScenes()));"
        "const placed = ranks(rankable(found, all, key), key);"
        "console.log(JSON.stringify(found.map((g, i) => [g.method, all[i].value, placed[i], all[i].cells])));"
    )
    groups = sorted(of_page(board, "aw-sim", script), key=lambda group: group[-1]["all"])  # of each setting
    rows = {method: (value, rank, cells) for method, value, rank, cells in groups}
    value, rank, cells = rows["dronesplat"]
    assert value is None and rank is None  # its scene has no other value
    assert cells["finite"] == cells["all"] - len(lost) == len(measured) - len(lost)
    assert rows["refinesplat"][1] == 1


def references_are_not_ranked(page: Browser) -> None:
    psnr = "document.querySelector('#table td:nth-child(2)[data-rank=\"1\"]')"
    first = f"{psnr}.parentElement.querySelector('button').textContent"
    assert page.run(first) == "refinesplat"
    assert page.run("document.querySelectorAll('#table .badge').length") == 0
    page.run("DATA.references.push('refinesplat'); drawMeasured()")
    assert page.run(first) == HOSTILE
    assert page.run("document.querySelector('#table .badge').closest('tr').textContent").startswith(
        "refinesplat"
    )
    page.run("DATA.references.pop(); drawMeasured()")


def sorts(page: Browser) -> None:
    # Best first to begin with; robustsplat lacks a scene, so it has no mean and stands last either way.
    assert names(page) == ["refinesplat", HOSTILE, "3dgs", "robustsplat"]
    assert sort_order(page) == [["PSNR", "descending"]] and column(page, 1)[-1] == "–"
    page.click("#table thead button[data-key=psnr]")
    assert names(page) == ["3dgs", HOSTILE, "refinesplat", "robustsplat"]
    assert sort_order(page) == [["PSNR", "ascending"]]
    page.click("#table thead button[data-key=train_s]")
    assert names(page) == ["3dgs", HOSTILE, "refinesplat", "robustsplat"]
    # By key: the header that was pressed keeps the focus.
    assert page.run("document.activeElement.dataset.key") == "train_s"
    page.call("Input.dispatchKeyEvent", type="keyDown", key="Enter", text="\r", code="Enter",
              windowsVirtualKeyCode=13)  # fmt: skip
    assert sort_order(page) == [["training s", "descending"]] and names(page)[0] == "refinesplat"
    page.click("#table thead button[data-key=method]")
    assert names(page) == [HOSTILE, "3dgs", "refinesplat", "robustsplat"]
    # Equal in print is equal in rank: two are of half a MB.
    at = heads(page).index("model MB")
    assert sorted(ranks(page, at).values()) == ["", "1", "2", "2"]


def the_search_changes_no_rank(page: Browser) -> None:
    before = ranks(page, 1)
    colour = "document.querySelector('#plot g').getAttribute('stroke')"
    first = page.run(
        "[...document.querySelectorAll('#plot g')].map((g) => "
        "[g.querySelector('title').textContent.split(' ')[0], g.getAttribute('stroke')])"
    )
    front = said(page, "plot-said")
    type_in(page, "3DGS")
    assert names(page) == ["3dgs"] and ranks(page, 1) == {"3dgs": before["3dgs"]} == {"3dgs": "3"}
    assert page.run(colour) == dict(first)["3dgs"] and said(page, "plot-said") == front
    type_in(page, "iterations")  # of the setting, not of a name
    assert names(page) == [] and "Nothing measured" in said(page, "said")
    type_in(page, "SPLAT")
    assert sorted(names(page)) == ["refinesplat", "robustsplat"]
    type_in(page, "")
    assert ranks(page, 1) == before


def scenes_are_ticked(page: Browser) -> None:
    tick(page, "yard")
    assert "–" not in column(page, 1) and "porch" in said(page, "said")
    assert "±" in page.run("document.querySelector('#table tbody').textContent")
    dots = "[...document.querySelectorAll('#table .dots')].map((d) => d.children.length)"
    assert 3 in page.run(dots)  # the line and two seeds
    tick(page, "porch")
    assert names(page) == [] and "No scene" in said(page, "said")
    page.click("#scenes-all")
    assert said(page, "scenes-said") == "Scenes: 2 of 2" and len(names(page)) == 4
    assert "Another" in said(page, "notes")


def what_has_no_mean_is_a_note(page: Browser) -> None:
    headed = "document.querySelector('#table thead button[data-key=ssim]') !== null"
    assert page.run(headed) and "No mean is shown" not in said(page, "notes")
    page.run("DATA.runs.filter((r) => r.scene === 'yard').forEach((r) => { delete r.quality.ssim; }); draw()")
    assert not page.run(headed)
    assert "No mean is shown where a value is missing: SSIM." in said(page, "notes")
    tick(page, "yard")
    assert page.run(headed)
    page.click("#scenes-all")


def rows_open_and_stay_open(page: Browser) -> None:
    page.run(
        "(() => { window.asked = ''; Object.defineProperty(navigator, 'clipboard',"
        "{value: {writeText: async (t) => { window.copied = t; }}}); })()"
    )
    page.run("[...document.querySelectorAll('.open')].find((b) => b.textContent === '3dgs').click()")
    assert page.run("document.querySelectorAll('#table .run').length") == 4
    page.click("#table .run .copy")
    page.until("document.querySelector('#table .run .copy').textContent === 'Copied'")
    lines = page.run("window.copied").split("\n")
    assert lines[0].startswith("aw bench --method 3dgs --scene porch --seed 0")
    assert lines[1].startswith("# ") and "PSNR" in lines[1]
    assert "Before the command: the scene with hash" in page.run(
        "document.querySelector('#table .run').textContent"
    )
    page.click("#table thead button[data-key=ssim]")
    type_in(page, "3d")
    tick(page, "yard")
    assert page.run("document.querySelectorAll('#table .run').length") == 2
    assert page.run("document.querySelector('#table .open').ariaExpanded") == "true"
    page.click("#scenes-all")
    type_in(page, "")
    page.click("#table .open[aria-expanded=true]")
    assert page.run("document.querySelectorAll('#table .run').length") == 0
    # The button that was pressed is drawn again, and has the focus.
    assert page.run("document.activeElement.textContent") == "3dgs"


def focus_is_never_covered(page: Browser) -> None:
    covered = (
        "(() => { const e = document.activeElement, b = e.getBoundingClientRect();"
        "if (e === document.body || e.id === 'stage') return '';"
        "const x = b.x + b.width / 2, y = b.y + b.height / 2, top = document.elementFromPoint(x, y);"
        "const label = e.closest('label');"
        "return top && (e.contains(top) || label?.contains(top)) ? '' : e.outerHTML.slice(0, 90); })()"
    )
    page.run("scrollTo(0, 0); document.getElementById('dataset').focus()")
    seen = set()
    for _ in range(120):
        page.call("Input.dispatchKeyEvent", type="keyDown", key="Tab", code="Tab", windowsVirtualKeyCode=9)
        page.call("Input.dispatchKeyEvent", type="keyUp", key="Tab", code="Tab", windowsVirtualKeyCode=9)
        if page.run("document.activeElement === document.body"):
            break
        assert page.run(covered) == ""
        seen.add(page.run("document.activeElement.tagName"))
        assert page.run("getComputedStyle(document.activeElement).outlineStyle") != "none"
    assert {"BUTTON", "SELECT", "INPUT"} <= seen


def reported_stay_apart(page: Browser) -> None:
    assert sorted(names(page, "others-table")) == ["3DGS", HOSTILE]
    assert "porch" in heads(page, "others-table")[1]
    assert "<b>A paper</b>, Venue 2026" in said(page, "source-said") and "dB" in said(page, "source-said")
    assert page.run("document.querySelector('#source-said a').href") == "https://example.org/p"
    text = said(page, "table") + said(page, "plot")
    assert "99.9" not in text and "3DGS" not in text
    choose(page, "dataset", "Elsewhere")
    assert names(page, "others-table") == ["3DGS"] and page.run("document.getElementById('measured').hidden")
    page.click("#reported")
    assert page.run("document.getElementById('others').hidden && !document.getElementById('measured').hidden")
    page.click("#reported")


def plot(page: Browser) -> None:
    choose(page, "plot-x", "training s")
    assert page.run("document.querySelectorAll('#plot .point').length") == 3  # robustsplat has no mean
    assert (
        page.run("document.querySelectorAll('#plot .bar').length") == 4
    )  # two seeds: two methods, both ways
    assert f"Pareto-optimal: 3dgs, {HOSTILE}, refinesplat" in said(page, "plot-said")
    assert "logarithmic" in said(page, "plot")
    choose(page, "plot-x", "model MB")
    assert f"Pareto-optimal: {HOSTILE}, refinesplat" in said(page, "plot-said")


def times_of_a_shared_machine_are_ranges(page: Browser) -> None:
    at = heads(page).index("training s")
    assert ranks(page, at)["3dgs"] == "1" and "–" not in column(page, at)[0]
    page.run("DATA.runs.filter((r) => r.method === '3dgs').forEach((r) => { r.alone = false; }); draw()")
    row = names(page).index("3dgs")
    low, high = (float(v) for v in column(page, at)[row].split("–"))
    assert 50 < low < high < 70 and ranks(page, at)["3dgs"] == "" and ranks(page, 1)["3dgs"] == "3"
    assert ranks(page, at)[HOSTILE] == "1" and "shared the machine" in said(page, "notes")
    choose(page, "plot-x", "training s")
    assert f"Pareto-optimal: {HOSTILE}, refinesplat" in said(page, "plot-said")
    assert "ranges over runs" in said(page, "plot-said")
    page.run("DATA.runs.forEach((r) => { r.alone = null; }); draw()")
    assert "not recorded" in said(page, "notes") and "No Pareto front" in said(page, "plot-said")
    page.run("DATA.runs.forEach((r) => { r.alone = true; }); draw()")


def the_choice_is_in_the_address(page: Browser, site: str) -> None:
    tick(page, "porch")
    address = page.run("location.href")
    assert "without=porch" in address
    page.open("about:blank#")
    page.open(address)
    assert said(page, "scenes-said") == "Scenes: 1 of 2"
    page.open("about:blank#")
    page.open(site + "#without=%3Cb%3E&dataset=__proto__&metric=constructor&sort=-nothing")
    assert said(page, "scenes-said") == "Scenes: 2 of 2" and len(names(page)) == 4
    assert page.errors == []


def on_a_phone(page: Browser, site: str) -> None:
    page.call("Emulation.setDeviceMetricsOverride", width=390, height=844, mobile=True, deviceScaleFactor=2)
    page.open(site.replace("index.html", "index.html?phone"))
    assert page.run("document.documentElement.scrollWidth") == 390
    page.click("#table tbody tr:first-child .open")
    page.click("#matrix [data-cell]")
    page.run("document.getElementById('scenes').open = true")
    assert page.run("document.documentElement.scrollWidth") == 390
    small = page.run(
        "[...document.querySelectorAll('select, input[type=search], thead button')]"
        ".filter((e) => e.offsetHeight && e.offsetHeight < 36).length"
    )
    assert small == 0 and page.errors == []
