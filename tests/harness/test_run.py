"""A run folder holds everything, is refused for another configuration, and resumes."""

import dataclasses
import json
import re
import shutil

import cv2
import numpy as np
import pytest
import torch
import yaml

from ambiguous_wild.core import AwError
from ambiguous_wild.harness.cell import RunOptions
from ambiguous_wild.harness.cell_run import refuse_other_config
from ambiguous_wild.harness.grid import cell_folder, plan_cells, run_cells, try_recipes
from ambiguous_wild.harness.result_file import check_model, read_result
from ambiguous_wild.io.files import folder_lock, sha256_file
from ambiguous_wild.io.images import read_gray, read_png_rgb
from ambiguous_wild.io.ply import read_splat_ply
from ambiguous_wild.methods import MethodEntry, register
from ambiguous_wild.metrics.image import flip, psnr, psnr_affine
from ambiguous_wild.splat.method_hooks import MaskPolicy, MethodHooks
from ambiguous_wild.splat.train_config import TrainConfig
from tests.command_line import aw
from tests.tiny_scene import TEST, TRAIN, write_tiny_scene

SHORT = TrainConfig(iterations=60, probes=2)


class TruthMask(MaskPolicy):
    """The exact masks, read from the scene: what a perfect policy would say."""

    def setup(self, data):
        root = data.scene.root / "truth" / "distractor"
        self.masks = [torch.from_numpy(read_gray(root / v.name) < 128).float() for v in data.scene.train]

    def keep(self, step):
        return self.masks[step.view]


def explode(options):
    raise RuntimeError("boom")


@pytest.fixture(autouse=True)
def _methods():
    register(MethodEntry("truth", "exact masks", lambda options: MethodHooks(mask=TruthMask())))
    register(MethodEntry("broken", "fails", explode))


def bench(scene, output, *methods, train=SHORT, overwrite="missing", pictures=False, **kw):
    cells = plan_cells(methods, [scene], kw.pop("seeds", [0]), train, **kw)
    return cells, run_cells(cells, output, RunOptions(output / ".cache", overwrite, pictures=pictures))


class NothingKept(MaskPolicy):
    """Masks every pixel of every photo."""

    def keep(self, step):
        return torch.zeros(step.photo.shape[:2])


def no_masks(root):
    register(MethodEntry("nothing-kept", "masks all", lambda options: MethodHooks(mask=NothingKept())))
    return "nothing-kept"


def user_masks(root):
    (root / "masks/train").mkdir(parents=True)
    for name in TRAIN:
        cv2.imwrite(str(root / "masks/train" / name), np.zeros((48, 64), np.uint8))
    return "3dgs"


@pytest.mark.parametrize(
    ("spoil", "reason"),
    [
        (no_masks, "the loss stayed 0 .* 6 of 6 train photos are masked all over"),
        (user_masks, "the loss stayed 0 .* 6 of 6 train photos are masked all over"),
    ],
)
def test_a_run_that_learns_or_shows_nothing_fails_with_the_reason(spoil, reason, tmp_path):
    root = write_tiny_scene(tmp_path / "scene")
    method = spoil(root)
    _, (report,) = bench(root, tmp_path / "runs", method)
    assert report.outcome == "failed" and re.search(reason, report.error)
    assert read_result(report.folder / "failed.json")["error"] == report.error
    assert not (report.folder / "metrics.json").exists()


def test_what_to_do_where_a_default_followed_the_weights(scene, tmp_path):
    given = ["robustsplat.features=sceneconv"]
    (old,) = plan_cells(["robustsplat"], [scene], [0], SHORT, settings=given)
    (new,) = plan_cells(["robustsplat"], [scene], [0], SHORT)
    written = {**old.config, "config_hash": old.identity}
    (tmp_path / "config.yaml").write_text(yaml.safe_dump(json.loads(json.dumps(written))))
    (tmp_path / "point_cloud.ply").touch()
    refuse_other_config(tmp_path, old)
    with pytest.raises(AwError, match=r"--set robustsplat\.features=sceneconv keeps the earlier value$"):
        refuse_other_config(tmp_path, new)


