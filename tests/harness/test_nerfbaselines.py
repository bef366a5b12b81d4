"""NerfBaselines as a method: a stand-in for its command line that writes the files of version 1.2.12.

Where the real one is installed (AW_NERFBASELINES), the last test runs it with a method of its own.
"""

import json
import os
import sys
import textwrap

import numpy as np
import pytest

from ambiguous_wild.core import AwError
from ambiguous_wild.harness.grid import plan_cells, run_cells
from ambiguous_wild.io.images import read_png_rgb
from ambiguous_wild.methods import nerfbaselines_methods, registry
from ambiguous_wild.splat.train_config import TrainConfig
from tests.tiny_scene import TEST, TRAIN, write_tiny_scene

SHORT = TrainConfig(iterations=5)
STAND_IN = """#!{python}
import io, json, os, sys, tarfile
from pathlib import Path

words = sys.argv[1:]
with open({calls!r}, "a") as f:
    f.write(json.dumps(words) + "\\n")
value = {{a: b for a, b in zip(words, words[1:]) if a.startswith("--")}}
if words[0] == "train":
    if os.environ.get("STAND_IN") == "broken":
        sys.exit("no such method")
    folder = Path(value["--output"]) / "checkpoint-5"
    folder.mkdir(parents=True)
    info = {{"method": value["--method"], "nb_version": "1.2.12", "num_iterations": 5, "applied_presets": [],
            "total_train_time": 2.5, "resources_utilization": {{"memory": 61, "gpu_memory": 99}}}}
    (folder / "nb-info.json").write_text(json.dumps(info))
elif words[0] == "render":
    assert (Path(value["--checkpoint"]) / "nb-info.json").is_file() and value["--split"] == "test"
    data = Path(value["--data"])
    test = (data / "test_list.txt").read_text().split()
    photo = sorted((data / "images").glob("train*"))[0].read_bytes()
    with tarfile.open(value["--output"], "w:gz") as tar:
        def add(name, content):
            member = tarfile.TarInfo(name)
            member.size = len(content)
            tar.addfile(member, io.BytesIO(content))
        add("info.json", b"{{}}")
        for name in test[: 1 if os.environ.get("STAND_IN") == "short" else None]:
            add("gt-color/" + name, (data / "images" / name).read_bytes())
            add("color/" + name, photo)
        if os.environ.get("STAND_IN") == "hostile":
            add("color/../../../out.png", photo)
elif words[0] == "evaluate":
    Path(value["--output"]).write_text(json.dumps({{"metrics": {{"psnr": 12.34567}}, "metrics_raw": {{}}}}))
"""


@pytest.fixture
def calls(tmp_path, monkeypatch):
    """Installs the stand-in; returns a function that reads what it was called with."""
    program, log = tmp_path / "nerfbaselines", tmp_path / "calls"
    program.write_text(STAND_IN.format(python=sys.executable, calls=str(log)))
    program.chmod(0o755)
    monkeypatch.setenv(nerfbaselines_methods.PROGRAM, str(program))
    return lambda: [json.loads(line) for line in log.read_text().splitlines()]


def run(scene, output, method="nerfbaselines:splat", **kw):
    (cell,) = plan_cells([method], [scene], [4], SHORT, **kw)
    (report,) = run_cells([cell], output)
    return report


def test_its_renders_are_measured_as_ours_and_its_costs_kept(scene, calls, tmp_path):
    settings = ["iterations_key=iterations", "seed_key=seed", "evaluate=true", "overrides=a.b=1,c=x"]
    settings += ["backend=python", "presets=large,late"]
    report = run(scene, tmp_path / "runs", settings=[f"nerfbaselines-splat.{s}" for s in settings])
    assert report.outcome == "trained", report.error
    assert report.folder == tmp_path / "runs/scene/nerfbaselines-splat/seed4"
    photo = read_png_rgb(scene / "images" / TRAIN[0])
    for name in TEST:
        assert np.array_equal(read_png_rgb(report.folder / "renders/test" / name), photo)
    result = report.result
    assert [row["name"] for row in result["per_image"]] == TEST
    expected = {
        "train_s": 2.5,
        "iterations": 5,
        "ms_per_iteration": 500.0,
        "peak_rss_mb": 61,
        "peak_gpu_mb": 99,
    }
    assert result["cost"].items() >= expected.items()
    assert result["facts"]["reported"] == {"psnr": 12.34567}
    assert result["facts"]["nerfbaselines"] == "1.2.12" and result["facts"]["not_told"] == []
    train, render, evaluate = calls()
    pairs = [train[i + 1] for i, word in enumerate(train) if word == "--set"]
    assert pairs == ["a.b=1", "c=x", "iterations=5", "seed=4"]
    assert train[train.index("--data") + 1] == str(scene)
    assert train[train.index("--presets") + 1] == "large,late"
    assert train[-2:] == render[-2:] == ["--backend", "python"]
    assert evaluate[0] == "evaluate"
    assert (
        run(scene, tmp_path / "runs", settings=[f"nerfbaselines-splat.{s}" for s in settings]).outcome
        == "kept"
    )


