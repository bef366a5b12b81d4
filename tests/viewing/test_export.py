"""`aw export`: files, sizes, losses, and what it says where something is missing."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pytest

from ambiguous_wild.core import AwError
from ambiguous_wild.io.ply import read_splat_ply, write_splat_ply
from ambiguous_wild.io.scene_folder import load_scene
from ambiguous_wild.io.splat_files import FORMATS, read_splats
from ambiguous_wild.metrics.image import psnr
from ambiguous_wild.viewing.model import Renderer, RenderSettings, ViewedModel, file_model
from ambiguous_wild.viewing.model_export import ExportParts, export
from tests.command_line import aw
from tests.tiny_scene import write_tiny_scene
from tests.viewing.wall_runs import wall_model, write_shown_run


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("exported")
    return write_shown_run(root / "runs", write_tiny_scene(root / "porch"), "3dgs")


def test_every_format_is_written_with_size_and_loss(run: Path, tmp_path: Path) -> None:
    plain = (run / "point_cloud.ply").read_bytes()
    done = aw("export", run, "-o", tmp_path, "--json", "--threads", 1)
    assert done.returncode == 0, done.stderr
    rows = json.loads(done.stdout)
    assert [row["format"] for row in rows] == ["compressed-ply", "spz", "sog", "gltf"]
    for row in rows:
        path = Path(row["path"])
        assert path.parent == tmp_path and path.name == "3dgs" + FORMATS[row["format"]].suffix
        assert row["bytes"] == path.stat().st_size == pytest.approx(row["share"] * len(plain))
        assert row["gaussians"] == 2500
    loss = {row["format"]: row for row in rows}
    assert loss["gltf"]["psnr_to_model"] == "inf" and loss["gltf"]["lost_db"] == 0
    for name in ("compressed-ply", "spz", "sog"):
        assert 30 < loss[name]["psnr_to_model"] < 70 and abs(loss[name]["lost_db"]) < 1
    assert (run / "point_cloud.ply").read_bytes() == plain


def test_the_loss_is_what_the_renders_say(run: Path, tmp_path: Path) -> None:
    scene = load_scene(run.parents[3] / "porch")
    model = ViewedModel("m", run / "point_cloud.ply", RenderSettings())
    ((found,), _) = export(model, tmp_path, ["spz"], scene.test)
    before, after = (
        Renderer(model.read(), RenderSettings()),
        Renderer(read_splats(found.path).gaussians, RenderSettings()),
    )
    values = [psnr(after(v.camera), before(v.camera)) for v in scene.test]
    assert found.psnr_to_model == pytest.approx(np.mean(values))


def test_without_the_scene_sizes_remain(run: Path, tmp_path: Path) -> None:
    root = tmp_path / "alone"
    shutil.copytree(run, root)
    done = aw("export", root, "--format", "spz", "--scene", tmp_path / "gone")
    assert done.returncode == 0 and "loss is not measured" in done.stderr
    assert (root / "export" / "point_cloud.spz").is_file() and "dB" not in done.stdout
    assert "% of the PLY" in aw("export", root, "--format", "gltf", "--no-loss").stdout


def test_several_models_have_names_of_their_own(run: Path, tmp_path: Path) -> None:
    write_shown_run(tmp_path / "runs", run.parents[3] / "porch", "../odd name/", 0)
    shutil.copytree(run, tmp_path / "runs" / "porch" / "x" / "seed0")
    done = aw("export", tmp_path / "runs", "--format", "spz", "--no-loss", "-o", tmp_path / "out")
    assert done.returncode == 0, done.stderr
    assert sorted(p.name for p in (tmp_path / "out").iterdir()) == ["3dgs.spz", "odd-name.spz"]


def test_files_of_the_user_stay_where_the_folder_was_named(run: Path, tmp_path: Path) -> None:
    (tmp_path / "3dgs.spz").write_text("mine")
    words = ("export", run, "--format", "spz", "--no-loss", "-o", tmp_path)
    done = aw(*words)
    assert done.returncode == 2 and f"{tmp_path / '3dgs.spz'} exists" in done.stderr
    assert (tmp_path / "3dgs.spz").read_text() == "mine"
    assert aw(*words, "--overwrite").returncode == 0 and (tmp_path / "3dgs.spz").stat().st_size > 1000


def test_a_model_of_nothing_is_refused(tmp_path: Path) -> None:
    model = wall_model(5)
    model["means"][:] = np.nan
    write_splat_ply(tmp_path / "m.ply", model)
    with pytest.raises(Exception, match="no Gaussian"):
        export(ViewedModel("m", tmp_path / "m.ply"), tmp_path / "out", ["spz"])
    with pytest.raises(Exception, match="unknown format 'splat'"):
        export(ViewedModel("m", tmp_path / "m.ply"), tmp_path / "out", ["splat"])


def test_models_with_a_filter_of_their_own_say_so(tmp_path: Path) -> None:
    write_splat_ply(tmp_path / "m.ply", wall_model(50))
    ((found,), _) = export(
        ViewedModel("m", tmp_path / "m.ply", RenderSettings(antialias=True)), tmp_path, ["spz"]
    )
    import gzip

    assert gzip.decompress(found.path.read_bytes())[14] == 1 and found.lost_db is None
    assert len(read_splat_ply(tmp_path / "m.ply")["means"]) == 50


def test_the_filter_is_said_where_the_format_can_and_the_loss_is_a_strangers(
    run: Path, tmp_path: Path
) -> None:
    scene = load_scene(run.parents[3] / "porch")
    small = wall_model(2500)
    small["log_scales"] -= 3.0  # below a pixel, where the filter shows
    write_splat_ply(tmp_path / "m.ply", small, antialias=True)
    model, _ = file_model(tmp_path / "m.ply")
    assert model.render_settings.antialias
    files, notes = export(model.within(scene.transform), tmp_path, list(FORMATS), scene.test)
    for file in files:
        held = FORMATS[file.format].antialias
        assert read_splats(file.path).antialias == (file.format != "gltf")
        assert (file.psnr_to_model > 35) == held
        assert any(note.startswith(f"{file.format} cannot say") for note in notes) == (not held)


def test_what_no_photo_needs_and_the_skybox_are_left_out(run: Path, tmp_path: Path) -> None:
    scene = load_scene(run.parents[3] / "porch")
    wall, far, hidden = wall_model(2500), wall_model(200, 1), wall_model(50, 2)
    far["means"] = far["means"] / np.linalg.norm(far["means"], axis=1, keepdims=True) * 500
    hidden["opacity_logits"][:] = -12.0
    names = wall.keys()
    both = {name: np.concatenate([part[name] for part in (wall, far, hidden)]) for name in names}
    write_splat_ply(tmp_path / "m.ply", both)
    model, _ = file_model(tmp_path / "m.ply")
    counts = {}
    for parts in (ExportParts(), ExportParts(skybox=False), ExportParts(clean=True, pad_harmonics=True)):
        (file,), notes = export(model, tmp_path / "out", ["ply"], scene=scene, parts=parts)
        counts[parts] = file.gaussians, "skybox" in " ".join(notes)
    whole, inner, clean = counts.values()
    assert whole == (2750, True) and inner == (2550, True)
    assert 1000 < clean[0] <= 2700  # the transparent ones are looked at, and none needs them
    assert read_splat_ply(tmp_path / "out" / "point_cloud.ply")["sh_rest"].shape[1:] == (15, 3)
    with pytest.raises(AwError, match="need the scene"):
        export(model, tmp_path / "out", ["ply"], parts=ExportParts(clean=True))
