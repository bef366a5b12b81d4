"""All results as one tidy table, and `aw table --format tidy`."""

from __future__ import annotations

import io
from pathlib import Path

import pandas as pd
import pytest
from click.testing import CliRunner

from ambiguous_wild.cli.table import table_command as command
from ambiguous_wild.core import AwError
from ambiguous_wild.harness.store import read_runs
from ambiguous_wild.report.comparison import COLUMNS, tidy
from ambiguous_wild.report.plain_formats import to_csv
from tests.harness.fake_runs import failed, fake_result, save, start


def test_one_row_a_method_scene_seed_image_and_metric(tmp_path: Path) -> None:
    save(tmp_path, fake_result("a"), fake_result("a", seed=1), failed("b"))
    frame = tidy(read_runs(tmp_path))
    assert tuple(frame.columns) == COLUMNS
    assert not frame.duplicated(["scene", "method", "seed", "image", "metric"]).any()
    first = frame[(frame["method"] == "a") & (frame["seed"] == 0)].set_index(["image", "metric"])
    assert first.loc[("1.png", "psnr"), "value"] == 22.0
    assert first.loc[("1.png", "psnr"), "better"] == "higher" and not first.loc[("1.png", "psnr"), "reason"]
    assert first.loc[("", "train_s"), "value"] == 10.0 and first.loc[("", "train_s"), "better"] == "lower"
    gap = first.loc[("0.png", "lpips_alex")]
    assert pd.isna(gap["value"]) and gap["reason"].startswith("weights missing")
    (lost,) = frame[frame["method"] == "b"].itertuples()
    assert (lost.metric, lost.reason) == ("failed", "loss is not finite") and pd.isna(lost.value)


def test_a_metric_of_a_part_of_the_picture_has_no_row_where_there_is_no_such_part(tmp_path: Path) -> None:
    images = [{"name": "a", "psnr": 1.0, "psnr_covered": 9.0}, {"name": "b", "psnr": 2.0}]
    runs = read_runs(save(tmp_path, fake_result("m", per_image=images, missing={"psnr_valid": "no masks"})))
    frame = tidy(runs)
    assert list(frame[frame["metric"] == "psnr_covered"]["image"]) == ["a"]
    (gone,) = frame[frame["metric"] == "psnr_valid"].itertuples()
    assert gone.reason == "no masks" and not gone.image


def test_csv_keeps_infinity(tmp_path: Path) -> None:
    save(tmp_path, fake_result("a", psnr=(float("inf"), 20.0)))
    frame = tidy(read_runs(tmp_path))
    text = to_csv(list(frame.columns), frame.itertuples(index=False, name=None))
    back = pd.read_csv(io.StringIO(text), keep_default_na=False)
    assert "inf" in set(back[back["metric"] == "psnr"]["value"].astype(str))


def test_the_command_writes_it_and_names_what_is_not_there(tmp_path: Path) -> None:
    save(tmp_path, fake_result("a"), fake_result("a", scene="hall"))
    start(tmp_path, "c")
    out = tmp_path / "all.csv"
    words = [str(tmp_path), "--format", "tidy", "--metric", "psnr", "--only", "hall", "-o", str(out)]
    done = CliRunner().invoke(command, words, catch_exceptions=False)
    assert "wrote" in done.stderr and "incomplete" in done.stderr
    back = pd.read_csv(out)
    assert set(back["scene"]) == {"hall"} and list(back["value"]) == [20.0, 22.0]
    error = CliRunner().invoke(command, [str(tmp_path), "--format", "tidy", "--metric", "pnsr"]).exception
    assert isinstance(error, AwError) and "did you mean 'psnr'" in str(error)


def test_nothing_but_unfinished_runs_is_an_empty_table(tmp_path: Path) -> None:
    start(tmp_path, "c")
    assert len(tidy(read_runs(tmp_path))) == 0
    with pytest.raises(AwError):
        tidy(read_runs(tmp_path), metrics=["psnr"])