def test_what_it_is_not_told_is_said_and_what_is_done_is_not_done_again(scene, calls, tmp_path, monkeypatch):
    monkeypatch.setenv("STAND_IN", "short")
    report = run(scene, tmp_path / "runs")
    assert "has no render of 1 of 2 test photos: test_1.png" in report.error
    monkeypatch.delenv("STAND_IN")
    (report.folder / "external/predictions.tar.gz").unlink()
    report = run(scene, tmp_path / "runs")
    assert report.outcome == "trained", report.error
    assert [words[0] for words in calls()] == ["train", "render", "render"]
    assert report.result["facts"]["not_told"] == ["iterations", "seed"]
    assert report.result["facts"]["reported"] is None


def test_a_hostile_archive_and_a_failure(scene, calls, tmp_path, monkeypatch):
    monkeypatch.setenv("STAND_IN", "hostile")
    assert "leads out of the folder" in run(scene, tmp_path / "a").error
    assert not list(tmp_path.rglob("out.png"))
    monkeypatch.setenv("STAND_IN", "broken")
    report = run(scene, tmp_path / "b")
    assert "nerfbaselines train of splat ended with exit code 1" in report.error
    assert "no such method" in report.error


def test_a_factor_that_it_would_not_load_is_refused(calls, tmp_path):
    scene = write_tiny_scene(tmp_path / "scene")
    info = {"loader": "colmap", "loader_kwargs": {"images_path": "images_8"}}
    (scene / "nb-info.json").write_text(json.dumps(info))
    report = run(scene, tmp_path / "runs", factor=1)
    assert "at factor 8 (its nb-info.json), not 1: run with --factor 8" in report.error


def test_where_it_is_not_there_the_commands_are_said(monkeypatch):
    monkeypatch.setenv(nerfbaselines_methods.PROGRAM, "")
    monkeypatch.setenv("PATH", "")
    with pytest.raises(AwError, match=r"numpy<2.*export AW_NERFBASELINES=") as error:
        registry.get_method("nerfbaselines:splat")
    assert "\n" not in str(error.value)
    monkeypatch.setenv(nerfbaselines_methods.PROGRAM, "/nowhere/nerfbaselines")
    with pytest.raises(AwError, match="which is no program"):
        registry.get_method("nerfbaselines:splat")


NEAREST = """
import os
import numpy as np

class Nearest:
    INFO = dict(method_id="nearest-photo", required_features=frozenset(("color",)),
                supported_camera_models=frozenset(("pinhole",)), supported_outputs=("color",))

    def __init__(self, *, checkpoint=None, train_dataset=None, config_overrides=None):
        self.n, self.checkpoint = int((config_overrides or {}).get("iterations", 3)), checkpoint
        if checkpoint is not None:
            data = np.load(os.path.join(checkpoint, "photos.npz"))
            self.poses, self.images = data["poses"], data["images"]
        else:
            self.poses = train_dataset["cameras"].poses
            self.images = np.stack([image[..., :3] for image in train_dataset["images"]])

    @classmethod
    def get_method_info(cls):
        return dict(cls.INFO)

    def get_info(self):
        facts = {"num_iterations": self.n, "loaded_step": None, "loaded_checkpoint": self.checkpoint}
        return dict(self.INFO, hparams={}, **facts)

    def train_iteration(self, step):
        return {"loss": 0.0}

    def save(self, path):
        np.savez(os.path.join(path, "photos.npz"), poses=self.poses, images=self.images)

    def render(self, camera, *, options=None):
        away = np.linalg.norm(self.poses[:, :3, 3] - camera.item().poses[:3, 3], axis=1)
        return {"color": self.images[int(away.argmin())].astype(np.float32) / 255}
"""
SPEC = """
from nerfbaselines import register
register(dict(id="nearest-photo", method_class="nearest_photo:Nearest", backends_order=["python"], presets={},
              required_features=frozenset(("color",)), supported_camera_models=frozenset(("pinhole",)),
              supported_outputs=("color",), metadata={}))
"""


@pytest.mark.skipif(nerfbaselines_methods.PROGRAM not in os.environ, reason="NerfBaselines is not installed")
def test_the_real_one_with_a_method_of_its_own(scene, tmp_path, monkeypatch):
    (tmp_path / "nearest_photo.py").write_text(textwrap.dedent(NEAREST))
    (tmp_path / "nearest_spec.py").write_text(textwrap.dedent(SPEC))
    monkeypatch.setenv("NERFBASELINES_REGISTER", str(tmp_path / "nearest_spec.py"))
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    settings = [
        "nerfbaselines-nearest-photo.backend=python",
        "nerfbaselines-nearest-photo.iterations_key=iterations",
    ]
    report = run(scene, tmp_path / "runs", "nerfbaselines:nearest-photo", settings=settings)
    assert report.outcome == "trained", report.error
    photos = [read_png_rgb(scene / "images" / name) for name in TRAIN]
    for name in TEST:
        drawn = read_png_rgb(report.folder / "renders/test" / name)
        assert any(np.array_equal(drawn, photo) for photo in photos)
    assert report.result["cost"]["iterations"] == 5
