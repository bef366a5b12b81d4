"""Metrics added to finished runs: only where renders, photos and settings are those of the result."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from click.testing import CliRunner

from ambiguous_wild.cli.table import rescore_command as command
from ambiguous_wild.core import AwError
from ambiguous_wild.harness import benchmark as bench_module
from ambiguous_wild.harness import evaluate
from ambiguous_wild.harness.benchmark import Callbacks, bench
from ambiguous_wild.harness.measures import ImageRow, measure_images, metrics
from ambiguous_wild.harness.result_file import metrics_of, read_result
from ambiguous_wild.harness.store import computable_metrics
from ambiguous_wild.io.images import read_png_rgb, write_png
from ambiguous_wild.metrics import lpips
from ambiguous_wild.report.rescore import rescore
from tests.report.board_runs import write_run
from tests.tiny_scene import write_tiny_scene


@pytest.fixture
def weights(monkeypatch: pytest.MonkeyPatch) -> None:
    """Weights that came later: a network of the test's own stands in for AlexNet."""

    def load(name: str) -> lpips.Metric:
        if name != "lpips_alex":
            raise AwError("no weights")
        return lambda a, b: float(np.abs(a.astype(float) - b).mean())

    monkeypatch.setattr(lpips, "available", lambda: {"lpips_alex": None, "lpips_vgg": "no weights"})
    monkeypatch.setattr(lpips, "load", load)


@pytest.fixture
def scene(tmp_path: Path) -> Path:
    return write_tiny_scene(tmp_path / "scene")


def test_what_was_missing_is_measured_from_the_pictures(tmp_path: Path, scene: Path, weights: None) -> None:
    run = write_run(tmp_path / "runs", scene)
    before = read_result(run / "metrics.json")
    (found,) = rescore([tmp_path / "runs"])
    assert found.outcome == "rescored" and "lpips_alex" in found.added and "lpips_vgg" not in found.added
    after = read_result(run / "metrics.json")
    for row in after["per_image"]:
        drawn = read_png_rgb((run / "renders" / "test" / row["name"]).with_suffix(".png"))
        photo = read_png_rgb(scene / "images" / row["name"])
        assert row["lpips_alex"] == pytest.approx(np.abs(drawn.astype(float) - photo).mean())
    assert "lpips_alex" not in after["missing"]
    (record,) = after["rescored"]
    assert set(record["metrics"]) == set(found.added) and len(record["code_hash"]) == 64
    for key in ("cost", "config_hash", "scene_hash", "facts", "options", "seed"):
        assert after[key] == before[key]  # type: ignore[literal-required]
    old = [{k: row[k] for k in was} for row, was in zip(after["per_image"], before["per_image"])]  # type: ignore[literal-required]
    assert old == before["per_image"]
    text = (run / "metrics.json").read_bytes()
    assert [r.outcome for r in rescore([tmp_path / "runs", run])] == ["complete"]
    assert (run / "metrics.json").read_bytes() == text


