"""Result files: checked both ways, infinity kept, what is unfinished listed."""

from __future__ import annotations

import copy
import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st

from ambiguous_wild.core import AwError
from ambiguous_wild.harness.measures import measure
from ambiguous_wild.harness.result_file import read_result, write_result
from ambiguous_wild.harness.store import read_runs
from tests.harness.fake_runs import failed, fake_result, save, start


@pytest.mark.parametrize(
    ("cost", "problem"),
    [
        ({"timing": None, "ms_parts": {"render": None, "loss": 2.0}}, None),
        ({"iterations": 7000.0, "render_s": 3, "of_a_plug_in": None}, None),  # as other programs write them
        ({"render_s": 10**400}, "out of range"),
        ({"render_s": "abc"}, "got `str`"),
        ({"gaussians": 10**400}, "cost.gaussians"),
    ],
)
def test_costs_that_other_programs_write(tmp_path: Path, cost: dict[str, Any], problem: str | None) -> None:
    result: dict[str, Any] = dict(fake_result("3dgs"))
    result["cost"] = result["cost"] | cost
    (tmp_path / "metrics.json").write_text(json.dumps(result))
    if problem is None:
        assert read_result(tmp_path / "metrics.json")["cost"]["iterations"] == result["cost"]["iterations"]
        return
    with pytest.raises(AwError, match=f"no result file.*{problem}"):
        read_result(tmp_path / "metrics.json")


def test_a_result_comes_back_as_it_was(tmp_path: Path) -> None:
    result = fake_result("3dgs", psnr=(20.5, math.inf), masks={"iou": 0.5, "recall": math.nan, "images": 3})
    before = copy.deepcopy(result)
    write_result(tmp_path / "metrics.json", result)
    assert result["per_image"] == before["per_image"]
    assert '"psnr": "inf"' in (tmp_path / "metrics.json").read_text()
    found = read_result(tmp_path / "metrics.json")
    assert [row["psnr"] for row in found["per_image"]] == [20.5, math.inf]
    assert found["per_image"][0]["lpips_alex"] is None
    assert found["masks"] == {"iou": 0.5, "recall": None, "images": 3}
    assert found["cost"] == before["cost"]


def test_numpy_numbers_are_written_as_numbers(tmp_path: Path) -> None:
    cost = {"fps": np.float32(2.5), "gaussians": np.int64(7), "train_s": np.float64(np.inf)}
    write_result(tmp_path / "m.json", fake_result("3dgs", cost=cost, facts={"on": np.bool_(True)}))
    found = read_result(tmp_path / "m.json")
    assert found["cost"] == {"fps": 2.5, "gaussians": 7, "train_s": math.inf}
    assert found["facts"] == {"on": True}


GLARE = {"label": "glare", "better": "lower", "digits": 2, "partial": False, "source": ""}


def test_a_metric_of_a_later_version_is_shown(tmp_path: Path) -> None:
    images = [{"name": "0.png", "glare_of_later": 3.0}]
    result = {
        **fake_result("3dgs", per_image=images),
        "metrics": {"glare_of_later": {**GLARE, "later": True}},
    }
    (tmp_path / "m.json").write_text(json.dumps(result))
    read_result(tmp_path / "m.json")
    assert measure("glare_of_later").better == "lower"


@given(st.floats(allow_nan=False))
def test_every_number_survives(value: float) -> None:
    import tempfile

    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "m.json"
        write_result(path, fake_result("3dgs", psnr=(value,)))
        assert read_result(path)["per_image"][0]["psnr"] == value


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"schema": 2}, "schema version 2"),
        ({"method": ""}, r"\$\.method"),
        ({"method": 3}, r"Expected `str`, got `int` - at `\$\.method`"),
        ({"seed": True}, r"\$\.seed"),
        ({"seed": "0"}, r"\$\.seed"),
        ({"status": "done"}, r"'done' - at `\$\.status`"),
        ({"status": "failed"}, "must say its error"),
        ({"per_image": [{"psnr": 3.0}]}, "missing required field `name`"),
        ({"per_image": [3]}, r"\$\.per_image\[0\]"),
        ({"per_image": [{"name": "a"}, {"name": "a"}]}, "is listed twice"),
        ({"per_image": [{"name": "a", "psnr": "high"}]}, r"got `str` - at `\$\.per_image\[0\]\.psnr"),
        ({"per_image": [{"name": "a", "psnr": True}]}, r"\.psnr`"),
        ({"per_image": [{"name": "a", "of_a_plugin": [1.0]}]}, "got `array`"),
        ({"missing": {"ssim": None}}, r"\$\.missing"),
        ({"masks": {"iou": "x"}}, r"\$\.masks\.iou"),
        ({"metrics": {"glare": {**GLARE, "digits": -1}}}, r"\.digits|metrics"),
        ({"cost": {"fps": "fast"}}, r"\$\.cost\.fps"),
        ({"cost": []}, r"\$\.cost"),
    ],
)
def test_a_wrong_field_is_named_in_writing_and_in_reading(
    change: dict[str, Any], words: str, tmp_path: Path
) -> None:
    path = tmp_path / "metrics.json"
    result = fake_result("3dgs") | change
    with pytest.raises(AwError, match=words):
        write_result(path, result)
    assert not path.exists()
    path.write_text(json.dumps(result))
    with pytest.raises(AwError, match=words) as caught:
        read_result(path)
    assert str(path) in str(caught.value)


