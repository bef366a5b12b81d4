"""Laid-out tables: what stands where, who is not told apart, what papers report, and names that stay text."""

from __future__ import annotations

import csv
import io
import json
import math
import re
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner
from hypothesis import given, settings
from hypothesis import strategies as st

from ambiguous_wild.cli.table import table_command
from ambiguous_wild.core import AwError
from ambiguous_wild.harness.measures import MEASURES
from ambiguous_wild.harness.store import Runs, read_runs
from ambiguous_wild.report import papers, plain_formats
from ambiguous_wild.report.ablation_report import ablation
from ambiguous_wild.report.papers import datasets_of, read_reported, with_reported
from ambiguous_wild.report.plain_formats import divided
from ambiguous_wild.report.table_layout import Column, Table, TableCell
from ambiguous_wild.report.typeset import latex_text, to_html, to_latex
from tests.harness.fake_runs import failed, fake_result, save

HOSTILE = '=[2em]<script src="http://x">|\\input{x}$&%#_^~"*`[a](http://b)\x1b[31m\u202e日'
REPORTED = """table,method,setting,dataset,scene,metric,variant,value,mark,printed
main,Famous,,Wild,Yard-One,psnr,unknown,30.10,1,30.10
other,Famous,,Wild,Yard-One,psnr,unknown,29.00,,29.00
main,Famous,,Wild,mean,psnr,unknown,31.25,,31.25
main,Famous,no masks,Wild,Yard-One,psnr,unknown,99.00,,99.00
main,Famous,,Other,mean,psnr,unknown,11.00,,11.00
memory,Famous,,Wild,Yard-One,memory,MB,110.50,,110.50
"""


def runs_of(root: Path, *results: dict) -> Runs:  # type: ignore[type-arg]
    return read_runs(save(root, *results))


def entry(layout: Table, method: str, group: str, key: str = "psnr", kind: str = "measured") -> TableCell:
    row = next(row for row in layout.rows if row.name == method and row.kind == kind)
    at = [(c.group, c.measure.key) for c in layout.columns].index((group, key))
    return row.cells[at]


def results(*scenes: str) -> list[dict]:  # type: ignore[type-arg]
    return [
        fake_result(m, s, k, (p + k, p + 2.0 + k))
        for m, p in (("a", 20.0), ("b", 25.0))
        for s in scenes
        for k in (0, 1)
    ]


def test_the_papers_layout_has_scenes_side_by_side_and_the_mean_last(tmp_path: Path) -> None:
    (layout,) = papers.paper(runs_of(tmp_path, *results("one", "two")))
    assert layout.groups == [("one", 2), ("two", 2), ("Mean", 2)]  # LPIPS is empty: left out
    assert [c.measure.key for c in layout.columns[:2]] == ["psnr", "ssim"]
    assert entry(layout, "a", "one").value == 21.5 and entry(layout, "a", "one").rank == 2
    mean = entry(layout, "b", "Mean")
    assert mean.rank == 1 and mean.spread == pytest.approx(math.sqrt(0.5))
    assert any("lpips_alex" in note for note in layout.notes)


def test_wide_layouts_become_tables_that_fit(tmp_path: Path) -> None:
    (layout,) = papers.paper(runs_of(tmp_path, *results("one", "two", "three")))
    parts = divided(layout, 60)
    assert len(parts) > 1 and [c for p in parts for c in p.columns] == list(layout.columns)
    for part in parts:
        assert all(len(row.cells) == len(part.columns) for row in part.rows)
        text = plain_formats.to_text([replace(part, notes=())]).splitlines()
        table = text[: next(i for i, line in enumerate(text) if not line.strip())]
        assert max(map(len, table[1:])) <= 60
        assert len({c.group for c in part.columns}) == len(part.groups)
    assert [p.notes for p in parts[:-1]] == [()] * (len(parts) - 1) and parts[-1].notes == layout.notes
    assert divided(layout, 1000) == [layout]


def test_many_scenes_go_into_several_tables_with_one_mean(tmp_path: Path) -> None:
    names = [f"s{i}" for i in range(7)]
    layouts = papers.paper(runs_of(tmp_path, *results(*names)))
    assert [[g for g, _ in layout.groups] for layout in layouts] == [names[:6], ["s6", "Mean"]]
    assert "(1 of 2)" in layouts[0].title


def test_datasets_have_means_of_their_own_and_missing_cells_make_them_missing(tmp_path: Path) -> None:
    lost = [r for r in results("one", "two", "three") if not (r["method"] == "a" and r["scene"] == "two")]
    runs = runs_of(tmp_path, *lost, failed("b", "three", 2))
    datasets = {"D": ["one", "two"]}
    (layout,) = papers.means(runs, datasets=datasets)
    assert [g for g, _ in layout.groups] == ["D (2)", "other scenes (1)"]
    assert entry(layout, "a", "D (2)").state == "missing" and entry(layout, "b", "D (2)").value == 26.5
    assert entry(layout, "b", "other scenes (1)").state == "failed"
    assert any("no result: a on two" in note for note in layout.notes)
    with pytest.raises(AwError, match="two datasets"):
        papers.paper(runs, datasets={"D": ["one"], "E": ["one"]})
    with pytest.raises(AwError, match="did you mean 'three'"):
        papers.paper(runs, datasets={"D": ["thre"]})


