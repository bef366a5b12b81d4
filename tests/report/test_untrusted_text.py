"""Every text of a result and of its settings stays text in every format of `aw table` and `aw cost`."""

from __future__ import annotations

import csv
import io
import itertools
import json
import re
import unicodedata
from collections.abc import Callable, Iterator
from copy import deepcopy
from html.parser import HTMLParser
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import pytest
import yaml
from click.testing import CliRunner

from ambiguous_wild.cli.cost import command as cost
from ambiguous_wild.cli.table import LAYOUTS, STYLES, table_command
from ambiguous_wild.core import AwError
from ambiguous_wild.harness.result_file import RESULT, read_result
from tests.harness.fake_runs import fake_result
from tests.report.fake_cost import ALONE, cost_run

HOSTILE = '=1+1 <script onload="x()">&|\\input{x}$%#_^~"*`[a](http://b)![c](d)\x1b[31m\u202e\n\r\t|end'
TAGS = {"!doctype", "html", "head", "meta", "title", "style", "body", "table", "caption", "colgroup", "col",
        "thead", "tbody", "tr", "th", "td", "p", "b", "strong", "em", "br", "ul", "li", "h1", "h2", "div",
        "span", "sup", "sub", "section", "details", "summary", "main", "abbr"}  # fmt: skip


def rich_result(method: str) -> dict[str, Any]:
    """A result with a text in every field that may hold one."""
    record = {"label": "shade", "better": "lower", "digits": 2, "partial": False, "source": "f"}
    facts = {
        "effects": ["exposure"], "no_effects": "why", "length": "long", "test_photos": "mixed", "start": "s",
        "protocol": "full", "watchdog": "w",
    }  # fmt: skip
    result = fake_result(
        method, options={"features": "dino", "mask": {"kind": "k"}}, facts=facts, code_hash="c",
        reproduce="aw bench --method a --scene yard", metrics={"shade": record},
        environment={"gpu": "GPU", "cpu": "CPU", "platform": "p"},
    )  # fmt: skip
    result["cost"]["timing"] = {"verdict": "contended", "reason": "busy", "kernel": "cpu-1"}
    for row in result["per_image"]:
        row["shade"] = 1.0
    return result


def texts(tree: Any, path: tuple[Any, ...] = ()) -> Iterator[tuple[Any, ...]]:
    """Yield the path of every text in a tree."""
    if isinstance(tree, dict):
        for key, value in tree.items():
            yield from texts(value, (*path, key))
    elif isinstance(tree, list):
        for at, value in enumerate(tree):
            yield from texts(value, (*path, at))
    elif isinstance(tree, str):
        yield path


def with_text(tree: Any, path: tuple[Any, ...], text: str) -> Any:
    changed = deepcopy(tree)
    *parents, last = path
    place = changed
    for key in parents:
        place = place[key]
    place[last] = text
    return changed


