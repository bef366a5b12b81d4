"""A shorter run is continued, and masks corrected by hand act from then on."""

from __future__ import annotations

import base64
import json
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml

from ambiguous_wild import bench
from ambiguous_wild.core import AwError
from ambiguous_wild.harness.cell import RunOptions
from ambiguous_wild.harness.continued import as_continued, with_corrections
from ambiguous_wild.harness.grid import cell_folder, plan_cells
from ambiguous_wild.harness.job import make_cell, make_job
from ambiguous_wild.harness.replay import open_run
from ambiguous_wild.io.images import read_gray
from ambiguous_wild.io.mask_reasons import read_reasons
from ambiguous_wild.io.ply import splat_count
from ambiguous_wild.report.board_verify import verify
from ambiguous_wild.splat.train_config import TrainConfig
from tests.tiny_scene import HEIGHT, TRAIN, WIDTH

LEFT, RIGHT = slice(0, WIDTH // 2 - 4), slice(WIDTH // 2 + 4, WIDTH)


def correction(path: Path, pictures: dict[str, np.ndarray], **changed: object) -> Path:
    """Write corrections as the page does, from pictures [h, w] uint8."""
    texts = {
        name: "data:image/png;base64," + base64.b64encode(cv2.imencode(".png", picture)[1]).decode()
        for name, picture in pictures.items()
    }
    path.write_text(json.dumps({"version": 1, "scene": "scene", "photos": texts} | changed))
    return path


def halves() -> np.ndarray:
    """Left half masked, right half static; at half the size of the photo."""
    picture = np.zeros((HEIGHT // 2, WIDTH // 2), np.uint8)
    picture[:, WIDTH // 4 :] = 255
    return picture


def run(scene: Path, output: Path, method: str = "3dgs", **options):
    words = {"device": "cpu", "pictures": False, "effects": "none", "threads": 1, "train": {"probes": 0}}
    return bench(method, scene, output=output, **(words | options))


def test_a_shorter_run_goes_on_and_says_so(scene, tmp_path):
    out = tmp_path / "runs"
    folder = run(scene, out, iterations=6).runs[0].folder
    (folder / "mine.txt").write_text("a note")
    with pytest.raises(AwError, match=r"train\.iterations was 6, is 9\).*it with --overwrite longer"):
        run(scene, out, iterations=9)
    with pytest.raises(AwError, match=r"train\.iterations was 6, is 3\); choose another -o, or replace"):
        run(scene, out, iterations=3)
    report = run(scene, out, iterations=9, overwrite="longer")
    assert report.outcomes == {"trained": 1}
    assert "going on after 6 iterations" in (folder / "log.txt").read_text()
    result, config = report.runs[0].result, yaml.safe_load((folder / "config.yaml").read_text())
    assert result["cost"]["iterations"] == 9 and [c["iteration"] for c in config["continued"]] == [6]
    assert result["facts"]["length"] == "6 iterations, continued to 9 iterations"
    assert len((folder / "timeline.csv").read_text().splitlines()) > 6
    assert (folder / "mine.txt").exists() and splat_count(folder / "point_cloud.ply") > 0
    # as long or shorter: kept; still longer: goes on; and it is another run than one that never stopped
    for shorter in (9, 5):
        assert run(scene, out, iterations=shorter, overwrite="longer").outcomes == {"kept": 1}
    assert run(scene, out, iterations=11, overwrite="longer").outcomes == {"trained": 1}
    with pytest.raises(AwError, match=r"\(it went on from a shorter one\)"):
        run(scene, out, iterations=11)
    with pytest.raises(AwError, match="was continued from a shorter run"):
        verify(folder, None)
    with pytest.raises(AwError, match=r"train.max_gaussians was None, is 500"):
        run(scene, out, iterations=11, overwrite="longer", train={"max_gaussians": 500, "probes": 0})
    with pytest.raises(AwError, match="effects was"):  # other settings are no continuation
        run(scene, out, iterations=20, overwrite="longer", effects="exposure")


def test_an_interrupted_continuation_is_resumed(scene, tmp_path, monkeypatch):
    from ambiguous_wild.splat.trainer import Trainer

    out = tmp_path / "runs"
    folder = run(scene, out, iterations=4).runs[0].folder
    step = Trainer.step

    def fails(trainer):
        if trainer.iteration == 6:
            raise OSError("the disk is gone")
        return step(trainer)

    monkeypatch.setattr(Trainer, "step", fails)
    assert run(scene, out, iterations=8, overwrite="longer").outcomes == {"failed": 1}
    assert not (folder / "metrics.json").exists()
    monkeypatch.setattr(Trainer, "step", step)
    report = run(scene, out, iterations=8, overwrite="longer")
    assert report.outcomes == {"trained": 1} and report.runs[0].result["cost"]["iterations"] == 8


def test_a_continuation_travels_to_another_process(scene, tmp_path):
    out = tmp_path / "runs"
    run(scene, out, iterations=3)
    (cell,) = plan_cells(["3dgs"], [scene], [0], TrainConfig(iterations=5, probes=0))
    cell = as_continued(cell, cell_folder(out, cell))
    there = make_cell(make_job(cell, tmp_path / "run", RunOptions(tmp_path)))
    assert there.continued == cell.continued != () and there.identity == cell.identity


def test_corrections_decide_what_is_masked(scene, tmp_path):
    out, name = tmp_path / "runs", TRAIN[2]
    file = correction(tmp_path / "mine.json", {name: halves()})
    masked = "3dgs@mask=truth"  # its masks are known: a square in every photo
    folder = run(scene, out, masked, iterations=4).runs[0].folder
    before = read_gray(folder / "masks" / name)
    assert (before[:, RIGHT] == 0).any() or (before[:, LEFT] == 0).any()
    with pytest.raises(AwError, match="none is left in which the corrections could act"):
        run(scene, out, masked, iterations=4, overwrite="longer", corrections=file)
    report = run(scene, out, masked, iterations=6, overwrite="longer", corrections=file)
    assert report.outcomes == {"trained": 1}
    after = read_gray(folder / "masks" / name)
    assert (after[:, LEFT] == 0).all() and (after[:, RIGHT] == 255).all()
    reasons = read_reasons(folder / "reasons.json")
    sentences = [reasons[name].at(column, 20) for column in (4, WIDTH - 4)]
    assert sentences == ["masked: by hand", "kept: by hand"]
    other = [read_gray(folder / "masks" / n) for n in TRAIN if n != name]
    assert all((mask == 255).any() and (mask == 0).any() for mask in other)
    # the run holds its corrections, and longer ones keep them
    file.unlink()
    trainer = open_run(folder)
    step = trainer.make_step(6, 2, downsampling=1)
    keep = trainer.combine_user_keep(step, trainer.hooks.mask.predict(step)).numpy()
    assert not keep[:, LEFT].any() and keep[:, RIGHT].all()
    report = run(scene, out, masked, iterations=8, overwrite="longer")
    assert report.outcomes == {"trained": 1} and "by hand" in report.runs[0].result["facts"]["corrections"]
    assert (read_gray(folder / "masks" / name)[:, LEFT] == 0).all()


@pytest.mark.parametrize(
    ("photos", "changed", "message"),
    [
        ({"nowhere.png": halves()}, {}, "nowhere.png"),
        ({}, {}, "corrects no photo"),
        ({TRAIN[0]: halves()}, {"scene": "garden"}, "corrects scene 'garden', not 'scene'"),
        ({TRAIN[0]: halves()}, {"version": 9}, "no corrections of version 1"),
        ({TRAIN[0]: np.zeros((9, 99), np.uint8)}, {}, "is 99x9 px, the photo 64x48"),
        ({}, {"photos": {TRAIN[0]: "data:image/png;base64,AAAA"}}, "is no whole PNG"),
        ({}, {"photos": {TRAIN[0]: 3}}, "is no whole PNG"),
        ({}, {"photos": {TRAIN[0]: "data:image/png;base64,é"}}, "is no whole PNG"),
        ({}, {"photos": [1]}, "no corrections of version 1"),
    ],
)
def test_corrections_that_cannot_be_used_are_refused(scene, tmp_path, photos, changed, message):
    file = correction(tmp_path / "bad.json", photos, **changed)
    with pytest.raises(AwError, match=message):
        run(scene, tmp_path / "runs", iterations=2, corrections=file)
    assert not (tmp_path / "runs").exists()
    cells = plan_cells(["3dgs"], [scene], [0], TrainConfig(iterations=2))
    (tmp_path / "text.json").write_text("[")
    with pytest.raises(AwError, match="is no JSON"):
        with_corrections(cells, tmp_path / "text.json")
    with pytest.raises(AwError, match="cannot read"):
        with_corrections(cells, tmp_path / "absent.json")