def test_who_is_not_told_apart_from_the_best_is_marked(tmp_path: Path) -> None:
    best = np.array([20.0, 25.0, 30.0, 22.0, 27.0, 24.0])
    values = {
        "best": best,
        "close": best + np.array([0.4, -0.5, 0.3, -0.4, -0.2, 0.1]),
        "below": best - 1.0,  # pictures differ more than methods: only pairs tell them apart
    }
    (layout,) = papers.paper(runs_of(tmp_path, *(fake_result(m, psnr=tuple(v)) for m, v in values.items())))
    assert [entry(layout, m, "yard").tie for m in values] == [False, True, False]
    assert "paired t interval" in layout.legend[0] and "≈" in plain_formats.to_text([layout])
    for count, tie in ((1, False), (2, True), (4, True), (9, False)):  # few images tell few methods apart
        few = (20.5 + 0.4 * (-1.0) ** k for k in range(count))
        near = fake_result("b", psnr=(20.0,) * count), fake_result("a", psnr=tuple(few))
        (layout,) = papers.paper(runs_of(tmp_path / str(count), *near))
        assert entry(layout, "b", "yard").tie == tie


def test_other_pictures_are_not_paired(tmp_path: Path) -> None:
    other = fake_result("b", psnr=(20.1, 22.1))
    for i, row in enumerate(other["per_image"]):
        row["name"] = f"other{i}.png"
    (layout,) = papers.paper(runs_of(tmp_path, fake_result("a"), other))
    assert not entry(layout, "a", "yard").tie


def test_reported_numbers_stand_beside_and_change_nothing(tmp_path: Path) -> None:
    (tmp_path / "tables").mkdir()
    (tmp_path / "tables" / "t.csv").write_text(REPORTED)
    numbers = read_reported(tmp_path / "tables")
    datasets = datasets_of(numbers, ["yard_one", "two"])
    assert datasets == {"Wild": ["yard_one"]}
    runs = runs_of(tmp_path / "runs", *results("yard_one", "two"))
    datasets = {"Wild": ["yard_one", "two"]}
    (plain_table,) = papers.paper(runs, datasets=datasets)
    layout = with_reported(plain_table, numbers)
    assert layout.rows[:2] == plain_table.rows
    shown = entry(layout, "Famous", "yard_one", kind="reported")
    assert shown.printed == "30.10 / 29.00" and math.isnan(shown.value) and shown.rank is None
    assert entry(layout, "Famous", "Mean", kind="reported").printed == "31.25"
    assert entry(layout, "Famous", "two", kind="reported").text(MEASURES["psnr"]) == ""
    rows = list(csv.DictReader(io.StringIO(plain_formats.to_long_csv([layout]))))
    told = [row for row in rows if row["kind"] == "reported"]
    assert told and all(row["value"] == "" and row["rank"] == "" and row["printed"] for row in told)
    assert all(row["printed"] == "" for row in rows if row["kind"] == "measured")
    for text in (to_latex([layout]), to_html([layout]), plain_formats.to_markdown([layout])):
        assert "reported" in text and "99.00" not in text
    (memory,) = papers.paper(runs, metrics=["model_mb"], datasets=datasets)
    shown = entry(with_reported(memory, numbers), "Famous", "yard_one", "model_mb", "reported")
    assert shown.printed == "110.50"
    (elsewhere,) = papers.paper(runs, scenes=["two"])
    assert with_reported(elsewhere, numbers).rows == elsewhere.rows


def test_the_projects_own_tables_can_be_shown() -> None:
    numbers = read_reported()
    columns = tuple(Column(s, MEASURES["psnr"], s) for s in ("patio-high", "Trevi Fountain"))
    layout = with_reported(Table("t", columns, ()), numbers)
    assert {row.kind for row in layout.rows} == {"reported"} and len(layout.rows) > 5


def study(folder: Path) -> Path:
    def row(variant: str, psnr: float | None, status: str = "ok") -> dict:  # type: ignore[type-arg]
        values = {"psnr": {"mean": psnr, "spread": 0.1}, "model_mb": {"mean": 1.0, "spread": None}}
        return {"group": "masks", "variant": variant, "text": "", "status": status, "reason": "no weights",
                "values": values}  # fmt: skip

    data = {
        "method": "refinesplat", "made_by": "aw ablate", "scenes": ["yard"], "seeds": [0, 1],
        "groups": [{"name": "masks", "title": "parts of the mask", "source": "Tab. 4"}],
        "rows": [row("default", 25.0), row("local", 24.0), row("dino", None, "missing")],
    }  # fmt: skip
    (folder / "ablation.json").write_text(json.dumps(data))
    return folder


