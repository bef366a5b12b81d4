"""`aw bench --start`: from points and splats in the user's coordinates, as part of what a run is."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from ambiguous_wild import bench
from ambiguous_wild.core import AwError, SparsePoints
from ambiguous_wild.harness.benchmark import Callbacks
from ambiguous_wild.harness.cell import RunOptions, reproduce_command
from ambiguous_wild.harness.grid import plan_cells
from ambiguous_wild.harness.job import make_cell, make_job
from ambiguous_wild.harness.start import start_file, with_start
from ambiguous_wild.io.ply import write_point_ply
from ambiguous_wild.io.scene_folder import load_scene
from ambiguous_wild.io.splat_files import FORMATS, write_splats
from ambiguous_wild.metrics.image import psnr
from ambiguous_wild.report.notes import unequal
from ambiguous_wild.splat.gaussians import Gaussians
from ambiguous_wild.splat.method_hooks import START_SHARE, MethodHooks
from ambiguous_wild.splat.train_config import TrainConfig
from ambiguous_wild.viewing.model import Renderer, RenderSettings
from tests.io.test_scene_transform import UTM, moved
from tests.viewing.wall_runs import wall_model

Words = dict[str, object]


class Heard(Callbacks):
    def __init__(self) -> None:
        self.lines: list[str] = []
        self.starts: list[int] = []

    def say(self, text: str) -> None:
        self.lines.append(text)

    def tick(self, trainer) -> None:
        self.starts.append(trainer.run_schedule.start)


def wall_points(path: Path, count: int, shift: float | np.ndarray = 0.0) -> Path:
    wall = wall_model(count)
    write_point_ply(path, wall["means"] + shift, np.full((count, 3), 99, np.uint8))
    return path


def small(scene: Path, output: Path, **options):
    words: Words = {"iterations": 3, "device": "cpu", "pictures": False, "effects": "none", "threads": 1}
    return bench("3dgs", scene, output=output, train={"probes": 0}, **(words | options))


def test_a_run_starts_from_points_thinned_to_what_it_may_hold_and_is_another_run(scene, tmp_path):
    dense, heard = wall_points(tmp_path / "dense.ply", 20_000), Heard()
    report = small(scene, tmp_path / "runs", start=dense, callbacks=heard)
    assert report.outcomes == {"trained": 1}
    (line,) = (line for line in heard.lines if "starts from" in line)
    kept = heard.starts[0]
    assert f"3dgs starts from {kept:,} of the 20,000 points of dense.ply, chosen at random" in line
    assert 400 < kept < 20_000 * START_SHARE and f"have {round(kept / START_SHARE):,}"[:-2] in line
    result = json.loads((report.runs[0].folder / "metrics.json").read_text())
    assert result["facts"]["start"].startswith("dense.ply (")

    # it is kept by the same start wherever the file lies, and not by another one, nor without
    elsewhere = tmp_path / "copy.ply"
    elsewhere.write_bytes(dense.read_bytes())
    assert small(scene, tmp_path / "runs", start=elsewhere).outcomes == {"kept": 1}
    other = wall_points(tmp_path / "dense.ply", 3000)
    for start in (other, None):
        with pytest.raises(AwError, match=r"another configuration \(start"):
            small(scene, tmp_path / "runs", start=start)
    bench("refinesplat", scene, output=tmp_path / "runs", iterations=3, device="cpu", effects="none")
    runs = report.read().runs
    assert any("starts differ" in line and "dense.ply" in line for line in unequal(runs))


@pytest.mark.parametrize(("shift", "scale"), [(np.zeros(3), 1.0), (np.zeros(3), 1e-3), (UTM, 3.0)])
@pytest.mark.parametrize("kind", ["points", "ply", "spz"])
def test_a_start_is_in_the_coordinates_of_the_files(tmp_path, kind, shift, scale):
    scene = load_scene(moved(tmp_path / "scene", shift, scale))
    wall, path = wall_model(2500), tmp_path / f"start.{kind}"
    true = wall["means"].astype(np.float64) * scale + shift
    inner = (true - scene.transform.centre) * scene.transform.scale
    sizes = wall["log_scales"] + np.float32(np.log(scale * scene.transform.scale))
    arrays = {**wall, "means": inner.astype(np.float32), "log_scales": sizes}
    if kind == "points":
        write_point_ply(path, true, np.zeros((2500, 3), np.uint8))
        xyz, _ = with_start(MethodHooks(), start_file(path), scene).user_start
        np.testing.assert_allclose(xyz, inner, atol=1e-3)
        return
    write_splats(FORMATS[kind], path, arrays, scene.transform)
    parts = with_start(MethodHooks(sh_degree=2), start_file(path), scene)
    found = parts.first_gaussians(type("Data", (), {"device": "cpu"})())
    assert isinstance(found, Gaussians) and found.sh_rest.shape == (2500, 8, 3)
    camera = scene.test[0].camera
    here, there = (
        Renderer(a, RenderSettings(sh_degree=2))(camera)
        for a in (arrays, {k: v.numpy() for k, v in found.items()})
    )
    assert here.std() > 10 and psnr(there, here) > (60 if kind == "ply" else 35)


def test_a_start_travels_with_its_cell_and_a_file_that_changed_is_refused(scene, tmp_path):
    dense = wall_points(tmp_path / "dense.ply", 900)
    (cell,) = plan_cells(["3dgs"], [scene], [0], TrainConfig(iterations=3), start=dense)
    there = make_cell(make_job(cell, tmp_path / "run", RunOptions(tmp_path)))
    assert there.start == cell.start and there.identity == cell.identity
    assert f"--start {dense}" in reproduce_command(cell)
    wall_points(dense, 901)
    with pytest.raises(AwError, match="has changed since"):
        with_start(MethodHooks(), cell.start, cell.scene)


def test_what_a_run_cannot_start_from_is_refused_before_anything_is_made(scene, tmp_path):
    far = wall_points(tmp_path / "far.ply", 50, 1e4)
    other = wall_points(tmp_path / "other.ply", 900, np.array([0, 0, -2.0]))  # in view, in front of the wall
    (tmp_path / "no.ply").write_text(
        "ply\nformat ascii 1.0\nelement vertex 0\nproperty float x\nend_header\n"
    )
    for path, message in (
        (far, r"far\.ply lies around \(1e\+04, .*\), and at most 0% of its"),
        (other, r"other\.ply lies around .* at most 0% of its points"),
        (tmp_path / "no.ply", "no x, y and z"),
        (Path(__file__), "no splat file"),
        (tmp_path / "meta.json", "unpacked SOG.*'aw export"),
        (tmp_path / "gone.ply", "cannot read"),
    ):
        with pytest.raises(AwError, match=message):
            small(scene, tmp_path / "runs", start=path)
    assert not (tmp_path / "runs").exists()


def test_a_start_that_lies_near_few_points_of_the_scene_is_warned_of(scene, tmp_path):
    given = load_scene(scene)
    xyz = given.points.xyz / given.transform.scale + given.transform.centre
    moved = np.where(np.arange(len(xyz))[:, None] % 40, xyz - np.array([0, 0, 2.0]), xyz)
    write_point_ply(tmp_path / "other.ply", moved, np.zeros(moved.shape, np.uint8))
    with pytest.warns(UserWarning, match="at most [2-9]% of its points .* is it of another scene"):
        with_start(MethodHooks(), start_file(tmp_path / "other.ply"), given)


def test_a_start_may_cover_a_part_of_the_scene_alone(scene, tmp_path):
    wall = wall_model(900)["means"]
    part = wall[wall[:, 0] < -1.5]
    write_point_ply(tmp_path / "part.ply", part, np.zeros(part.shape, np.uint8))
    xyz, _ = with_start(MethodHooks(), start_file(tmp_path / "part.ply"), load_scene(scene)).user_start
    assert 4 < len(xyz) < 300


def test_a_start_is_not_compared_with_the_few_dummy_points_of_a_scene(scene, tmp_path):
    given = load_scene(scene)
    dummy = replace(given, points=SparsePoints.without_tracks(np.full((1, 3), -50.0)))
    xyz, _ = with_start(MethodHooks(), start_file(wall_points(tmp_path / "wall.ply", 900)), dummy).user_start
    assert len(xyz) == 900
