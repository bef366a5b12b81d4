"""The page of `aw view` as a file: what it holds, what it refuses, hostile names, reduction."""

from __future__ import annotations

import base64
import dataclasses
import gzip
import json
import re
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from ambiguous_wild.core import AwError
from ambiguous_wild.harness.trained_models import (
    SceneModels,
    Viewer,
    next_steps,
    read_render_settings,
    view_runs,
)
from ambiguous_wild.io.files import own_json, sha256_file, write_json
from ambiguous_wild.io.images import read_png_rgb, write_png
from ambiguous_wild.io.mask_reasons import reasons_of, write_reasons
from ambiguous_wild.io.motion_points import FILE, MotionPoints, write_motion_points
from ambiguous_wild.io.scene_folder import MAP, load_scene
from ambiguous_wild.io.splat_arrays import SplatFile
from ambiguous_wild.io.spz import decode_spz
from ambiguous_wild.viewing import page_file
from ambiguous_wild.viewing.model import RenderSettings, ViewedModel
from ambiguous_wild.viewing.page_file import importance, opening, page_text, reduced
from tests.command_line import aw
from tests.report.board_runs import change_result
from tests.tiny_scene import HEIGHT, TEST, TRAIN, WIDTH, write_tiny_scene
from tests.viewing.wall_runs import wall_model, write_mixed_scene, write_shown_run

HOSTILE = '</script><img src=x onerror="alert(1)">&-->'


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("shown")
    scene = write_tiny_scene(root / "porch")
    ones = np.ones(2, np.uint8)
    xy, moving = np.array([[0, 1], [0.5, 0.25]], np.float32), np.array([0, 2], np.uint8)
    points = MotionPoints(xy, ones, moving, np.array([0, 1], np.int16))
    write_motion_points(scene / FILE, {TRAIN[0]: points})
    write_png(scene / MAP, np.full((86, 130, 3), 200, np.uint8))
    write_shown_run(root / "runs", scene, "3dgs", noise=20.0)
    write_shown_run(root / "runs", scene, HOSTILE, noise=5.0)
    return root / "runs"


@pytest.fixture(scope="module")
def hostile_page(runs: Path, tmp_path_factory: pytest.TempPathFactory) -> str:
    """The page of `runs` under a hostile title."""
    return view_runs([runs], tmp_path_factory.mktemp("page"), title=HOSTILE).path.read_text(encoding="utf-8")


def facts(page: str) -> dict[str, Any]:
    (found,) = re.findall(r'<script id="data" type="application/json">(.*?)</script>', page, re.S)
    return json.loads(found)


def test_the_page_holds_models_photos_masks_and_numbers(runs: Path, tmp_path: Path) -> None:
    done = aw("view", runs, "-o", tmp_path / "out", "--title", HOSTILE)
    assert done.returncode == 0, done.stderr
    page = (tmp_path / "out" / "index.html").read_text(encoding="utf-8")
    data = facts(page)
    assert [v["name"] for v in data["views"]] == TEST + TRAIN
    points = {v["name"]: v["points"] for v in data["views"] if v["points"]}
    assert points == {TRAIN[0]: [499, 249, 1, 0, 999, 0]}  # what moves comes first
    assert image_of(data["map"]).shape == (86, 130, 3)
    assert {m["label"] for m in data["models"]} == {"3dgs", HOSTILE}
    for model in data["models"]:
        assert set(model["psnr"]) == set(TEST) and model["mean"] == pytest.approx(
            np.mean([*model["psnr"].values()])
        )
        assert set(model["masks"]) == set(TRAIN[:2])
        (text,) = re.findall(f'<script id="{model["element"]}" type="text/plain">([^<]*)</script>', page)
        assert len(decode_spz(base64.b64decode(text), "m").gaussians["means"]) == 2500
    models = sum(map(len, re.findall(r'<script id="model-\d+".*?</script>', page)))
    assert len(page.encode()) - models < 3_000_000
    assert "index.html: " in done.stderr


def test_names_stay_text(hostile_page: str) -> None:
    assert "<img" not in hostile_page
    assert hostile_page.count("<script") == hostile_page.count("</script>") == 5
    assert "&lt;/script&gt;" in hostile_page and "\\u003c/script\\u003e" in hostile_page