def test_an_ablation_is_a_table_a_group(tmp_path: Path) -> None:
    (layout,) = ablation(study(tmp_path))
    one = json.loads((tmp_path / "ablation.json").read_text())
    assert layout.spread_over == "seeds"
    one["scenes"] = [*one["scenes"], "another"]
    (tmp_path / "two").mkdir()
    (tmp_path / "two" / "ablation.json").write_text(json.dumps(one))
    assert ablation(tmp_path / "two")[0].spread_over == "scenes and seeds"
    assert layout.title == "refinesplat, masks: parts of the mask (paper: Tab. 4)"
    assert [entry(layout, m, "").rank for m in ("default", "local", "dino")] == [1, 2, None]
    assert entry(layout, "dino", "").state == "missing" and "dino missing: no weights" in layout.notes
    assert "\\multicolumn{1}" not in to_latex([layout])  # no heading over nothing
    with pytest.raises(AwError, match="aw ablate"):
        ablation(tmp_path / "absent")
    with pytest.raises(AwError, match="it has psnr"):
        ablation(tmp_path, ("pnsr",))
    (tmp_path / "ablation.json").write_text("[]")
    with pytest.raises(AwError, match="damaged"):
        ablation(tmp_path)


class Page(HTMLParser):
    """Tags that are open, the text, and whatever could load or run something."""

    def __init__(self, page: str) -> None:
        super().__init__()
        self.open: list[str] = []
        self.words: list[str] = []
        self.feed(page)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        assert tag not in ("script", "link", "img", "iframe", "a")
        assert {name for name, _ in attrs} <= {"charset", "name", "content", "class", "colspan", "scope",
                                               "title", "lang"}  # fmt: skip
        if tag != "meta":
            self.open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        self.words.append(data)


def hostile(tmp_path: Path) -> Table:
    (layout,) = papers.paper(runs_of(tmp_path, fake_result(HOSTILE, psnr=(20.0,)), fake_result("b")))
    return layout.with_notes(f"made by: aw table {HOSTILE}")


def test_html_is_whole_needs_nothing_and_names_stay_text(tmp_path: Path) -> None:
    page = Page(to_html([hostile(tmp_path), hostile(tmp_path)]))
    assert page.open == []
    text = "".join(page.words)
    assert '<script src="http://x">' in text and "\x1b" not in text and "\u202e" not in text
    assert "@import" not in text and "url(" not in text


def test_latex_is_balanced_and_names_stay_text(tmp_path: Path) -> None:
    latex = to_latex([hostile(tmp_path)])
    code = [line for line in latex.splitlines() if not line.startswith("%")]
    bare = re.sub(r"\\[\\{}&]", "", "\n".join(code))
    assert bare.count("{") == bare.count("}")
    begun, ended = re.findall(r"\\begin\{(\w+\*?)\}", latex), re.findall(r"\\end\{(\w+\*?)\}", latex)
    assert begun == ended[::-1] and len(begun) == 2
    assert {"\\toprule", "\\midrule", "\\bottomrule"} <= set(code) and "\\cmidrule(lr){2-3}" in code
    rows = [line for line in code if line.endswith(r"\\") and not line.startswith(r"\multicolumn")]
    assert {len(re.findall(r"(?<!\\)&", row)) for row in rows[1:]} == {2}
    assert not any("\\input{" in line for line in code) and "\x1b" not in latex
    assert "(U+65E5)" in latex  # no font of pdflatex has it


@settings(max_examples=40, deadline=None)
@given(st.text(max_size=20))
def test_any_name_is_ascii_or_latin_for_latex(name: str) -> None:
    assert all(c.isascii() or c == "±" or "À" <= c <= "ÿ" for c in latex_text(name))


def test_every_column_is_under_its_heading_in_text(tmp_path: Path) -> None:
    runs = runs_of(tmp_path, *results("a scene with a very long name", "two"))
    lines = plain_formats.to_text(papers.paper(runs)).splitlines()
    top, head = lines[1], lines[2]
    assert top.index("two") <= head.index("PSNR", top.index("two")) < top.index("Mean")
    assert len({len(line) for line in lines[3:6]}) == 1


def test_what_does_not_differ_from_the_best_is_marked_in_every_format(tmp_path: Path) -> None:
    close, far = (20.0, 22.0, 24.0, 21.0), (10.0, 12.0, 14.0, 11.0)
    near = tuple(p + d for p, d in zip(close, (0.3, -0.25, 0.2, -0.2)))
    runs = save(tmp_path, *(fake_result(m, psnr=p) for m, p in zip("abc", (close, near, far))))
    marks = {"text": "≈", "markdown": "≈", "html": "≈", "csv": ",yes,", "latex": r"\approx"}
    for style, mark in marks.items():
        done = CliRunner().invoke(table_command, [str(runs), "--format", style])
        assert done.exit_code == 0 and done.stdout.count(mark) >= (1 if style == "csv" else 2), style
    shown = [line for line in done.stdout.splitlines() if not line.startswith("%")]  # of LaTeX
    assert any(r"$\approx$: not significantly different" in line for line in shown)
