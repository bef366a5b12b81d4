"""The page in a browser: method by scene, drill-down, comparison of images, masks, CSV, audit marks."""

from __future__ import annotations

import csv
import json
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest

from ambiguous_wild.core import AwError
from ambiguous_wild.datasets.suites import get_suite
from ambiguous_wild.report.board import read_board
from ambiguous_wild.report.board_edit import check, remove
from ambiguous_wild.report.board_publish import publish, read_sources
from ambiguous_wild.simulate.presets import PRESETS
from tests.chromium import Browser, needs_chromium
from tests.report.board_page import choose, column, heads, names, said, type_in
from tests.report.board_runs import add, own_scene, write_run

GOOD = {"iou": 0.8, "precision": 0.9, "recall": 0.85, "images": 6}
NOTHING = {"iou": 0.0, "precision": 0.0, "recall": None, "images": 6}  # masked something, nothing was there
REPORTED = "table,method,setting,dataset,scene,metric,variant,value,mark,printed\n" + "".join(
    f"tab:{table},{method},,Tiny,{scene},psnr,unknown,{value},,{value}\n"
    for table, rows in (
        ("one", (("A", "porch", 20.0), ("A", "hall", 30.0), ("A", "mean", 26.0), ("B", "porch", 21.5))),
        ("two", (("A", "porch", 22.0),)),
    )
    for method, scene, value in rows
)