def test_the_page_allows_itself_nothing_from_elsewhere(hostile_page: str) -> None:
    (policy,) = re.findall(r'Content-Security-Policy" content="([^"]*)"', hostile_page)
    assert policy.startswith("default-src 'none'") and "connect-src" not in policy
    assert not re.search(r"https?:|unsafe-inline|unsafe-eval'? |\*", policy.replace("'wasm-unsafe-eval'", ""))


def test_licences_of_the_bundled_program_are_in_the_page(hostile_page: str) -> None:
    (comment,) = re.findall(r"<!-- Licences.*?-->", hostile_page, re.S)
    assert all(name in comment for name in ("@sparkjsdev/spark 2.2.0", "three 0.180.0", "fflate"))
    assert comment.count("Permission is hereby granted, free of charge") == 3


def test_the_bundle_is_that_of_the_build_script() -> None:
    root = Path(__file__).resolve().parents[2]
    wanted = json.loads((root / "scripts/viewer/package.json").read_text())["dependencies"]
    licences = (root / "ambiguous_wild/viewing/page/licences.txt").read_text()
    assert all(f"{name} {version}" in licences for name, version in wanted.items())
    program = gzip.decompress((root / "ambiguous_wild/viewing/page/renderer.js.gz").read_bytes())
    assert b"SparkRenderer" in program and b"sourceMappingURL" not in program
    assert "resolved" not in (root / "scripts/viewer/package-lock.json").read_text()


def test_the_same_runs_give_the_same_bytes(runs: Path, tmp_path: Path) -> None:
    for name in ("a", "b"):
        view_runs([runs], tmp_path / name)
    assert (tmp_path / "a/index.html").read_bytes() == (tmp_path / "b/index.html").read_bytes()
    view_runs([runs], tmp_path / "a", title="new")  # an earlier page is replaced
    (note,) = facts((tmp_path / "a/index.html").read_text())["notes"]
    assert note.startswith(HOSTILE) and "drawn as plain 3DGS" in note


def test_models_are_named_and_ordered_by_labels(runs: Path, tmp_path: Path) -> None:
    assert aw("view", runs, "-o", tmp_path, "--label", "3dgs=Ours & co").returncode == 0
    named = [model["label"] for model in facts((tmp_path / "index.html").read_text())["models"]]
    assert named == [HOSTILE, "Ours & co"]
    wrong = aw("view", runs, "-o", tmp_path / "w", "--label", "gone=Ours")
    assert wrong.returncode == 2 and "unknown method 'gone'" in wrong.stderr


def test_another_page_is_not_replaced(runs: Path, tmp_path: Path) -> None:
    (tmp_path / "index.html").write_text("mine")
    done = aw("view", runs, "-o", tmp_path)
    assert done.returncode == 2 and "no page of 'aw view'" in done.stderr and done.stderr.count("\n") == 1
    assert (tmp_path / "index.html").read_text() == "mine"
    (tmp_path / "file").write_text("x")
    assert "is a file" in aw("view", runs, "-o", tmp_path / "file").stderr


def test_a_large_model_is_reduced_with_a_note(runs: Path, tmp_path: Path) -> None:
    done = aw("view", runs, "-o", tmp_path, "--max-gaussians", 1000)
    note = "3dgs: reduced from 2,500 to 1,000 Gaussians for this page; its PSNR is that of the whole model"
    assert note in done.stderr and note in facts((tmp_path / "index.html").read_text())["notes"]


def test_what_covers_most_of_the_photos_stays(tmp_path: Path) -> None:
    scene = load_scene(write_tiny_scene(tmp_path / "s"))
    cameras = [view.camera for view in scene.views]
    model = wall_model(300)
    model["means"][0], model["opacity_logits"][1], model["log_scales"][2] = (0, 0, -5), -12, -12
    score = importance(model, cameras)
    assert score[0] == 0 and score[1] < 1e-3 * np.median(score) and score[2] < 1e-3 * np.median(score)
    kept = reduced(model, cameras, 200)
    assert len(kept["means"]) == 200 and not (kept["means"][:, 2] < 0).any()
    rows = [int(np.flatnonzero((model["means"] == mean).all(axis=1))[0]) for mean in kept["means"]]
    assert rows == sorted(rows)
    assert len(reduced(model, cameras, 300)["means"]) == 300