def accepted(result: dict[str, Any], folder: Path) -> dict[str, Any]:
    """Return the result with `HOSTILE` in every text that a reader accepts; the others are refused."""
    folder.mkdir(parents=True)
    for path in texts(result):
        changed = with_text(result, path, f"{HOSTILE} {'.'.join(map(str, path))}")
        (folder / RESULT).write_text(json.dumps(changed), encoding="utf-8")
        try:
            read_result(folder / RESULT)
        except AwError:
            continue
        result = changed
    return result


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two finished runs, a failed one and one without a result, of which every text is hostile."""
    root = tmp_path_factory.mktemp("hostile")
    result = accepted(rich_result("a"), root / "probe")
    assert {("method",), ("scene",), ("missing", "lpips_alex"), ("metrics", "shade", "label"),
            ("facts", "start"), ("options", "features"), ("cost", "timing", "reason")} <= {
        path for path in texts(result) if HOSTILE in str(_at(result, path))}  # fmt: skip
    # the first label of a key is kept by the process, and reading "shade" has given it one
    result = json.loads(json.dumps(result).replace('"shade":', '"hue":'))
    failed = result | {"method": HOSTILE + "f", "status": "failed", "error": HOSTILE, "per_image": []}
    config = {"source": HOSTILE, "train": {"resolution": HOSTILE}, "device": HOSTILE}
    other = result | {"method": HOSTILE + "b"}
    for at, (name, one) in enumerate(((RESULT, result), (RESULT, other), ("failed.json", failed))):
        folder = root / "runs" / f"r{at}"
        folder.mkdir(parents=True)
        (folder / name).write_text(json.dumps(one), encoding="utf-8")
        (folder / "config.yaml").write_text(yaml.safe_dump(config), encoding="utf-8")
    (root / "runs/r3").mkdir()
    unfinished = {"method": HOSTILE + "u", "scene": {"name": HOSTILE}}
    (root / "runs/r3/config.yaml").write_text(yaml.safe_dump(unfinished), encoding="utf-8")
    return root / "runs"


def _at(tree: Any, path: tuple[Any, ...]) -> Any:
    for key in path:
        tree = tree[key]
    return tree


def check_text(text: str) -> None:
    odd = {c for c in text if unicodedata.category(c) in ("Cc", "Cf") and c not in "\n\u200b"}
    assert not odd


def check_markdown(text: str) -> None:
    check_text(text)
    prose = text.replace("&#8203;", "")
    assert "<" not in prose and "http:" not in text
    assert not re.search(r"(?<!\\)\]\(", text) and not re.search(r"(?<!\\)`", text)
    for _, block in itertools.groupby(text.splitlines(), lambda line: line.startswith("|")):
        lines = list(block)
        if lines[0].startswith("|"):
            assert len({len(re.findall(r"(?<!\\)\|", line)) for line in lines}) == 1, lines


def check_csv(text: str) -> None:
    rows = list(csv.reader(io.StringIO(text)))
    assert rows and len({len(row) for row in rows}) == 1
    for cell in (cell for row in rows for cell in row):
        check_text(cell)
        if cell.lstrip()[:1] in ("=", "+", "-", "@"):
            float(cell)


def check_latex(text: str) -> None:
    check_text(text)
    for line in re.sub(r"(?m)^%.*$", "", text).splitlines():
        assert r"\input{" not in line and not re.search(r"(?<!\\)[#%].", line), line


class _Tags(HTMLParser):
    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        assert tag in TAGS, tag
        for name, value in attrs:
            assert not name.startswith("on") and name in ("class", "style", "lang", "charset", "name",
                    "content", "scope", "colspan", "rowspan", "title", "open"), (name, value)  # fmt: skip


def check_html(text: str) -> None:
    check_text(text)
    _Tags().feed(text)


CHECKS: dict[str, Callable[[str], None]] = {
    "text": check_text, "markdown": check_markdown, "csv": check_csv, "tidy": check_csv,
    "latex": check_latex, "html": check_html,
}  # fmt: skip


@pytest.mark.parametrize(
    ("style", "layout"),
    [
        (style, layout)
        for style, layout in itertools.product(STYLES, LAYOUTS)
        if layout == "blocks" or (layout != "ablation" and style != "tidy")
    ],
)
def test_tables_hold_texts_of_results_as_text(style: str, layout: str, runs: Path) -> None:
    words = [str(runs), "--format", style, "--layout", layout, "--metric", "all"]
    shown = CliRunner().invoke(table_command, words)
    assert shown.exit_code == 0, shown.output
    assert "end" in shown.stdout
    CHECKS[style](shown.stdout)
    check_text(shown.stderr)


def test_cost_reports_hold_texts_of_results_as_text(tmp_path: Path) -> None:
    for at, options in enumerate(({"kind": HOSTILE}, {"kind": "other"})):
        run = cost_run(
            tmp_path / f"runs/{at}", HOSTILE, HOSTILE.replace("/", ""), psnr=(20.0 + at,), options=options,
            effects=(HOSTILE,), timing=ALONE | {"verdict": "contended", "reason": HOSTILE},
        )  # fmt: skip
        assert run.is_dir()
    shown = CliRunner().invoke(cost, [str(tmp_path / "runs"), "-o", str(tmp_path / "out")])
    assert shown.exit_code == 0, shown.output
    check_text(shown.output)
    written = sorted((tmp_path / "out").iterdir())
    assert {path.suffix for path in written} == {".csv", ".json", ".svg", ".png"}
    for path in written:
        if path.suffix == ".csv":
            check_csv(path.read_text(encoding="utf-8"))
        elif path.suffix == ".json":
            json.loads(path.read_text(encoding="utf-8"))
        elif path.suffix == ".svg":
            tags = {element.tag.rpartition("}")[2] for element in ElementTree.parse(path).iter()}
            assert not tags & {"script", "foreignObject", "image", "a"}
