"""The study page in a real browser: from file://, by key and finger, resumed, saved, scored."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from click.testing import CliRunner

from ambiguous_wild.cli.study import command
from tests.chromium import Browser, needs_chromium
from tests.study.studies import write_runs
from tests.tiny_scene import TEST, TRAIN

pytestmark = [pytest.mark.slow, needs_chromium]
ASKED = len(TRAIN) + 3 * len(TEST)


@pytest.fixture(scope="module")
def study(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("study")
    scene, runs = write_runs(root)
    words = ["make", "--scene", scene, runs, "-o", root / "s.html", "--title", "<b>A & B</b>"]
    assert CliRunner().invoke(command, [str(w) for w in words], catch_exceptions=False).exit_code == 0
    return root


def shown(browser: Browser) -> str:
    return browser.run("[...document.querySelectorAll('main')].find((m) => !m.hidden).id")


def look(browser: Browser) -> None:
    """Pretend that the rater has looked for a while."""
    browser.run("since -= 3000")


def test_a_rater_s_way_through(study: Path, tmp_path: Path) -> None:
    files = tmp_path / "files"
    key = json.loads((study / "s.key.json").read_text())
    with Browser(tmp_path / "profile") as page:
        page.call("Browser.setDownloadBehavior", behavior="allow", downloadPath=str(files))
        page.open((study / "s.html").as_uri())
        assert page.run("document.querySelector('h1').textContent") == "<b>A & B</b>"
        page.run("document.querySelector('#name').value = '=<i>Ann</i>'")
        page.click("#name")
        page.call("Input.dispatchKeyEvent", type="keyDown", key="Enter", text="\r", code="Enter",
                  windowsVirtualKeyCode=13)  # fmt: skip
        page.call("Input.dispatchKeyEvent", type="keyUp", key="Enter", code="Enter")
        assert (
            shown(page) == "ask"
            and page.run("document.querySelector('#count').textContent") == f"1 of {ASKED}"
        )
        before = page.run("document.querySelector('#pictures img').src")
        page.key("m")
        assert page.run("document.querySelector('#pictures img').src") != before
        page.click("#pictures img")
        assert page.run("document.querySelector('#zoom').open")
        page.click("#zoom img")
        for _ in TRAIN:
            look(page)
            page.key("4")
        assert page.run("document.querySelectorAll('#pictures img').length") == 3
        pictures_are_as_large_as_the_window_allows(page)
        look(page)
        page.key("ArrowLeft")
        look(page)
        page.key("ArrowDown")
        # Closed and opened again: it goes on where it was, in the same order.
        order = page.run("order.map((q) => q.id + q.left).join()")
        page.open((study / "s.html").as_uri())
        assert page.run("order.map((q) => q.id + q.left).join()") == order
        assert "8 of 12" in page.run("document.querySelector('#start').textContent")
        page.click("#start")
        assert page.run("document.querySelector('#count').textContent") == f"9 of {ASKED}"
        page.key("Backspace")
        assert page.run("document.querySelector('[aria-pressed=true]').dataset.value") == "tie"
        page.key("ArrowRight")  # changes the mind, and goes on where the answers end
        assert page.run("document.querySelector('#count').textContent") == f"9 of {ASKED}"
        for number in range(4):
            if number < 3:
                look(page)
            page.click("#choices button:nth-child(3)")  # the last one without a look
        assert shown(page) == "done"
        page.click("#json")
        page.click("#csv")
        page.until("document.querySelector('#saved').textContent.includes('.csv')")
        given = page.run("order.map((q) => [q.id, q.left, state.answers[q.id].answer])")
        assert page.requests == [(study / "s.html").as_uri()] and page.errors == []
        while len(found := [p for p in files.glob("answers-*") if p.suffix in (".json", ".csv")]) < 2:
            page.run("new Promise((done) => setTimeout(done, 50))")
    for path in found:
        out = tmp_path / f"out{path.suffix}"
        words = ["score", path, "--key", study / "s.key.json", "-o", out, "--json"]
        done = CliRunner().invoke(command, [str(w) for w in words], catch_exceptions=False)
        scores = json.loads(done.stdout)
        assert scores["raters"][0]["name"] == "=<i>Ann</i>" and scores["raters"][0]["answers"] == ASKED
        assert {s["mean"] for s in scores["ambiguity"]["scenes"]} == {4}
        rater = scores["raters"][0]
        assert (rater["too_fast"], rater["outlined"]) == (1, 1)
        assert scores["ambiguity"]["scenes"][0]["outlined"] == 1
        # First pair: left; all others: right. What stood there, the key says.
        pairs = [
            (q, left, answer) for q, left, answer in given if key["questions"][q]["kind"] == "preference"
        ]
        assert [answer == left for _, left, answer in pairs] == [True, *[False] * 5]
        wins = [key["questions"][q][answer] for q, _, answer in pairs[:-1]]  # the last was too fast
        for row in scores["preference"]["methods"]:
            assert round(row["share"] * row["n"]) == wins.count(row["method"])
        assert scores["preference"]["left"]["share"] == pytest.approx(1 / 5)


def pictures_are_as_large_as_the_window_allows(page: Browser) -> None:
    """Whatever the window, no other number of columns would make them larger."""
    size = "(() => { const b = document.querySelector('#pictures img').getBoundingClientRect();" \
        "const r = 64 / 48; return Math.min(b.width, b.height * r); })()"  # fmt: skip
    for width, height in ((1300, 700), (700, 900), (1280, 800)):
        page.call("Emulation.setDeviceMetricsOverride", width=width, height=height, mobile=False,
                  deviceScaleFactor=1)  # fmt: skip
        page.run("layOut()")
        best = page.run(size)
        box = "document.querySelector('#pictures')"
        for columns in (1, 2, 3):
            page.run(f"{box}.style.gridTemplateColumns = 'repeat({columns}, 1fr)'")
            assert page.run(size) <= best + 1 or page.run("innerWidth") <= 720
        page.run("layOut()")
        assert page.run("document.documentElement.scrollHeight") <= height


def test_orders_differ_between_raters(study: Path, tmp_path: Path) -> None:
    with Browser(tmp_path / "profile") as page:
        page.open((study / "s.html").as_uri())
        orders, sides = set(), set()
        for n in range(6):
            got = page.run(f"state.rater = 'rater{n}', arrange(), order.map((q) => [q.id, q.left])")
            orders.add(tuple(q for q, _ in got))
            sides |= {tuple(pair) for pair in got}
        assert len(orders) == 6
        assert len(sides) == 2 * ASKED  # whoever is x stands left for some and right for others


def test_on_a_phone_everything_fits_and_answers_by_finger(study: Path, tmp_path: Path) -> None:
    with Browser(tmp_path / "profile", width=360, height=640, mobile=True) as page:
        page.open((study / "s.html").as_uri())
        page.click("#start")
        for number in range(ASKED):
            assert page.run("document.documentElement.scrollWidth") == 360
            boxes = page.run(
                "[...document.querySelectorAll('#ask button:not([hidden]), #pictures img')].map((e) => {"
                "const b = e.getBoundingClientRect(); return [b.left, b.top, b.right, b.bottom]; })"
            )
            assert all(0 <= x0 < x1 <= 360 and 0 <= y0 < y1 <= 640 for x0, y0, x1, y1 in boxes), number
            targets = page.run("[...document.querySelectorAll('#choices button')].map((b) => b.offsetHeight)")
            assert min(targets) >= 44
            page.click("#choices button:nth-child(2)")
        assert shown(page) == "done" and page.errors == []


def test_without_storage_it_says_so_and_still_works(study: Path, tmp_path: Path) -> None:
    with Browser(tmp_path / "profile") as page:
        page.call(
            "Page.addScriptToEvaluateOnNewDocument",
            source="Object.defineProperty(window, 'localStorage', {get() { throw new Error('no'); }})",
        )
        page.open((study / "s.html").as_uri())
        assert page.run("!document.querySelector('#memory').hidden")
        page.click("#start")
        for _ in range(3):
            page.key("2")
        page.click("#pause")
        assert f"3 of {ASKED}" in page.run("document.querySelector('#state').textContent")
        page.click("#show")
        assert len(json.loads(page.run("document.querySelector('#text').value"))["answers"]) == 3
        assert page.errors == []


def test_what_lies_in_storage_is_not_trusted(study: Path, tmp_path: Path) -> None:
    with Browser(tmp_path / "profile") as page:
        page.open((study / "s.html").as_uri())
        for bad in ("{", "null", "[]", '{"rater": 3}', '{"rater": "r", "answers": {"zz": 1}, "name": "<b>"}'):
            page.run(f"localStorage.setItem(SLOT, {json.dumps(bad)})")
            page.open((study / "s.html").as_uri())
            page.click("#start")
            assert shown(page) == "ask" and page.errors == []