def test_what_cannot_be_shown_is_one_line(runs: Path, tmp_path: Path) -> None:
    (empty := tmp_path / "empty").mkdir()
    for words, told in (
        ([tmp_path / "none"], "no folder of runs"),
        ([empty], "no run in"),
        ([runs, "--scene", tmp_path / "gone"], "take its folder: --scene"),
        ([], "no RUNS"),
        ([runs, "--live", runs.parent / "porch"], "leave RUNS out"),
    ):
        done = aw("view", *words, "-o", tmp_path / "out")
        assert done.returncode == 2 and told in done.stderr, done.stderr
        assert not (tmp_path / "out").exists() or not any((tmp_path / "out").iterdir())


def test_another_model_or_another_state_of_the_scene_is_refused(tmp_path: Path) -> None:
    scene = write_tiny_scene(tmp_path / "porch")
    run = write_shown_run(tmp_path / "runs", scene)
    change_result(run, lambda r: r.update(model_sha256="ab" * 32))
    with pytest.raises(AwError, match="is not the model that was measured"):
        view_runs([run], tmp_path / "out")
    change_result(run, lambda r: r.update(model_sha256=sha256_file(run / "point_cloud.ply")))
    view_runs([run], tmp_path / "out")
    poses = scene / "sparse/0/images.txt"
    poses.write_text(poses.read_text().replace(" 0 0 1 test_0.png", " 0.5 0 1 test_0.png"))
    with pytest.raises(AwError, match="was measured on another state of"):
        view_runs([run], tmp_path / "out")
    done = aw("export", run, "--format", "spz")
    assert "loss is not measured" in done.stderr and "another state of" in done.stderr
    done = aw("video", run, "-o", tmp_path / "v.mp4")
    assert done.returncode == 2 and "another state of" in done.stderr and done.stderr.count("\n") == 1


def test_runs_of_two_scenes_need_a_choice(runs: Path, tmp_path: Path) -> None:
    other = write_tiny_scene(tmp_path / "yard", distractors=False)
    write_shown_run(tmp_path / "runs", other, "3dgs")
    with pytest.raises(AwError, match="give those of one"):
        view_runs([runs, tmp_path / "runs"], tmp_path / "out")


def test_seeds_have_labels_of_their_own(runs: Path, tmp_path: Path) -> None:
    scene = runs.parent / "porch"
    for seed in (0, 1):
        write_shown_run(tmp_path / "runs", scene, "3dgs", seed)
    write_shown_run(tmp_path / "longer", scene, "3dgs", 0, iterations=200)
    page = view_runs([tmp_path / "runs"], tmp_path / "a").path.read_text()
    assert [m["label"] for m in facts(page)["models"]] == ["3dgs, seed0", "3dgs, seed1"]
    page = view_runs(
        [tmp_path / "runs", tmp_path / "longer", tmp_path / "runs"], tmp_path / "b"
    ).path.read_text()
    labels = [m["label"] for m in facts(page)["models"]]
    assert len(labels) == len(set(labels)) == 3 and "3dgs, seed1" in labels


def test_a_notebook_shows_the_page_in_a_frame(runs: Path) -> None:
    viewer = Viewer([runs])
    frame = viewer._repr_html_()
    assert frame.startswith('<iframe sandbox="allow-scripts" srcdoc="') and frame.count("<") == 2
    assert "3dgs" in repr(viewer)


def test_a_stranger_s_method_name_imports_no_file(tmp_path: Path) -> None:
    (tmp_path / "evil.py").write_text(f"open({str(tmp_path / 'ran')!r}, 'w')\ndef recipe(options): ...\n")
    config = {"method": f"{tmp_path / 'evil.py'}:recipe", "options": {}}
    look, note = read_render_settings(config)
    assert not (tmp_path / "ran").exists() and look == RenderSettings() and "--plugin" in note
    assert read_render_settings({"method": "3dgs", "options": {}, "effects": ["antialias"]})[0].antialias
    assert read_render_settings({})[1].startswith("a run without its config.yaml is drawn as plain 3DGS")
    for damaged in ({"effects": 5}, {"scene": {"background": [0, 0]}}, {"scene": {"background": None}}):
        with pytest.raises(AwError, match="damaged"):
            read_render_settings({"method": "3dgs", "options": {}, **damaged})
    look, note = read_render_settings({"method": "3dgs", "options": {"gone": 1}, "effects": ["antialias"]})
    assert look.antialias and "'gone'" in note