@pytest.fixture(scope="module")
def board(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two scenes with distractors, and one without; 3dgs has no masks."""
    root = tmp_path_factory.mktemp("views")
    for name in ("porch", "yard", "clean"):
        scene = own_scene(root / name, distractors=name != "clean")
        masks = NOTHING if name == "clean" else GOOD
        for seed in (0, 1):
            write_run(root / "runs", scene, "3dgs", seed, noise=20.0 if name == "yard" else 9.0)
            write_run(root / "runs", scene, "refinesplat", seed, noise=5.0, masks=masks)
    done = add(root / "board", root / "runs", "--images", 2, dataset="Tiny")
    assert done.exit_code == 0, done.output
    (root / "board" / "reported").mkdir()
    (root / "board" / "reported" / "paper.csv").write_text(REPORTED)
    return root / "board"


def test_masks_are_kept_beside_train_photos(board: Path) -> None:
    images = board / "measured" / "images"
    rows = list(csv.DictReader((images / "index.csv").open()))
    count = {k: sum(r["kind"] == k for r in rows) for k in ("test", "train", "exact")}
    # 3 scenes x 2 views: photo and two renders; photo and one mask; the exact mask.
    assert count == {"test": 18, "train": 12, "exact": 6}
    mask = next(r for r in rows if r["kind"] == "train" and r["method"] == "refinesplat")
    shown = cv2.imread(str(images / mask["file"]), cv2.IMREAD_UNCHANGED)[..., 3] > 0
    assert shown[:12].all() and not shown[12:].any()
    exact = next(r for r in rows if r["kind"] == "exact" and r["scene"] == "yard")
    shown = cv2.imread(str(images / exact["file"]), cv2.IMREAD_UNCHANGED)[..., 3] > 0
    assert np.count_nonzero(shown) == 144  # the square of the tiny scene
    assert check(board).problems == ()


def test_an_index_of_before_masks_is_still_read(board: Path, tmp_path: Path) -> None:
    rows = list(csv.DictReader((board / "measured" / "images" / "index.csv").open()))
    old = [{k: v for k, v in r.items() if k != "kind"} for r in rows if r["kind"] == "test"]
    there = tmp_path / "board" / "measured"
    (there / "images").mkdir(parents=True)
    for path in (board / "measured").glob("*.csv"):
        (there / path.name).write_bytes(path.read_bytes())
    for r in old:
        (there / "images" / r["file"]).parent.mkdir(parents=True, exist_ok=True)
        (there / "images" / r["file"]).write_bytes((board / "measured/images" / r["file"]).read_bytes())
    with (there / "images" / "index.csv").open("w", newline="") as f:
        writer = csv.DictWriter(f, list(old[0]), lineterminator="\n")
        writer.writeheader()
        writer.writerows(old)
    assert check(there.parent).problems == ()
    assert remove(there.parent, method="refinesplat") and check(there.parent).problems == ()
    left = list(csv.DictReader((there / "images" / "index.csv").open()))
    assert {r["method"] for r in left} == {"", "3dgs"} and {r["kind"] for r in left} == {"test"}


def test_removing_a_method_removes_its_masks(board: Path, tmp_path: Path) -> None:
    shutil.copytree(board, tmp_path / "board")
    remove(tmp_path / "board", method="refinesplat")
    assert not list((tmp_path / "board").rglob("*.png")) and check(tmp_path / "board").problems == ()


@needs_chromium
@pytest.mark.parametrize("scheme", ["light", "dark"])
@pytest.mark.parametrize("width", [1300, 800, 400])
def test_the_views_in_a_browser(board: Path, tmp_path: Path, width: int, scheme: str) -> None:
    publish(board, tmp_path / "site", reported=True)
    files = tmp_path / "files"
    with Browser(tmp_path / "profile", width=width, mobile=width == 400) as page:
        page.call("Browser.setDownloadBehavior", behavior="allow", downloadPath=str(files))
        page.prefer(scheme)
        page.open((tmp_path / "site" / "index.html").as_uri())
        fits_and_can_be_read(page, width, scheme)
        undefined_scenes_are_left_out(page)
        by_scene(page)
        drill_down(page)
        the_first_image_differs_most(page)
        comparison(page)
        masks(page)
        findings_stand_at_their_cells(page)
        downloads(page, files)
        assert page.errors == []


@needs_chromium
def test_means_by_what_is_known_of_the_scenes_of_a_suite(tmp_path: Path) -> None:
    """Of aw-sim alone. Oracle: means of the board's rows, by the table of the suite and by the presets."""
    scenes = [*get_suite("aw-sim").tables["colour"][2:5], "banners", "marble", "still"]
    for number, name in enumerate(scenes):
        scene = own_scene(tmp_path / name)
        for method, noise in (("3dgs", 20.0), ("refinesplat", 9.0)):
            write_run(tmp_path / "runs", scene, method, noise=noise - number)
    assert add(tmp_path / "board", tmp_path / "runs", dataset="aw-sim").exit_code == 0
    write_run(tmp_path / "more", own_scene(tmp_path / "porch"))
    write_run(tmp_path / "more", own_scene(tmp_path / "hall"))
    assert add(tmp_path / "board", tmp_path / "more", dataset="Tiny").exit_code == 0
    publish(tmp_path / "board", tmp_path / "site")
    entries = read_board(tmp_path / "board")
    kinds = {s: kind for kind, of in get_suite("aw-sim").tables.items() for s in of}
    places = {s: PRESETS[s].world.place for s in scenes}

    def means(page: Browser, groups: dict[str, str]) -> None:
        titles = [head.split()[0] for head in heads(page, "matrix")]
        several = [g for g in dict.fromkeys(groups.values()) if list(groups.values()).count(g) > 1]
        assert sorted(titles) == sorted(["Method", "mean", *several, *scenes])
        for group in several:
            shown = dict(zip(names(page, "matrix"), column(page, titles.index(group), "matrix")))
            for method, text in shown.items():
                own = [e for e in entries if (e.dataset, e.method) == ("aw-sim", method)]
                psnr = [e.quality["psnr"] for e in own if groups[e.scene] == group]
                assert len(psnr) > 1 and text.startswith(f"{np.mean(psnr):.2f}")  # its rank follows

    with Browser(tmp_path / "profile") as page:
        page.open((tmp_path / "site" / "index.html").as_uri())
        choose(page, "dataset", "aw-sim")
        assert page.run("Object.keys(DATA.scenes)") == ["aw-sim"]
        assert not page.run("document.getElementById('group-by-choice').hidden")
        means(page, {s: kinds[s] for s in scenes})
        choose(page, "group-by", "place")
        means(page, places)
        choose(page, "group-by", "occlusion")
        choose(page, "dataset", "Tiny")
        assert page.run("document.getElementById('group-by-choice').hidden")
        assert [head.split()[0] for head in heads(page, "matrix")] == ["Method", "mean", "hall", "porch"]
        assert page.errors == []


def fits_and_can_be_read(page: Browser, width: int, scheme: str) -> None:
    assert page.run("document.documentElement.scrollWidth") <= width  # tables scroll in their own boxes
    light = (
        "(c) => { const [r, g, b] = c.match(/[\\d.]+/g).map((v) => v / 255)"
        ".map((v) => v <= 0.04045 ? v / 12.92 : ((v + 0.055) / 1.055) ** 2.4);"
        "return 0.2126 * r + 0.7152 * g + 0.0722 * b; }"
    )
    of = "getComputedStyle(document.body)"
    ground, text = (page.run(f"({light})({of}.{what})") for what in ("backgroundColor", "color"))
    assert (ground > text) == (scheme == "light")
    assert (max(ground, text) + 0.05) / (min(ground, text) + 0.05) > 7.0  # WCAG AAA


def undefined_scenes_are_left_out(page: Browser) -> None:
    at = next(i for i, h in enumerate(heads(page)) if h.startswith("mask IoU"))
    assert "2 of 3 scenes" in heads(page)[at]
    row = names(page).index("refinesplat")
    assert column(page, at)[row] == "0.800"  # not 0.533, which counts the clean scene as 0
    assert "Undefined for clean and left out of the mean" in said(page, "notes")


def by_scene(page: Browser) -> None:
    assert [h.split()[0] for h in heads(page, "matrix")] == ["Method", "mean", "clean", "porch", "yard"]
    assert page.run("document.querySelectorAll('#matrix thead img').length") == 3
    values = [float(column(page, k, "matrix")[0].rstrip("123")) for k in range(1, 5)]
    assert values[0] == pytest.approx(sum(values[1:]) / 3, abs=0.011)
    choose(page, "metric", "mask IoU")
    assert column(page, 2, "matrix") == ["–", "–"] and said(page, "matrix-title") == "mask IoU by scene"
    choose(page, "metric", "all metrics")
    type_in(page, "refine")
    assert names(page, "matrix") == ["refinesplat"]
    type_in(page, "")


def drill_down(page: Browser) -> None:
    page.click("#matrix tbody tr:first-child [data-cell=yard]")
    assert said(page, "drill").startswith("refinesplat on yard")
    assert page.run("document.querySelectorAll('#drill .run').length") == 2
    assert page.run("document.querySelectorAll('#drill .thumbs img').length") == 2
    assert page.run("document.activeElement.dataset.cell") == "yard"
    page.click("#drill .thumbs button:nth-child(2)")
    assert page.run("JSON.parse(view)[0]") == "yard"
    assert page.run("$('left').selectedOptions[0].textContent").startswith("refinesplat")
    page.click("#drill-close")
    assert page.run("$('drill').hidden && document.activeElement.dataset.cell === 'yard'")


def the_first_image_differs_most(page: Browser) -> None:
    page.run("view = ''; $('left').value = ''; $('right').value = ''; fillPair()")
    assert page.run("JSON.parse(view)[0]") == "yard"  # 20 against 5; elsewhere 9 against 5
    assert "refinesplat" in said(page, "left-said") and "3dgs" in said(page, "right-said")
    assert page.run("document.querySelectorAll('#views button').length") == 6
    page.click("#views button:nth-child(1)")
    assert page.run("JSON.parse(view)[0]") == "clean"
    assert page.run("document.activeElement.getAttribute('aria-pressed')") == "true"


def comparison(page: Browser) -> None:
    wide = "Number(getComputedStyle($('over')).clipPath.match(/([\\d.]+)%/)?.[1])"
    at = "$('stage').style.getPropertyValue('--at')"
    x, y, w = page.run(
        "(() => { const e = $('stage'); e.scrollIntoView({block: 'center'});"
        "const b = e.getBoundingClientRect(); return [b.x, b.y + b.height / 2, b.width]; })()"
    )
    for kind, part in (("mousePressed", 0.5), ("mouseMoved", 0.25), ("mouseReleased", 0.25)):
        page.call("Input.dispatchMouseEvent", type=kind, x=x + part * w, y=y, button="left", buttons=1,
                  clickCount=1)  # fmt: skip
    assert float(page.run(at).rstrip("%")) == pytest.approx(25, abs=1)
    assert page.run(wide) == pytest.approx(75, abs=1)  # cut from the right
    page.run("$('slider').focus()")
    page.call("Input.dispatchKeyEvent", type="keyDown", key="End", code="End", windowsVirtualKeyCode=35)
    assert page.run(at) == "100%"
    choose(page, "layout", "side by side")
    boxes = page.run("['over', 'under'].map((i) => { const b = $(i).getBoundingClientRect();"
                     "return [b.left, b.right, b.top, b.bottom]; })")  # fmt: skip
    beside, below = boxes[0][1] <= boxes[1][0], boxes[0][3] <= boxes[1][2]
    assert beside if page.run("innerWidth") > 640 else below  # a narrow page has one above the other
    page.click("#zoom-in")
    page.click("#zoom-in")
    same = "[...document.querySelectorAll('#stage .layers')].map((l) => l.style.transform)"
    first, second = page.run(same)
    assert first == second and "scale(2.25)" in first
    page.run("$('stage').focus()")
    page.key("ArrowRight")
    assert page.run("zoom.x") > 0.27 and len(set(page.run(same))) == 1
    page.click("#zoom-fit")
    assert page.run("zoom.scale === 1 && zoom.x === 0")
    choose(page, "show", "error map")
    assert page.run("document.querySelectorAll('#stage .difference').length") == 2
    assert "4 times as bright" in said(page, "show-said")
    page.until("[...document.querySelectorAll('#stage img')].every((i) => i.naturalWidth > 0)")


def masks(page: Browser) -> None:
    choose(page, "show", "masks")
    page.click("#views button:nth-child(3)")
    assert page.run("JSON.parse(view)[0]") == "porch"
    choose(page, "left", "refinesplat")
    choose(page, "right", "the photo")
    count = "[...document.querySelectorAll('#stage .pane')].map((p) => p.querySelectorAll('.mask').length)"
    assert sorted(page.run(count)) == [1, 2]  # predicted and exact; exact alone
    page.until("[...document.querySelectorAll('#stage img')].every((i) => i.naturalWidth > 0)")
    page.click("#exact")
    assert sorted(page.run(count)) == [0, 1]
    choose(page, "show", "renders")


def findings_stand_at_their_cells(page: Browser) -> None:
    assert page.run("$('source').options.length") == 2
    assert names(page, "others-table") == ["A", "B"]
    marked = page.run("[...document.querySelectorAll('#others-table .asked')].map((c) => c.title)")
    assert any("but the parts give" in t for t in marked) and any("22.0" in t for t in marked)
    assert "but the parts give" in said(page, "findings")
    assert page.run("document.querySelectorAll('#others-table .flag').length") == len(marked) >= 3
    choose(page, "source", "tab:two")
    assert column(page, 1, "others-table")[0].startswith("22.0")


def downloads(page: Browser, files: Path) -> None:
    for button in ("table-csv", "matrix-csv", "others-csv"):
        page.click(f"#{button}")
    wanted = {"tiny-overview.csv", "tiny-psnr-by-scene.csv", "tiny-reported-psnr.csv"}
    while not wanted <= {p.name for p in files.glob("*.csv")}:
        page.run("new Promise((done) => setTimeout(done, 50))")
    rows = {r["method"]: r for r in csv.DictReader((files / "tiny-overview.csv").open())}
    assert float(rows["refinesplat"]["mask_iou"]) == pytest.approx(0.8) and rows["3dgs"]["mask_iou"] == ""
    assert rows["refinesplat"]["psnr_rank"] == "1" and rows["3dgs"]["train_s_comparable"] == "no"
    cells = list(csv.DictReader((files / "tiny-psnr-by-scene.csv").open()))
    assert [c["method"] for c in cells] == ["refinesplat", "3dgs"] and float(cells[0]["yard"]) > 30


def test_sources_that_are_no_such_file_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "sources.json"
    assert read_sources(path) == {}
    path.write_text(json.dumps({"papers": {}, "tables": {"t": {"paper": "gone"}}}))
    with pytest.raises(AwError, match="malformed"):
        read_sources(path)
    papers = {"p": {"title": "T", "url": "javascript:alert(1)"}}
    path.write_text(json.dumps({"papers": papers, "tables": {"t": {"paper": "p"}}}))
    assert read_sources(path)["t"]["url"] == ""