def test_a_run_folder_holds_everything_and_the_numbers_follow_from_it(scene, tmp_path):
    (cell,), (report,) = bench(scene, tmp_path, "truth", pictures=True)
    assert report.outcome == "trained", report.error
    run = cell_folder(tmp_path, cell)
    assert run == tmp_path / "scene" / "truth" / "seed0"
    names = {str(p.relative_to(run)) for p in run.rglob("*") if p.is_file()}
    expected = {"config.yaml", "env.json", "log.txt", "timeline.csv", "point_cloud.ply", "metrics.json"}
    expected |= {"checkpoint/last.safetensors"} | {f"renders/test/{n}" for n in TEST}
    assert names == expected | {f"masks/{n}" for n in TRAIN} | {"pictures/masks.jpg"} | {
        f"pictures/training_train_{k}.png" for k in (0, 2, 5)
    }

    result = read_result(run / "metrics.json")
    for row in result["per_image"]:
        drawn = read_png_rgb(run / "renders" / "test" / row["name"])
        photo = read_png_rgb(scene / "images" / row["name"])
        assert row["psnr"] == pytest.approx(psnr(drawn, photo))
        assert row["flip"] == pytest.approx(flip(drawn, photo))
        assert row["psnr_affine"] == pytest.approx(psnr_affine(drawn, photo))
    assert result["masks"] == {"iou": 1.0, "precision": 1.0, "recall": 1.0, "images": 6}
    assert result["cost"]["gaussians"] == len(read_splat_ply(run / "point_cloud.ply")["means"])
    assert "lpips_alex" in result["missing"] or "lpips_alex" in result["per_image"][0]
    assert {"psnr_valid", "psnr_covered", "psnr_uncovered"} <= result["missing"].keys()
    assert result["environment"] == json.loads((run / "env.json").read_text())
    assert result["reproduce"].startswith("aw bench --method truth --scene ")
    assert yaml.safe_load((run / "config.yaml").read_text())["train"]["iterations"] == 60


def test_exact_masks_beat_none(scene, tmp_path):
    train = dataclasses.replace(SHORT, iterations=400)
    _, reports = bench(scene, tmp_path, "3dgs", "truth", train=train)
    plain, masked = (np.mean([row["psnr"] for row in r.result["per_image"]]) for r in reports)
    assert masked > plain + 1.0


def test_a_finished_run_is_kept_and_a_result_that_is_lost_or_damaged_is_made_again(scene, tmp_path):
    (cell,), _ = bench(scene, tmp_path, "3dgs")
    result = cell_folder(tmp_path, cell) / "metrics.json"
    before = json.loads(result.read_text())
    often = dataclasses.replace(SHORT, checkpoint_every_s=1.0, probes=0)  # makes no other run of it
    assert bench(scene, tmp_path, "3dgs", train=often)[1][0].outcome == "kept"
    for spoil in (result.unlink, lambda: result.write_text("{half")):
        spoil()
        assert bench(scene, tmp_path, "3dgs")[1][0].outcome == "trained"
        assert json.loads(result.read_text())["per_image"] == before["per_image"]


def test_another_configuration_is_refused_by_name_and_replaced_on_request(scene, tmp_path):
    bench(scene, tmp_path, "3dgs")
    longer = dataclasses.replace(SHORT, iterations=61)
    with pytest.raises(AwError, match=r"train\.iterations was 60, is 61"):
        bench(scene, tmp_path, "3dgs", train=longer)
    assert bench(scene, tmp_path, "3dgs", train=longer, overwrite="never")[1][0].outcome == "skipped"
    assert bench(scene, tmp_path, "3dgs", train=longer, overwrite="always")[1][0].outcome == "trained"