def test_photos_and_masks_stay_below_their_share_of_the_page(runs: Path, tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    views = []
    for number, view in enumerate(load_scene(runs.parent / "porch").views):
        photo, mask = tmp_path / f"{number}.png", tmp_path / "masks" / Path(view.name).with_suffix(".png")
        write_png(photo, rng.integers(0, 256, (270, 480, 3), np.uint8))
        mask.parent.mkdir(exist_ok=True)
        write_png(mask, rng.integers(0, 2, (270, 480), np.uint8) * 255)
        views.append(dataclasses.replace(view, image_path=photo))
    paths = [view.image_path for view in views]
    pictures = page_file.photo_uris(paths, 200_000)
    masks = page_file.mask_uris(tmp_path / "masks", views, 60_000)
    for uris, most in ((pictures, 200_000), (list(masks.values()), 60_000)):
        assert len(uris) == len(views) and most / 4 < sum(map(len, uris)) <= most
        assert len({image_of(uri).shape for uri in uris}) == 1  # all of one width
    wide = page_file.photo_uris(paths, 10**9)
    assert {image_of(uri).shape[:2] for uri in wide} == {(270, 480)}  # never enlarged
    least = page_file.photo_uris(paths, 1)  # too little for any: the smallest
    assert {image_of(uri).shape[1] for uri in least} == {page_file.WIDTHS[-1]}


def opened(runs: Path, *models: ViewedModel, mixed: bool = False) -> tuple[Any, Any, str]:
    """What the page opens with: labels on the left and right, and the name of the view."""
    scene = load_scene(runs.parent / "porch")
    chosen = opening(models, scene, mixed=mixed)
    sides = [c if c == "photo" else models[c].label for c in (chosen["left"], chosen["right"])]
    return sides[0], sides[1], [*scene.test, *scene.train][chosen["view"]].name


def masked(label: str, *counts: int, **more: Any) -> ViewedModel:
    """A model with masks of `counts` rows, from row 10 and column 8, of the first train photos."""
    keeps = np.ones((len(counts), HEIGHT, WIDTH), bool)
    for keep, rows in zip(keeps, counts):
        keep[10 : 10 + rows, 8:24] = False
    return ViewedModel(label, Path(label), masks=dict(zip(TRAIN, keeps)), **more)


PLAIN = ViewedModel("3dgs", Path("3dgs"), psnr=dict.fromkeys(TEST, 30.0))


def test_without_features_it_opens_where_most_is_masked_and_claims_nothing(
    runs: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(page_file, "read_motion_points", lambda root: {})
    removes = masked("refinesplat, seed0", 4, 12, 0, psnr=dict.fromkeys(TEST, 20.0))
    assert opened(runs, PLAIN, removes) == ("3dgs", "refinesplat, seed0", TRAIN[1])
    assert opened(runs, removes) == ("photo", "refinesplat, seed0", TRAIN[1])
    assert opening([removes], load_scene(runs.parent / "porch"), mixed=True)["place"] is None
    # refinesplat before other methods with masks; the others' model stands left, and one without masks first
    assert opened(runs, masked("dronesplat", 5), removes) == ("dronesplat", "refinesplat, seed0", TRAIN[1])
    assert opened(runs, masked("dronesplat", 5), PLAIN, removes)[0] == "3dgs"
    # neither a reference, nor a mask of more than half of the photo, nor one that masks nothing
    whole = masked("refinesplat", 7)
    whole.masks[TRAIN[2]] = np.zeros((HEIGHT, WIDTH), bool)
    assert opened(runs, PLAIN, whole)[1:] == ("refinesplat", TRAIN[0])
    truth = masked("3dgs+truth", 9, reference=True)
    assert opened(runs, PLAIN, truth)[1] == "3dgs" and opened(runs, truth, removes)[:2] == (
        "3dgs+truth", "refinesplat, seed0",
    )  # fmt: skip
    assert opened(runs, PLAIN, masked("refinesplat", 0))[1] == "3dgs"


def test_it_opens_where_masked_features_move_else_with_an_ordinary_view(
    runs: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def features(moving: int, static: int) -> MotionPoints:
        """Some in the columns that are masked, and as many that move in those that are not."""
        moves = np.array([1] * moving + [0] * static + [1] * 9, np.uint8)
        xy = np.tile(np.array([12.5, 11.5], np.float32) / [WIDTH, HEIGHT], (len(moves), 1))
        xy[moving + static :, 0] = 0.9
        return MotionPoints(xy.astype(np.float32), 1 - moves, moves, moves.astype(np.int16))

    scene, removes = load_scene(runs.parent / "porch"), masked("refinesplat", 4, 12)
    points = {TRAIN[0]: features(5, 1), TRAIN[1]: features(5, 4)}
    monkeypatch.setattr(page_file, "read_motion_points", lambda root: points)
    assert opened(runs, PLAIN, removes) == (
        "3dgs",
        "refinesplat",
        TRAIN[0],
    )  # though more of the next is masked
    assert opening([removes], scene, mixed=True)["place"] == [16 / WIDTH, 10 / HEIGHT]
    points[TRAIN[0]] = features(1, 0)
    assert opened(runs, removes, mixed=True) == ("photo", "refinesplat", TEST[0])
    assert opening([removes], scene, mixed=True)["place"] is None
    # PSNR would choose 3dgs, but rewards what should be masked
    assert opened(runs, PLAIN, removes, mixed=True) == ("3dgs", "refinesplat", TEST[0])
    assert opened(runs, PLAIN, removes)[1] == "3dgs"


def test_without_masks_it_opens_with_the_best_unless_test_photos_hold_distractors(runs: Path) -> None:
    worse, better = (
        ViewedModel(label, Path(label), psnr={TEST[0]: psnr, TEST[1]: psnr + more})
        for label, psnr, more in (("a", 30.0, 1), ("b", 20.0, 2))
    )
    assert opened(runs, better, worse) == ("b", "a", TEST[1])
    assert opened(runs, worse, better) == ("b", "a", TEST[1])
    assert opened(runs, better, worse, mixed=True) == ("a", "b", TEST[0])  # PSNR decides nothing


def test_psnr_of_mixed_test_photos_is_marked_and_names_its_fault(tmp_path: Path) -> None:
    write_shown_run(tmp_path / "runs", write_mixed_scene(tmp_path / "scene"), "3dgs")
    lines: list[str] = []
    data = facts(page := view_runs([tmp_path / "runs"], tmp_path / "out", say=lines.append).path.read_text())
    assert lines[1].startswith("PSNR here rewards ghosts: ")  # without the * of the page's figures
    assert data["mixed"] and data["notes"][0].startswith("* PSNR here rewards ghosts: test photos may hold")
    assert sum("may hold distractors" in note for note in data["notes"]) == 1
    assert f"<title>{tmp_path.name} · aw</title>" in page  # not that of the folder, which says nothing


def test_the_panel_names_files_and_the_command_that_trains_on(
    runs: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    scene = write_tiny_scene(tmp_path / "out" / "scene")
    run = write_shown_run(tmp_path / "out" / "runs", scene, "refinesplat", iterations=300)
    plain = write_shown_run(tmp_path / "out" / "runs", scene, "3dgs")
    for mask in (plain / "masks").iterdir():
        mask.unlink()  # as a run leaves the folder of a method without masks
    command = (
        f"aw bench --method refinesplat --scene {scene} --seed 0 --iterations 300 --device cpu --set a.b=1"
    )
    change_result(run, lambda r: r.update(reproduce=command))
    for here, above in ((tmp_path, "out/"), (tmp_path / "out", ""), (runs, "")):
        monkeypatch.chdir(here)
        text = view_runs([run, plain], tmp_path / "page").path.read_text()
        data = facts(text)
        model = data["models"][0]
        assert model["retrain"] == (
            f"aw bench --method refinesplat --scene {above}scene --seed 0 --set a.b=1 -o {above}runs "
            "--iterations 450 --overwrite longer --corrections corrections.json"
        )
        steps = "\n".join(data["next"])
        assert steps.count("masks of refinesplat") == 1 and "masks of 3dgs" not in steps
        place = f"{above}{run.relative_to(tmp_path / 'out').as_posix()}"
        assert f"`{place}/masks`" in steps and f"`aw table {above}runs`" in steps
        assert str(tmp_path) not in text
    change_result(run, lambda r: r.update(reproduce='aw "'))
    assert facts(view_runs([run], tmp_path / "page").path.read_text())["models"][0]["retrain"] == ""


def test_a_run_may_be_named_from_within_and_lie_anywhere(
    runs: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run = next(path.parent for path in runs.rglob("config.yaml"))
    for here, name in ((run.parent, run.name), (run, ".")):
        monkeypatch.chdir(here)
        assert facts(view_runs([Path(name)], tmp_path / "page").path.read_text())["next"]
    model = ViewedModel("3dgs", Path("point_cloud.ply"))
    monkeypatch.chdir("/")
    shown = SceneModels(load_scene(runs.parent / "porch"), (model,), (), runs=(Path("/data/seed0"),))
    assert "`aw export data/seed0`" in next_steps(shown)[0]


def test_reasons_of_a_run_come_with_its_masks_and_damaged_ones_do_not(runs: Path, tmp_path: Path) -> None:
    run = write_shown_run(tmp_path / "runs", runs.parent / "porch")
    regions = np.zeros((HEIGHT, WIDTH), int)
    regions[14:26, 14:26] = 1
    why = ["kept: it looks as predicted", "masked: <b>"]
    reasons = reasons_of(regions, why)
    write_reasons(run / "reasons.json", {TRAIN[0]: reasons, "gone.png": reasons})
    page = view_runs([run], tmp_path / "page").path
    ((name, stored),) = facts(page.read_text())["models"][0]["reasons"].items()
    assert name == TRAIN[0] and stored["sentences"] == why
    assert (image_of(stored["regions"]) == regions + 1).all()
    record = own_json(run / "reasons.json")
    cut = stored["regions"][:-40] + "!"
    head = "data:image/png;base64,"
    # cut within the header; no ASCII; and a bitmap that seems 32 px wide where a PNG has its width
    wide = cv2.imencode(".bmp", np.zeros((16, 8192), np.uint8))[1].tobytes()
    odd = [head + base64.b64encode(data).decode() for data in (bytes(18), wide)]
    rows = [{"regions": uri, "sentences": why} for uri in ("https://x", cut, f"{head}é", *odd)]
    for damaged in (*rows, {"regions": stored["regions"], "sentences": []}, 7, None):
        write_json(run / "reasons.json", record | {"photos": {TRAIN[0]: damaged}})
        assert facts(view_runs([run], tmp_path / "page").path.read_text())["models"][0]["reasons"] == {}


def test_a_page_of_a_training_holds_models_and_masks_from_memory(runs: Path) -> None:
    scene = load_scene(runs.parent / "porch")
    keep = np.ones((HEIGHT, WIDTH), bool)
    keep[14:26, 14:26] = False
    model = ViewedModel("3dgs", Path("3dgs"), splats=SplatFile(wall_model()), masks={TRAIN[1]: keep})
    sentence = "training: 1200 iterations after 1:30 of 5:00"
    page, _ = page_text(scene, [model], title="t", training=sentence, reload_s=2.5)
    data = facts(page)
    assert (data["training"], data["reload_s"], data["models"][0]["mean"]) == (sentence, 2.5, None)
    ((name, uri),) = data["models"][0]["masks"].items()
    assert name == TRAIN[1] and ((image_of(uri) > 127) == keep).all()
    ended = facts(page_text(scene, [model], title="t")[0])
    assert (ended["training"], ended["reload_s"]) == ("", 0)
    # the photos of the second page come from memory, and one that has changed does not
    photo = scene.test[0].image_path
    write_png(photo, 255 - read_png_rgb(photo))
    again = facts(page_text(scene, [model], title="t")[0])
    assert again["views"][1:] == ended["views"][1:] and again["views"][0] != ended["views"][0]
    write_png(photo, 255 - read_png_rgb(photo))


def test_a_map_stays_below_its_share_of_the_page_and_may_be_missing(tmp_path: Path) -> None:
    assert page_file.map_uri(tmp_path / MAP) == ""
    write_png(tmp_path / MAP, np.random.default_rng(0).integers(0, 256, (860, 1300, 3), np.uint8))
    assert image_of(page_file.map_uri(tmp_path / MAP)).shape[1] == page_file.MAP_WIDTHS[-1]  # noise
    write_png(tmp_path / MAP, np.full((860, 1300, 3), 255, np.uint8))
    assert image_of(page_file.map_uri(tmp_path / MAP)).shape[1] == 1300


def image_of(uri: str) -> np.ndarray:
    return cv2.imdecode(np.frombuffer(base64.b64decode(uri.split(",", 1)[1]), np.uint8), cv2.IMREAD_UNCHANGED)


def test_runs_with_masks_of_a_folder_are_drawn_as_their_method() -> None:
    config = {
        "method": "mip-splatting@mask=sam",
        "source": "hash of the masks",
        "options": {"host": {}, "mask": {}},
    }
    look, note = read_render_settings(config)
    own, _ = read_render_settings({"method": "mip-splatting"})
    assert (look, note) == (own, "")
    assert "unknown method" in read_render_settings({"method": "nobodys@mask=sam"})[1]
    assert "unknown method" in read_render_settings({"method": "3dgs@effects=nobodys"})[1]
