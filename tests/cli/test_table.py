"""`aw table`: the numbers of the files on the way out, and nothing else written."""

from __future__ import annotations

import io
import os
from pathlib import Path

import pandas as pd
import pytest
from click.testing import CliRunner

from ambiguous_wild.cli.table import table_command as command
from ambiguous_wild.core import AwError
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


@pytest.mark.parametrize("style", ["text", "markdown", "csv", "latex"])
def test_output_file_holds_what_would_be_printed(style: str, tmp_path: Path) -> None:
    runs = save(tmp_path / "my runs", fake_result("3dgs"), fake_result("b", psnr=(23.0,)))
    out, _ = aw_table(runs, "--format", style)
    target = tmp_path / "out" / "table.x"
    printed, err = aw_table(runs, "--format", style, "-o", target)
    assert printed == "" and "2 methods, 1 scene, " in err
    assert target.read_text() == out


@pytest.mark.parametrize(
    ("name", "style"), [("t.csv", "csv"), ("t.tex", "latex"), ("t.html", "html"), ("t.MD", "markdown")]
)
def test_the_suffix_of_the_output_is_its_format(name: str, style: str, tmp_path: Path) -> None:
    runs = save(tmp_path / "runs", fake_result("3dgs"), fake_result("b", psnr=(23.0,)))
    aw_table(runs, "-o", tmp_path / name)
    assert (tmp_path / name).read_text() == aw_table(runs, "--format", style)[0]
    error = CliRunner().invoke(command, [str(runs), "-o", str(tmp_path / "t.pdf")]).exception
    assert isinstance(error, AwError) and "end the name in .txt, .md" in str(error)
    result = next(runs.rglob("metrics.json"))
    before = result.read_bytes()
    error = CliRunner().invoke(command, [str(runs), "--format", "csv", "-o", str(result)]).exception
    assert isinstance(error, AwError) and "no table" in str(error) and result.read_bytes() == before


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


def test_csv_is_clean_and_notes_go_to_standard_error(tmp_path: Path) -> None:
    save(tmp_path, fake_result("3dgs", psnr=(20.0, 21.0)), failed("c"))
    out, err = aw_table(tmp_path, "--format", "csv", "--metric", "psnr", "--only", "yard")
    frame = pd.read_csv(io.StringIO(out)).set_index("method")
    assert frame.loc["3dgs", "psnr"] == 20.5 and pd.isna(frame.loc["c", "psnr"])
    assert "failed: c on yard" in err
    assert f"aw table {tmp_path} --format csv --metric psnr --only yard" in err


def test_an_unknown_metric_names_others_and_a_sheet_is_a_picture(tmp_path: Path) -> None:
    runs = save(tmp_path / "runs", fake_result("3dgs"))
    sheet = tmp_path / "sheet.txt"
    for words, expected in (
        (["--metric", "nope"], "unknown metric 'nope': the nearest of "),
        (["--metric", "nope"], "'aw table RUNS' shows what was measured"),
        (["--sheet", str(sheet)], "ends in .png or .jpg"),
    ):
        error = CliRunner().invoke(command, [str(runs), *words]).exception
        assert isinstance(error, AwError) and expected in str(error)
    assert not sheet.exists()


@pytest.mark.parametrize(
    ("file", "message"), [("a.JPG", "holds photos, not runs"), ("scene.json", "is a scene, not runs")]
)
def test_a_folder_of_other_things_is_named(file: str, message: str, tmp_path: Path) -> None:
    (tmp_path / file).write_text("{}")
    error = CliRunner().invoke(command, [str(tmp_path)]).exception
    assert isinstance(error, AwError) and message in str(error) and f"-o {tmp_path}" not in str(error)


def test_errors_say_what_to_do(tmp_path: Path) -> None:
    runner = CliRunner()
    for words, expected in (
        ([str(tmp_path)], "aw bench"),
        ([str(tmp_path / "absent")], "no folder of runs"),
    ):
        error = runner.invoke(command, words).exception
        assert isinstance(error, AwError) and expected in str(error)


@pytest.mark.parametrize("style", ["text", "markdown", "latex", "html"])
@pytest.mark.parametrize("layout", ["paper", "means", "memory", "blocks"])
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
    words = ["--layout", "paper", "--dataset", "D=one,two", "--metric", "psnr", "--reported-from", tables]
    out, _ = aw_table(runs, *words)
    first, second = out.split("Porter\n", 1)
    assert "Famous" in first and "30.10" in first and "31.00" in first and "Famous" not in second
    assert f"--dataset D=one,two --reported-from {tables}" in out


def test_what_does_not_go_together_is_refused(tmp_path: Path) -> None:
    save(tmp_path, fake_result("3dgs"))
    for words, expected in (
        (["--reported"], "--layout paper"),
        (["--layout", "paper", "--dataset", "D"], "NAME=SCENE"),
        (["--layout", "ablation", "--only", "yard"], "--only does not go"),
        (["--layout", "ablation"], "aw ablate"),
    ):
        error = CliRunner().invoke(command, [str(tmp_path), *words]).exception
        assert isinstance(error, AwError) and expected in str(error)


def test_a_pipe_is_no_file_to_replace(tmp_path: Path) -> None:
    runs, pipe = save(tmp_path / "runs", fake_result("3dgs")), tmp_path / "p"
    os.mkfifo(pipe)
    done = CliRunner().invoke(command, [str(runs), "-o", str(pipe)])
    assert isinstance(done.exception, AwError) and "nobody reads" in str(done.exception) and pipe.is_fifo()