def test_a_checkpoint_of_another_run_is_refused_by_name(scene, tmp_path):
    longer = dataclasses.replace(SHORT, iterations=61)
    (cell,), (other,) = bench(scene, tmp_path / "a", "3dgs", train=longer, seeds=[1])
    (cell,) = plan_cells(["3dgs"], [scene], [0], SHORT)
    place = cell_folder(tmp_path / "b", cell) / "checkpoint"
    place.mkdir(parents=True)
    shutil.copy(other.folder / "checkpoint/last.safetensors", place)
    written = {**cell.config, "config_hash": cell.identity}
    (place.parent / "config.yaml").write_text(yaml.safe_dump(json.loads(json.dumps(written))))
    (report,) = run_cells([cell], tmp_path / "b")
    assert report.outcome == "failed"
    assert "is of another run (3dgs on scene, seed 1, 61 iterations" in report.error
    (same,) = run_cells(
        [dataclasses.replace(cell)], tmp_path / "b", RunOptions(tmp_path / "b" / ".cache", "always")
    )
    assert same.outcome == "trained"


def test_a_result_holds_the_hash_of_its_model_and_the_parts_of_its_cost(finished):
    folder = finished / "scene" / "3dgs" / "seed0"
    result = read_result(folder / "metrics.json")
    assert result["model_sha256"] == sha256_file(folder / "point_cloud.ply")
    check_model(folder, result)
    cost = result["cost"]
    assert 0 < sum(cost["ms_parts"].values()) <= cost["ms_per_iteration"]
    assert 50 < cost["peak_rss_mb"] < 20_000
    assert 0 < cost["fps_low"] <= cost["fps"] <= cost["fps_high"]


def test_a_folder_that_is_not_ours_is_left_alone(scene, tmp_path):
    mine = tmp_path / "scene" / "3dgs" / "seed0" / "thesis.txt"
    mine.parent.mkdir(parents=True)
    mine.write_text("all I have")
    for overwrite in ("missing", "always"):
        with pytest.raises(AwError, match="no run of this program"):
            bench(scene, tmp_path, "3dgs", overwrite=overwrite)
    assert mine.read_text() == "all I have"


def test_a_failing_cell_does_not_take_the_others_with_it(scene, tmp_path):
    cells, reports = bench(scene, tmp_path, "broken", "3dgs")
    assert [r.outcome for r in reports] == ["failed", "trained"]
    folder = cell_folder(tmp_path, cells[0])
    assert reports[0].error == f"RuntimeError: boom; traceback: {folder / 'traceback.txt'}"
    result = read_result(folder / "failed.json")
    assert result["status"] == "failed" and result["code_hash"] and "--method broken" in result["reproduce"]
    assert "boom" in (folder / "traceback.txt").read_text()


@pytest.mark.parametrize(
    ("fault", "error"), [("1 / 0", "ZeroDivisionError: division by zero"), ("sys.exit(3)", "SystemExit: 3")]
)
def test_a_fault_of_a_method_of_ones_own_is_told_with_its_line(scene, tmp_path, fault, error):
    own = tmp_path / "my.py"
    own.write_text(f"import sys\n\ndef mine():\n    {fault}\n")
    cells, reports = bench(scene, tmp_path / "runs", f"{own}:mine", "3dgs")
    folder = cell_folder(tmp_path / "runs", cells[0])
    assert reports[0].error == f"{error} (my.py, line 4); traceback: {folder / 'traceback.txt'}"
    assert (folder / "traceback.txt").is_file() and reports[1].outcome == "trained"
    assert read_result(folder / "failed.json")["error"] == f"{error} (my.py, line 4)"
    try_recipes(cells)  # left to the run


