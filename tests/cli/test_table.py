"""`aw table`: the numbers of the files on the way out, and nothing else written."""

from __future__ import annotations

import io
from pathlib import Path

import pandas as pd
import pytest
from click.testing import CliRunner

from ambiguous_wild.cli.table import table_command as command
from tests.harness.fake_runs import failed, fake_result, save


def aw_table(*words: str | Path) -> tuple[str, str]:
    done = CliRunner().invoke(command, [str(w) for w in words], catch_exceptions=False)
    assert done.exit_code == 0, done.output
    return done.stdout, done.stderr


def test_default_prints_a_table_and_how_it_was_made(tmp_path: Path) -> None:
    save(tmp_path, fake_result("3dgs", psnr=(20.0,)), fake_result("b", psnr=(23.0,)), failed("c"))
    before = sorted(tmp_path.rglob("*"))
    out, err = aw_table(tmp_path)
    assert "23.00 (1)" in out and "20.00 (2)" in out and "failed: c on yard" in out
    assert f"command: aw table {tmp_path}" in out
    assert "missing: lpips_alex: weights missing" in out
    assert err == "" and sorted(tmp_path.rglob("*")) == before


@pytest.mark.parametrize(
    ("name", "style"),
    [("t.x", "text"), ("t.csv", "csv"), ("t.tex", "latex"), ("t.html", "html"), ("t.MD", "markdown")],
)
@pytest.mark.parametrize(
    ("layout", "scenes"), [("blocks", "1 scene, "), ("paper", "1 scene, "), ("means", "")]
)
def test_a_file_holds_what_would_be_printed_in_the_format_of_its_suffix(
    name: str, style: str, layout: str, scenes: str, tmp_path: Path
) -> None:
    runs = save(tmp_path / "my runs", fake_result("3dgs"), fake_result("b", psnr=(23.0,)))
    words = ["--layout", layout, "--metric", "psnr", "--metric", "ssim"]
    out, _ = aw_table(runs, *words, "--format", style)
    words += ["--format", style] if name == "t.x" else []
    printed, err = aw_table(runs, *words, "-o", tmp_path / "out" / name)
    assert printed == "" and f"wrote {tmp_path / 'out' / name}: 2 methods, {scenes}2 metrics\n" in err
    assert (tmp_path / "out" / name).read_text() == out


def test_several_folders_make_one_table(tmp_path: Path) -> None:
    one = save(tmp_path / "one", fake_result("3dgs", psnr=(20.0,)), fake_result("b", psnr=(23.0,)))
    two = save(tmp_path / "two", fake_result("3dgs", psnr=(21.0,)))
    out, _ = aw_table(one, two, "--metric", "psnr")
    rows = {line.split("  ")[0].strip(): line for line in out.splitlines()}
    assert "20.00" in rows[f"3dgs in {one}"] and "21.00" in rows[f"3dgs in {two}"] and "23.00" in rows["b"]
    assert f"command: aw table {one} {two} --metric psnr" in out
    assert "3dgs in" not in aw_table(one, f"{one}/../one")[0]


@pytest.mark.parametrize("width", [60, 160])
def test_rows_fit_the_terminal(width: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    runs = save(tmp_path / "runs", fake_result("3dgs"), fake_result("b", psnr=(23.0,)))
    monkeypatch.setenv("COLUMNS", str(width))
    out, _ = aw_table(runs)
    rows = [line for line in out.splitlines() if line.startswith(("3dgs ", "b ", "─"))]
    assert len(rows) >= 3 and max(map(len, rows)) <= width
    assert (f"to fit {width} columns" in out) == (width == 60)
    every, _ = aw_table(runs, "--metric", "all")
    assert "columns;" not in every and f"command: aw table {runs}\n" in every


def test_csv_is_clean_and_notes_go_to_standard_error(tmp_path: Path) -> None:
    save(tmp_path, fake_result("3dgs", psnr=(20.0, 21.0)), failed("c"))
    out, err = aw_table(tmp_path, "--format", "csv", "--metric", "psnr", "--only", "yard")
    frame = pd.read_csv(io.StringIO(out)).set_index("method")
    assert frame.loc["3dgs", "psnr"] == 20.5 and pd.isna(frame.loc["c", "psnr"])
    assert "failed: c on yard" in err
    assert f"aw table {tmp_path} --format csv --metric psnr --only yard" in err


@pytest.mark.parametrize("style", ["text", "markdown", "latex", "html"])
@pytest.mark.parametrize("layout", ["paper", "means", "blocks"])
def test_the_command_stands_under_every_table(layout: str, style: str, tmp_path: Path) -> None:
    runs = save(tmp_path, *(fake_result(m, s) for m in ("3dgs", "b") for s in ("one", "two")))
    out, err = aw_table(runs, "--layout", layout, "--format", style, "--metric", "psnr")
    words = f"aw table {runs}" + (f" --format {style}" if style != "text" else "")
    words += f" --layout {layout}" if layout != "blocks" else ""
    assert words.replace("_", "\\_") + " --metric psnr" in out or words + " --metric psnr" in out
    assert err == ""


def test_datasets_and_reported_numbers(tmp_path: Path) -> None:
    runs = save(tmp_path / "runs", *(fake_result("3dgs", s) for s in ("one", "two", "Porter")))
    tables = tmp_path / "t.csv"
    tables.write_text(
        "method,dataset,scene,metric,value\nFamous,D,one,psnr,30.10\nFamous,D,mean,psnr,31.00\n"
    )
    words = ["--layout", "paper", "--dataset", "D=one,two", "--metric", "psnr", "--reported", tables]
    out, _ = aw_table(runs, *words)
    first, second = out.split("Porter\n", 1)
    assert "Famous" in first and "30.10" in first and "31.00" in first and "Famous" not in second
    assert f"--dataset D=one,two --reported {tables}" in out