def test_an_absent_field_is_named(tmp_path: Path) -> None:
    result = fake_result("3dgs")
    del result["scene_hash"]
    with pytest.raises(AwError, match="missing required field `scene_hash`"):
        write_result(tmp_path / "m.json", result)


@pytest.mark.parametrize(
    "text", ["", "{", "[]", "3", '{"schema": NaN}', "[" * 100_000, '{"a": "\ud800"}', "\x00", "twice"]
)
def test_a_damaged_file_is_named(text: str, tmp_path: Path) -> None:
    path = tmp_path / "metrics.json"
    if text == "twice":
        write_result(path, fake_result("3dgs"))
        text = path.read_text().replace("{", '{"seed": 7,', 1)
    path.write_bytes(text.encode("utf-8", "surrogatepass"))
    with pytest.raises(AwError, match=r"metrics\.json"):
        read_result(path)


def test_runs_are_tidy(tmp_path: Path) -> None:
    runs = read_runs(
        save(tmp_path, fake_result("3dgs", psnr=(20.0, 22.0)), fake_result("b", seed=1), failed("b", seed=2))
    )
    values = runs.images[(runs.images["method"] == "3dgs") & (runs.images["metric"] == "psnr")]
    assert dict(zip(values["image"], values["value"])) == {"0.png": 20.0, "1.png": 22.0}
    assert len(runs.images) == 2 * 2 * 3
    assert runs.images.loc[runs.images["metric"] == "lpips_alex", "value"].isna().all()
    row = runs.runs.set_index(["method", "seed"]).loc[("3dgs", 0)]
    assert (row["gaussians"], row["device"], row["images"], row["status"]) == (1234, "cpu", 2, "ok")
    assert list(runs.runs["status"]) == ["ok", "ok", "failed"]
    assert set(runs.missing["metric"]) == {"lpips_alex"} and len(runs.missing) == 2
    assert runs.incomplete == ()


def test_a_metric_that_one_image_lacks_has_a_row(tmp_path: Path) -> None:
    images = [{"name": "a", "psnr": 1.0, "ssim": 0.5}, {"name": "b", "psnr": 2.0}]
    runs = read_runs(save(tmp_path, fake_result("m", per_image=images, missing={})))
    ssim = runs.images[runs.images["metric"] == "ssim"]
    assert list(ssim["image"]) == ["a", "b"] and list(ssim["value"].isna()) == [False, True]


def test_unfinished_and_damaged_runs_are_listed(tmp_path: Path) -> None:
    save(tmp_path, fake_result("3dgs"))
    start(tmp_path, "b")
    # Settings that cannot be read: the path tells whose run it is.
    (start(tmp_path, "c") / "config.yaml").write_text("{")
    damaged = tmp_path / "yard" / "d" / "seed0" / "metrics.json"
    damaged.parent.mkdir(parents=True)
    damaged.write_text("{")
    start(tmp_path / ".cache", "hidden")
    runs = read_runs(tmp_path)
    assert [(i.method, i.scene) for i in runs.incomplete] == [("b", "yard"), ("c", "yard"), ("d", "yard")]
    assert "still running" in runs.incomplete[0].reason and "damaged" in runs.incomplete[2].reason
    assert all("again" in i.reason and "delete" not in i.reason for i in runs.incomplete)
    assert len(runs.runs) == 1