def test_a_changed_file_is_named_and_trained_again_alone(scene, tmp_path):
    own, code = (
        tmp_path / "my.py",
        "from ambiguous_wild.splat.method_hooks import MethodHooks\ndef mine(): return MethodHooks({})",
    )
    methods = (f"{own}:mine", "3dgs")
    own.write_text(code.format(""))
    bench(scene, tmp_path / "runs", *methods)
    own.write_text(code.format("sh_degree=1"))
    with pytest.raises(AwError) as refused:
        bench(scene, tmp_path / "runs", *methods)
    assert "(my.py has changed since this run)" in str(refused.value)
    assert "--overwrite changed" in str(refused.value)
    for overwrite in ("missing", "never", "always"):  # a table would average the two versions
        with pytest.raises(AwError, match=r"my\.py has changed since the run .*seed0"):
            bench(scene, tmp_path / "runs", methods[0], seeds=[1], overwrite=overwrite)
    outcomes = [r.outcome for r in bench(scene, tmp_path / "runs", *methods, overwrite="changed")[1]]
    assert outcomes == ["trained", "kept"]
    assert bench(scene, tmp_path / "runs", methods[0], seeds=[1])[1][0].outcome == "trained"
    longer = dataclasses.replace(SHORT, iterations=61)
    with pytest.raises(AwError, match=r"train\.iterations was 60, is 61"):
        bench(scene, tmp_path / "runs", "3dgs", train=longer, overwrite="changed")


def test_a_run_that_succeeds_after_a_failure_leaves_no_trace_of_it(scene, tmp_path):
    bench(scene, tmp_path, "broken")
    register(MethodEntry("broken", "mended", lambda options: MethodHooks()))
    (cell,), (report,) = bench(scene, tmp_path, "broken")
    assert report.outcome == "trained"
    names = {p.name for p in cell_folder(tmp_path, cell).iterdir()}
    assert not names & {"failed.json", "traceback.txt"}


def test_a_failure_before_the_first_checkpoint_does_not_block_another_configuration(scene, tmp_path):
    bench(scene, tmp_path, "broken")
    register(MethodEntry("broken", "mended", lambda options: MethodHooks()))
    other = dataclasses.replace(SHORT, iterations=61)
    assert bench(scene, tmp_path, "broken", train=other)[1][0].outcome == "trained"


def test_a_folder_in_use_is_left_as_it_is(scene, tmp_path):
    (cell,) = plan_cells(["3dgs"], [scene], [0], SHORT)
    folder = cell_folder(tmp_path, cell)
    with folder_lock(folder, "aw bench"):
        (report,) = run_cells([cell], tmp_path)
        assert report.outcome == "failed"
        assert "being worked on by aw bench" in report.error
        assert not folder.exists()


def test_a_scene_named_twice_is_benched_once(scene):
    assert len(plan_cells(["3dgs"], [scene, scene / "."], [0], SHORT)) == 1


def test_options_reach_the_method_and_unknown_ones_are_named(scene):
    (cell,) = plan_cells(["refinesplat"], [scene], [0], SHORT, settings=["refinesplat.lambda_cr=0.1"])
    assert cell.options.lambda_cr == 0.1
    with pytest.raises(AwError, match="did you mean 'lambda_cr'"):
        plan_cells(["refinesplat"], [scene], [0], SHORT, settings=["refinesplat.lambda_rc=0.1"])
    with pytest.raises(AwError, match=r"write METHOD\.KEY=VALUE"):
        plan_cells(["refinesplat"], [scene], [0], SHORT, settings=["lambda_cr=0.1"])
    with pytest.raises(AwError, match="method in --set"):
        plan_cells(["3dgs"], [scene], [0], SHORT, settings=["refinesplat.lambda_cr=0.1"])


def test_scenes_of_one_name_are_refused(scene, tmp_path):
    other = write_tiny_scene(tmp_path / "scene")
    with pytest.raises(AwError, match="two scenes are called scene"):
        plan_cells(["3dgs"], [scene, other], [0], SHORT)


def test_settings_of_somebody_elses_program_do_not_make_a_folder_ours(scene, tmp_path):
    folder = tmp_path / "scene" / "3dgs" / "seed0"
    folder.mkdir(parents=True)
    (folder / "config.yaml").write_text("a: 1\n")
    with pytest.raises(AwError, match="no run of this program"):
        bench(scene, tmp_path, "3dgs", overwrite="always")
    assert (folder / "config.yaml").read_text() == "a: 1\n"


