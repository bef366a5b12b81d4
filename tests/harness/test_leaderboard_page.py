"""The published page: its files, and in a real browser sort, filter, slider, hostile names, phone width."""

from __future__ import annotations

import json
import os
import shutil
from pathlib import Path

import pytest
from click.testing import CliRunner, Result

from ambiguous_wild.cli.leaderboard import command
from ambiguous_wild.harness.leaderboard import publish as publishing
from tests.chromium import Browser, needs_chromium
from tests.harness.board_runs import write_run, write_scene

HOSTILE = '=1+1</script><img src=x onerror="alert(1)">/../../etc'
REPORTED = (
    "table,method,setting,dataset,scene,metric,variant,value,mark,printed\n"
    f'tab:one,"{HOSTILE.replace(chr(34), chr(34) * 2)}",,Tiny,porch,psnr,unknown,99.90,1,99.90\n'
    "tab:one,3DGS,,Tiny,porch,psnr,unknown,11.10,,11.10\n"
    "tab:one,3DGS,,Elsewhere,hall,psnr,unknown,12.00,,12.00\n"
)


def aw(*words: object) -> Result:
    return CliRunner().invoke(command, [str(w) for w in words], catch_exceptions=False)


@pytest.fixture(scope="module")
def board(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two scenes; refinesplat is best and slowest, robustsplat lacks a scene, the last has a hostile name."""
    root = tmp_path_factory.mktemp("published")
    for name in ("porch", "yard"):
        scene = write_scene(root / name)
        for seed in (0, 1):
            write_run(root / "runs", scene, "3dgs", seed, noise=20.0, train_s=60.0)
            write_run(root / "runs", scene, "refinesplat", seed, noise=5.0, train_s=600.0)
        write_run(root / "runs", scene, HOSTILE, noise=10.0, train_s=300.0, size_b=300_000)
        if name == "porch":
            write_run(root / "runs", scene, "robustsplat", noise=7.0, train_s=200.0, cpu="Another CPU")
    done = aw("add", root / "runs", "--board", root / "board", "--dataset", "Tiny", "--images", 1)
    assert done.exit_code == 0, done.output
    (root / "board" / "reported").mkdir()
    (root / "board" / "reported" / "paper.csv").write_text(REPORTED)
    return root / "board"


def content(folder: Path) -> dict[str, bytes]:
    return {str(p.relative_to(folder)): p.read_bytes() for p in sorted(folder.rglob("*")) if p.is_file()}


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
    (tmp_path / ".site.old-1").mkdir()
    os.replace(out, tmp_path / ".site.old-1" / "site")
    with monkeypatch.context() as patch:
        patch.setattr(publishing, "page", broken)
        aw("publish", "--board", board, "-o", out)
    assert content(out) == before


def test_what_is_not_a_page_of_ours_is_not_replaced(board: Path, tmp_path: Path) -> None:
    (tmp_path / "thesis.txt").write_text("mine")
    with pytest.raises(publishing.AwError, match=r"thesis\.txt.*choose another -o"):
        publishing.publish(board, tmp_path)
    assert content(tmp_path) == {"thesis.txt": b"mine"}


def test_files_that_no_publish_wrote_are_not_removed(board: Path, tmp_path: Path) -> None:
    publishing.publish(board, tmp_path / "site")
    (tmp_path / "site/data/mine.csv").write_text("mine")
    with pytest.raises(publishing.AwError, match=r"also holds data/mine\.csv"):
        publishing.publish(board, tmp_path / "site")
    (tmp_path / "site/data/mine.csv").unlink()
    (tmp_path / "link").symlink_to(tmp_path / "site")
    publishing.publish(board, tmp_path / "link", title="by a link")
    assert (tmp_path / "link").is_symlink() and b"by a link" in content(tmp_path / "site")["index.html"]
    (tmp_path / "nowhere").symlink_to(tmp_path / "gone")
    with pytest.raises(publishing.AwError, match="link to nowhere"):
        publishing.publish(board, tmp_path / "nowhere")


def test_a_changed_picture_is_not_published(board: Path, tmp_path: Path) -> None:
    shutil.copytree(board, tmp_path / "board")
    next((tmp_path / "board").rglob("*.jpg")).write_bytes(b"x")
    with pytest.raises(publishing.AwError, match="missing or changed"):
        publishing.publish(tmp_path / "board", tmp_path / "site")
    assert not (tmp_path / "site").exists()


def names(page: Browser, table: str = "table") -> list[str]:
    return page.run(
        f"[...document.querySelectorAll('#{table} tbody th')].map((t) => t.firstChild.textContent)"
    )


def column(page: Browser, at: int) -> list[str]:
    return page.run(
        "[...document.querySelectorAll('#table tbody tr')]"
        f".map((r) => r.children[{at}].firstChild.textContent)"
    )


def choose(page: Browser, select: str, text: str) -> None:
    page.run(
        f"(() => {{ const s = document.getElementById({json.dumps(select)});"
        f"const o = [...s.options].find((o) => o.textContent.startsWith({json.dumps(text)}));"
        "if (!o) throw new Error('no such choice'); s.value = o.value;"
        "s.dispatchEvent(new Event('change', {bubbles: true})); })()"
    )


def type_in(page: Browser, text: str) -> None:
    page.run(
        f"(() => {{ const m = document.getElementById('method'); m.value = {json.dumps(text)};"
        "m.dispatchEvent(new Event('input', {bubbles: true})); })()"
    )


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
        sorts(page)
        who_knows_the_truth_is_not_ranked(page)
        filters(page)
        rows_open(page)
        reported_stay_apart(page)
        plot(page)
        slider(page)
        page.until("[...document.images].every((i) => i.complete && i.naturalWidth > 0)")
        assert page.run("document.querySelectorAll('img').length") == 2  # none from a name
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


def who_knows_the_truth_is_not_ranked(page: Browser) -> None:
    psnr = "document.querySelector('#table td:nth-child(2)[data-rank=\"1\"]')"
    first = f"{psnr}.parentElement.querySelector('button').textContent"
    assert page.run(first) == "refinesplat"
    assert page.run("document.querySelectorAll('#table .badge').length") == 0
    page.run("DATA.oracles.push('refinesplat'); drawMeasured()")
    assert page.run(first) == HOSTILE
    assert page.run("document.querySelector('#table .badge').closest('tr').textContent").startswith(
        "refinesplat"
    )
    page.run("DATA.oracles.pop(); drawMeasured()")


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
    ranks = "[...document.querySelectorAll('#table tbody tr')].map((r) => r.children[5].dataset.rank ?? '')"
    assert sorted(page.run(ranks)) == ["", "1", "2", "2"]


def filters(page: Browser) -> None:
    type_in(page, "SPLAT")
    assert names(page) == ["refinesplat", "robustsplat"]
    choose(page, "scene", "porch")
    assert "–" not in column(page, 1)
    assert "±" in page.run("document.querySelector('#table tbody td').textContent")
    assert page.run("document.querySelectorAll('#table tbody tr:first-child .dots')[0].children.length") == 3
    choose(page, "scene", "all scenes")
    type_in(page, "")
    choose(page, "metric", "SSIM")
    heads = page.run(
        "[...document.querySelectorAll('#table thead th button')].slice(1, 4).map((b) => b.innerText)"
    )
    assert [" ".join(h.split()) for h in heads] == ["SSIM mean", "SSIM porch", "SSIM yard"]
    porch, yard, mean = (float(column(page, at)[0]) for at in (2, 3, 1))
    assert mean == pytest.approx((porch + yard) / 2, abs=0.0011)
    choose(page, "metric", "all metrics")
    type_in(page, "nobody")
    assert names(page) == [] and "Nothing measured" in page.run("document.getElementById('said').textContent")
    type_in(page, "")
    assert "Another CPU" in page.run("document.getElementById('notes').textContent")


def what_has_no_mean_is_a_note(page: Browser) -> None:
    headed = "document.querySelector('#table thead button[data-key=ssim]') !== null"
    notes = "document.getElementById('notes').textContent"
    assert page.run(headed) and "No mean over all scenes" not in page.run(notes)
    page.run("DATA.runs.filter((r) => r.scene === 'yard').forEach((r) => { delete r.quality.ssim; })")
    choose(page, "scene", "yard")
    choose(page, "scene", "all scenes")
    assert not page.run(headed)
    assert "nothing to measure it on: SSIM." in page.run(notes)
    choose(page, "scene", "porch")
    assert page.run(headed)
    choose(page, "scene", "all scenes")


def rows_open(page: Browser) -> None:
    type_in(page, "3dgs")
    page.run(
        "(() => { window.asked = ''; Object.defineProperty(navigator, 'clipboard',"
        "{value: {writeText: async (t) => { window.asked = t; }}}); })()"
    )
    page.click("#table tbody tr:first-child .open")
    assert page.run("document.querySelector('.open').ariaExpanded") == "true"
    assert page.run("document.querySelectorAll('.run').length") == 4
    page.click(".run .copy")
    page.until("document.querySelector('.run .copy').textContent === 'Copied'")
    assert page.run("window.asked").startswith("aw bench --method 3dgs --scene porch --seed 0")
    page.click("#table tbody tr:first-child .open")
    assert page.run("document.querySelectorAll('.run').length") == 0
    type_in(page, "")


def reported_stay_apart(page: Browser) -> None:
    assert sorted(names(page, "others-table")) == ["3DGS", HOSTILE]
    assert page.run("document.querySelectorAll('#others-table tbody .badge').length") == 2
    text = page.run(
        "document.getElementById('table').textContent + document.getElementById('plot').textContent"
    )
    assert "99.9" not in text and "3DGS" not in text
    choose(page, "dataset", "Elsewhere")
    assert names(page, "others-table") == ["3DGS"] and page.run("document.getElementById('measured').hidden")
    page.click("#reported")
    assert page.run("document.getElementById('others').hidden && !document.getElementById('measured').hidden")
    page.click("#reported")


def plot(page: Browser) -> None:
    assert page.run("document.querySelectorAll('#plot .point').length") == 3  # robustsplat has no mean
    assert (
        page.run("document.querySelectorAll('#plot .bar').length") == 4
    )  # two seeds: two methods, both ways
    front = page.run("document.getElementById('plot-said').textContent")
    assert f"Pareto-optimal: 3dgs, {HOSTILE}, refinesplat" in front and "logarithmic" in page.run(
        "document.getElementById('plot').textContent"
    )
    choose(page, "plot-x", "model MB")
    assert f"Pareto-optimal: {HOSTILE}, refinesplat" in page.run(
        "document.getElementById('plot-said').textContent"
    )


def slider(page: Browser) -> None:
    choose(page, "left", "refinesplat")
    assert "the photo" in page.run("document.getElementById('right-said').textContent")
    wide = "Number(getComputedStyle(document.getElementById('over')).clipPath.match(/([\\d.]+)%/)?.[1])"
    at = "document.getElementById('stage').style.getPropertyValue('--at')"
    assert page.run(at) in ("", "50%")
    x, y, w = page.run(
        "(() => { const e = document.getElementById('stage'); e.scrollIntoView({block: 'center'});"
        "const b = e.getBoundingClientRect(); return [b.x, b.y + b.height / 2, b.width]; })()"
    )
    for kind, part in (("mousePressed", 0.5), ("mouseMoved", 0.25), ("mouseReleased", 0.25)):
        page.call("Input.dispatchMouseEvent", type=kind, x=x + part * w, y=y, button="left", buttons=1,
                  clickCount=1)  # fmt: skip
    assert float(page.run(at).rstrip("%")) == pytest.approx(25, abs=1)
    assert float(page.run("document.getElementById('slider').value")) == pytest.approx(25, abs=1)
    assert page.run(wide) == pytest.approx(75, abs=1)  # cut from the right
    page.run("document.getElementById('slider').focus()")
    page.call("Input.dispatchKeyEvent", type="keyDown", key="End", code="End", windowsVirtualKeyCode=35)
    assert page.run(at) == "100%"
    choose(page, "image", "yard")
    assert "yard" in page.run("document.getElementById('over').alt")


def the_choice_is_in_the_address(page: Browser, site: str) -> None:
    choose(page, "scene", "yard")
    address = page.run("location.href")
    assert "scene=yard" in address
    page.open("about:blank#")
    page.open(address)
    assert page.run("document.getElementById('scene').value") == "yard"
    page.open(site + "#scene=%3Cb%3E&dataset=__proto__&metric=constructor&sort=-nothing")
    page.until("document.getElementById('scene').value === ''")
    assert len(names(page)) == 4
    assert page.errors == []


def on_a_phone(page: Browser, site: str) -> None:
    page.call("Emulation.setDeviceMetricsOverride", width=390, height=844, mobile=True, deviceScaleFactor=2)
    page.open(site.replace("index.html", "index.html?phone"))
    assert page.run("document.documentElement.scrollWidth") == 390
    page.click("#table tbody tr:first-child .open")
    assert page.run("document.documentElement.scrollWidth") == 390
    small = page.run(
        "[...document.querySelectorAll('select, input[type=search], thead button')]"
        ".filter((e) => e.offsetHeight && e.offsetHeight < 36).length"
    )
    assert small == 0 and page.errors == []