@pytest.mark.parametrize(
    "odd",
    [
        {"ssim": 2.5},
        {"psnr": -1.0},
        {"cost": {"train_s": -5.0}},
        {"masks": {"iou": 1.2}},
    ],
)
def test_numbers_that_no_measurement_gives_are_left_out_and_named(
    odd: dict[str, Any], tmp_path: Path
) -> None:
    save(tmp_path, fake_result("3dgs"), fake_result("b", seed=1))
    path = next(tmp_path.rglob("b/seed1/metrics.json"))
    data = json.loads(path.read_text())
    (data if {"cost", "masks"} & set(odd) else data["per_image"][0]).update(
        {k: {**(data[k] or {}), **v} if isinstance(v, dict) else v for k, v in odd.items()}
    )
    path.write_text(json.dumps(data))
    runs = read_runs(tmp_path)
    assert list(runs.runs["method"]) == ["3dgs"]
    assert "such a number" in runs.incomplete[0].reason and str(path) in runs.incomplete[0].reason


@pytest.mark.parametrize(
    ("config", "result", "why"),
    [
        ({"config_hash": "f" * 64}, {}, "hash of the settings"),
        ({"effects": ["skybox"]}, {"facts": {"effects": []}}, "effects is"),
        ({"start": {"sha256": "ab" * 32}}, {}, "start is"),
        ({"train": {"iterations": 900}}, {}, "iterations, config.yaml asks for 900"),
    ],
)
def test_results_that_contradict_their_settings_are_left_out(
    config: dict[str, Any], result: dict[str, Any], why: str, tmp_path: Path
) -> None:
    save(tmp_path, fake_result("3dgs"), fake_result("b") | result)
    (folder,) = (path.parent for path in tmp_path.rglob("b/seed0/metrics.json"))
    (folder / "config.yaml").write_text(yaml.safe_dump(config))
    runs = read_runs(tmp_path)
    assert list(runs.runs["method"]) == ["3dgs"] and why in runs.incomplete[0].reason


def test_one_start_under_two_names_is_one(tmp_path: Path) -> None:
    starts = [{"facts": {"start": f"{name}.ply (0123abcd)"}} for name in "ab"]
    save(tmp_path, *(fake_result("3dgs", seed=seed) | start for seed, start in enumerate(starts)))
    assert set(read_runs(tmp_path).runs["start"]) == {"a.ply (0123abcd)"}


def test_a_failed_run_counts_unless_it_was_finished_since(tmp_path: Path) -> None:
    save(tmp_path, failed("a"), failed("b"), fake_result("b"))
    assert (tmp_path / "yard" / "a" / "seed0" / "failed.json").exists()
    runs = read_runs(tmp_path)
    assert dict(zip(runs.runs["method"], runs.runs["status"])) == {"a": "failed", "b": "ok"}
    (tmp_path / "yard" / "a" / "seed0" / "failed.json").write_text("{")
    assert [i.method for i in read_runs(tmp_path).incomplete] == ["a"]


def test_names_of_folders_make_no_runs(tmp_path: Path) -> None:
    output = tmp_path / "seed7"  # -o seed7, and a scene called seed1
    save(output, fake_result("a", "seed1"), fake_result("b", "seed1"))
    start(output, "c", "seed1")
    (output / "seed1" / "d" / "seed0").mkdir(parents=True)
    runs = read_runs(output)
    assert list(runs.runs["method"]) == ["a", "b"] and [i.method for i in runs.incomplete] == ["c"]


def test_a_single_run_folder_can_be_read(tmp_path: Path) -> None:
    save(tmp_path, fake_result("3dgs"))
    assert len(read_runs(tmp_path / "yard" / "3dgs" / "seed0").runs) == 1


def test_two_results_for_one_cell_are_refused(tmp_path: Path) -> None:
    write_result(tmp_path / "one" / "metrics.json", fake_result("3dgs"))
    write_result(tmp_path / "two" / "metrics.json", fake_result("3dgs"))
    with pytest.raises(AwError, match="two results for method '3dgs' on scene 'yard' with seed 0") as copies:
        read_runs(tmp_path)
    assert "aw cost" not in str(copies.value)  # refuses copies too
    write_result(tmp_path / "two" / "metrics.json", fake_result("3dgs") | {"config_hash": "other"})
    with pytest.raises(AwError, match="'aw cost' takes both"):
        read_runs(tmp_path)


@pytest.mark.parametrize("field", ["environment", "code_hash", "reproduce"])
def test_a_field_that_older_results_lack_is_checked_where_it_is(field: str, tmp_path: Path) -> None:
    save(tmp_path, fake_result("old"))  # it has none of them
    assert len(read_runs(tmp_path).runs) == 1
    with pytest.raises(AwError, match=rf"at `\$\.{field}`"):
        save(tmp_path, fake_result("new", **{field: 7}))