def test_without_weights_nothing_is_written(
    tmp_path: Path, scene: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(lpips, "why_unavailable", lambda backbone: "weights missing")
    run = write_run(tmp_path / "runs", scene)
    rescore([run])  # the regions of the scene are added
    text = (run / "metrics.json").read_bytes()
    (found,) = rescore([run])
    assert found.outcome == "complete" and "lpips_alex" in found.missing
    assert (run / "metrics.json").read_bytes() == text


def change_render(run: Path, scene: Path) -> None:
    path = next((run / "renders" / "test").glob("*.png"))
    write_png(path, 255 - read_png_rgb(path))


def change_photo(run: Path, scene: Path) -> None:
    path = scene / "images" / "test_0.png"
    write_png(path, 255 - read_png_rgb(path))


def change_config(run: Path, scene: Path) -> None:
    path = run / "config.yaml"
    path.write_text(path.read_text().replace("iterations: 100", "iterations: 900"))


def change_number(run: Path, scene: Path) -> None:
    data = json.loads((run / "metrics.json").read_text())
    data["per_image"][0]["psnr"] += 1.0
    (run / "metrics.json").write_text(json.dumps(data))


def lose_render(run: Path, scene: Path) -> None:
    next((run / "renders" / "test").glob("*.png")).unlink()


def lose_scene(run: Path, scene: Path) -> None:
    shutil.rmtree(scene)


def name_a_file_outside(run: Path, scene: Path) -> None:
    data = json.loads((run / "metrics.json").read_text())
    data["per_image"][0]["name"] = "../../../x.png"
    (run / "metrics.json").write_text(json.dumps(data))


@pytest.mark.parametrize(
    "change",
    [change_render, change_photo, change_config, change_number, lose_render, lose_scene, name_a_file_outside],
    ids=lambda change: change.__name__,
)
def test_a_run_whose_files_were_changed_is_refused(
    change, tmp_path: Path, scene: Path, weights: None
) -> None:
    run = write_run(tmp_path / "runs", scene)
    change(run, scene)
    text = (run / "metrics.json").read_bytes()
    (found,) = rescore([tmp_path / "runs"])
    assert found.outcome == "refused" and found.error and "\n" not in found.error
    assert (run / "metrics.json").read_bytes() == text


def test_a_scene_that_moved_can_be_named(tmp_path: Path, scene: Path, weights: None) -> None:
    write_run(tmp_path / "runs", scene)
    scene.rename(tmp_path / "moved")
    assert [r.outcome for r in rescore([tmp_path / "runs"])] == ["refused"]
    assert [r.outcome for r in rescore([tmp_path / "runs"], scene=tmp_path / "moved")] == ["rescored"]


def test_the_command_tells_each_run_and_fails_where_one_is_refused(
    tmp_path: Path, scene: Path, weights: None
) -> None:
    runs = tmp_path / "runs"
    write_run(runs, scene, seed=0)
    change_render(write_run(runs, scene, seed=1), scene)
    done = CliRunner().invoke(command, [str(runs)])
    assert isinstance(done.exception, AwError) and "1 of 2 runs refused" in str(done.exception)
    assert "added" in done.output and "lpips_alex" in done.output
    (empty := tmp_path / "empty").mkdir()
    photos = scene / "images"
    for folder, words in (
        (empty, "no run in"),
        (photos, "holds photos"),
        (tmp_path / "absent", "no folder of runs"),
    ):
        error = CliRunner().invoke(command, [str(folder)]).exception
        assert isinstance(error, AwError) and words in str(error)


class Said(Callbacks):
    def __init__(self) -> None:
        self.lines: list[str] = []

    def say(self, text: str) -> None:
        self.lines.append(text)


def test_bench_says_that_kept_runs_could_be_rescored(
    tmp_path: Path, scene: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    words = {
        "iterations": 3,
        "device": "cpu",
        "pictures": False,
        "train": {"probes": 0},
        "output": tmp_path / "runs",
    }
    missing = {"lpips_alex": "weights missing"}
    monkeypatch.setattr(lpips, "available", lambda: missing)
    bench("3dgs", scene, **words)
    said = Said()
    bench("3dgs", scene, callbacks=said, **words)
    assert not any("aw rescore" in line for line in said.lines)
    monkeypatch.setattr(lpips, "available", lambda: {"lpips_alex": None})
    (again := Said()).say("")
    report = bench("3dgs", scene, callbacks=again, **words)
    assert f"lack lpips_alex, which can be measured now: aw rescore {tmp_path / 'runs'}" in again.lines[-1]
    assert computable_metrics([report.runs[0].result]) == ["lpips_alex"]
    assert bench_module._rescore_hint(report)


def measured_lpips(sizes: list[tuple[int, int]], half: bool = False) -> tuple[list[ImageRow], dict[str, str]]:
    """LPIPS of pictures of these sizes."""
    pictures = [(str(k), np.zeros((h, w, 3), np.uint8)) for k, (h, w) in enumerate(sizes)]
    scene = SimpleNamespace(test=[SimpleNamespace(name=name) for name, _ in pictures])
    asked = [metric for key, metric in metrics().items() if key in lpips.VARIANTS]
    given = [(name, image, image) for name, image in pictures]
    return measure_images(given, asked, scene, half=half, around=evaluate.kernel_threads)


def test_photos_too_small_for_a_network_leave_it_out(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(lpips, "why_unavailable", lambda backbone: None)
    monkeypatch.setattr(lpips, "network_of", lambda backbone, stamps: (None, None))
    monkeypatch.setattr(lpips, "distance", lambda *given: 0.5)
    rows, missing = measured_lpips([(40, 40), (12, 20)])
    assert [set(row) for row in rows] == [{"name"}, {"name"}] and set(missing) == set(lpips.VARIANTS)
    assert all(lpips.TOO_SMALL in why and "20x12 px" in why for why in missing.values())
    assert set(measured_lpips([(40, 41)])[0][0]) == {"name", *lpips.VARIANTS}
    rows, missing = measured_lpips([(40, 41)], half=True)
    assert set(rows[0]) == {"name", "lpips_vgg", "lpips_vgg_01"} and "21x40 px" in missing["lpips_alex"]


def test_what_is_too_small_is_no_case_for_rescore(tmp_path: Path, scene: Path, weights: None) -> None:
    result = read_result(write_run(tmp_path / "runs", scene) / "metrics.json")
    assert "lpips_alex" in computable_metrics([result])
    result["missing"]["lpips_alex"] = f"image of 20x12 px is {lpips.TOO_SMALL} with alexnet: ..."
    assert "lpips_alex" not in computable_metrics([result])


def test_networks_use_the_threads_of_the_kernels_and_give_them_back(monkeypatch: pytest.MonkeyPatch) -> None:
    import torch

    used: list[int] = []
    monkeypatch.setattr(lpips, "load", lambda name: lambda a, b: used.append(torch.get_num_threads()) or 0.5)
    monkeypatch.setattr(evaluate, "threads", lambda: 2)
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        assert metrics_of(measured_lpips([(40, 40)])[0][0])["lpips_alex"] == 0.5
        assert used == [2, 2, 2] and torch.get_num_threads() == 1
    finally:
        torch.set_num_threads(before)