def test_a_default_dtype_that_a_method_left_reaches_no_other(scene, tmp_path):
    first = bench(scene, tmp_path / "a", "3dgs")[1][0].folder
    torch.set_default_dtype(torch.float64)
    try:
        second = bench(scene, tmp_path / "b", "3dgs")[1][0].folder
    finally:
        torch.set_default_dtype(torch.float32)
    assert (first / "point_cloud.ply").read_bytes() == (second / "point_cloud.ply").read_bytes()


def test_what_a_user_put_into_a_run_folder_outlives_the_run(scene, tmp_path):
    folder = bench(scene, tmp_path, "3dgs")[1][0].folder
    mine = [folder / name for name in ("notes.txt", "mine/a.md", ".todo.tmpl", ".my.old-stuff/b")]
    for path in mine:
        path.parent.mkdir(exist_ok=True)
        path.write_text("mine")
    left = [folder / ".metrics.12-abcd_123.tmp.json", folder / "renders/.test.old-abcd_123"]
    for path in left:
        path.write_text("of a killed process")
    (folder / "metrics.json").write_text("{}")
    assert bench(scene, tmp_path, "3dgs", overwrite="always")[1][0].outcome == "trained"
    assert [path.read_text() for path in mine] == ["mine"] * 4
    assert not any(path.exists() for path in left)


def test_a_run_folder_that_is_a_link_is_trained_where_it_leads(scene, tmp_path):
    (tmp_path / "disk").mkdir()
    (tmp_path / "runs/scene/3dgs").mkdir(parents=True)
    (tmp_path / "runs/scene/3dgs/seed0").symlink_to(tmp_path / "disk")
    for overwrite in ("missing", "always"):
        _, (report,) = bench(scene, tmp_path / "runs", "3dgs", overwrite=overwrite)
        assert report.outcome == "trained", report.error
        assert (tmp_path / "disk/metrics.json").is_file()
    assert (tmp_path / "runs/scene/3dgs/seed0").is_symlink()


def test_photos_too_small_to_be_measured_are_said_before_training(tmp_path):
    small = write_tiny_scene(tmp_path / "small")
    for path in (small / "images").iterdir():
        cv2.imwrite(str(path), cv2.resize(cv2.imread(str(path)), (12, 9)))
    _, (report,) = bench(small, tmp_path / "runs", "3dgs")
    assert "smaller than SSIM" in report.error
    assert not list((tmp_path / "runs").rglob("last.safetensors"))


@pytest.mark.parametrize(
    ("lost", "iterations", "words"),
    [
        ("config.yaml", 21, "holds a run of another configuration, and lacks its config.yaml"),
        ("config.yaml", 20, "is damaged, it lacks config.yaml"),
        ("point_cloud.ply", 20, "is damaged, it lacks point_cloud.ply"),
        ("renders/test/test_0.png", 20, "is damaged, it lacks renders/test/test_0.png"),
    ],
)
def test_a_finished_run_that_lacks_a_file_is_not_kept(finished, scene, tmp_path, lost, iterations, words):
    shutil.copytree(finished, tmp_path / "runs")
    (tmp_path / "runs" / "scene" / "3dgs" / "seed0" / lost).unlink()
    cells = plan_cells(["3dgs"], [scene], [0], TrainConfig(iterations=iterations, probes=0))
    with pytest.raises(AwError, match=re.escape(words)):
        run_cells(cells, tmp_path / "runs")


def test_a_render_of_another_run_is_not_shown(finished, tmp_path):
    shutil.copytree(finished, tmp_path / "runs")
    run = tmp_path / "runs" / "scene" / "3dgs" / "seed0"
    shutil.copy(run / "renders/test/test_1.png", run / "renders/test/test_0.png")
    answer = aw("figure", tmp_path / "runs", "-o", tmp_path / "figure.png")
    assert answer.returncode == 2 and "is not the render that was measured" in answer.stderr
    assert not (tmp_path / "figure.png").exists()
