"""Captures: repeatable, true to what they claim, never in the way of someone else's folder."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path

import cv2
import numba
import numpy as np
import pytest
from PIL import Image

from ambiguous_wild.core import AwError
from ambiguous_wild.io.files import sha256_file
from ambiguous_wild.simulate import capture_writer
from ambiguous_wild.simulate import world as world_module
from ambiguous_wild.simulate.distractors import DistractorPose, distractor_shapes
from ambiguous_wild.simulate.presets import PRESETS, preset, resized
from ambiguous_wild.simulate.spec import PLANS

SMALL = replace(resized(preset("tiny"), views=6, width=128), detail_px_per_m=20.0)
COARSE = 5.0  # texels a metre where shapes matter; the same everywhere, so that worlds are built once
LITTLE = replace(
    SMALL, train_views=3, test_views=2, width=64, height=36, distractors=(), detail_px_per_m=COARSE
)


@pytest.fixture(scope="module")
def raw(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("capture") / "raw"
    capture_writer.simulate(SMALL, out, seed=4, depth=True)
    return out


@pytest.fixture(scope="module")
def little(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A small capture, to be copied."""
    out = tmp_path_factory.mktemp("little") / "raw"
    capture_writer.simulate(LITTLE, out)
    return out


def facts(raw: Path) -> dict:
    return json.loads((raw / "truth/capture.json").read_text())


def image(path: Path) -> np.ndarray:
    return cv2.imread(str(path), cv2.IMREAD_UNCHANGED)


def test_folder_holds_a_photo_a_mask_and_a_clean_view_of_every_shot(raw: Path) -> None:
    train = sorted(p.stem for p in (raw / "train").iterdir())
    test = sorted(p.stem for p in (raw / "test").iterdir())
    assert train == [f"IMG_{k:04d}" for k in range(1, 7)] and test == ["IMG_0101", "IMG_0102"]
    for part in ("distractor", "clean"):
        assert sorted(p.stem for p in (raw / "truth" / part).iterdir()) == train
    assert sorted(json.loads((raw / "truth/cameras.json").read_text())) == [f"{s}.jpg" for s in train + test]
    assert facts(raw)["files"].keys() == {
        p.relative_to(raw).as_posix() for p in raw.rglob("*") if p.is_file() and p.name != "capture.json"
    }


def test_the_records_keep_their_keys_and_their_order(raw: Path) -> None:
    said = json.loads((raw / "truth/capture.json").read_text())
    assert list(said) == [
        "schema", "preset", "seed", "identity", "version", "spec", "designed", "mask", "clean", "test",
        "occlusion", "objects", "photos", "licence", "files",
    ]  # fmt: skip
    placed = [d for photo in said["photos"].values() for d in photo["distractors"]]
    assert list(placed[0]) == ["distractor", "occlusion", "which", "x_m", "y_m", "yaw_deg", "pose"]
    cameras = json.loads((raw / "truth/cameras.json").read_text())
    keys = ["width", "height", "fx", "fy", "cx", "cy", "cam_from_world"]
    assert all(list(camera) == keys for camera in cameras.values())


def test_same_seed_same_bytes_on_any_number_of_threads(raw: Path, tmp_path: Path) -> None:
    before = numba.get_num_threads()
    numba.set_num_threads(1 if before > 1 else numba.config.NUMBA_NUM_THREADS)
    try:
        again = capture_writer.simulate(SMALL, tmp_path / "again", seed=4, depth=True)
    finally:
        numba.set_num_threads(before)
    assert again["files"] == facts(raw)["files"]
    assert all(sha256_file(raw / name) == digest for name, digest in again["files"].items())


def test_another_seed_moves_distractors_cameras_and_paint(raw: Path) -> None:
    spec = replace(SMALL, detail_px_per_m=COARSE)
    one, two = capture_writer.plan_capture(spec, 4), capture_writer.plan_capture(spec, 5)
    for a, b in zip(one[1], two[1]):
        assert not np.allclose(a.camera.cam_from_world, b.camera.cam_from_world, atol=1e-3)
        assert a.placements != b.placements or a.split == "test"
    assert not np.array_equal(one[0].atlas.texels, two[0].atlas.texels)


def test_photo_equals_the_clean_view_in_every_jpeg_block_without_distractor(
    raw: Path, tmp_path: Path
) -> None:
    """JPEG codes 8 px blocks apart from each other: blocks outside the mask must agree to the bit."""
    for path in (raw / "train").iterdir():
        clean = Image.open(raw / "truth/clean" / f"{path.stem}.png")
        clean.save(tmp_path / path.name, quality=95, subsampling=0)
        gap = np.abs(image(path).astype(int) - image(tmp_path / path.name)).max(2)
        mask = image(raw / "truth/distractor" / f"{path.stem}.png")
        assert set(np.unique(mask)) == {0, 255} and mask.shape == gap.shape
        height, width = (n - n % 8 for n in mask.shape)
        touched = mask[:height, :width].reshape(height // 8, 8, width // 8, 8).max((1, 3)) > 0
        blocks = gap[:height, :width].reshape(height // 8, 8, width // 8, 8).max((1, 3))
        assert (~touched).mean() > 0.5 and not blocks[~touched].any()
        assert gap[mask > 0].mean() > 15


def test_recorded_occlusion_is_that_of_the_mask_and_in_the_band(raw: Path) -> None:
    photos = facts(raw)["photos"]
    for name, photo in photos.items():
        share = (image(raw / "truth/distractor" / f"{Path(name).stem}.png") > 0).mean()
        assert photo["occlusion"] == pytest.approx(share, abs=1e-6)
        assert sum(d["occlusion"] for d in photo["distractors"]) == pytest.approx(share, abs=1e-5)
    shares = [p["occlusion"] for p in photos.values()]
    assert min(shares) > SMALL.occlusion[0] - 0.03 and max(shares) < SMALL.occlusion[1] + 0.03


def test_depth_carried_to_another_camera_meets_its_depth(raw: Path) -> None:
    """An oracle of poses, intrinsics and axes: points of one photo land where the other sees them."""
    cameras = json.loads((raw / "truth/cameras.json").read_text())
    a, b = cameras["IMG_0003.jpg"], cameras["IMG_0102.jpg"]
    za, zb = (image(raw / f"truth/depth/{n}.png") / 1000.0 for n in ("IMG_0003", "IMG_0102"))
    rows, cols = np.mgrid[0 : a["height"], 0 : a["width"]] + 0.5
    local = np.stack(
        [(cols - a["cx"]) / a["fx"] * za, (rows - a["cy"]) / a["fy"] * za, za, np.ones_like(za)], -1
    )
    there = local @ (np.array(b["cam_from_world"]) @ np.linalg.inv(a["cam_from_world"])).T
    u = there[..., 0] / there[..., 2] * b["fx"] + b["cx"]
    v = there[..., 1] / there[..., 2] * b["fy"] + b["cy"]
    ok = (there[..., 2] > 0.5) & (u > 1) & (u < b["width"] - 1) & (v > 1) & (v < b["height"] - 1)
    error = np.abs(zb[v[ok].astype(int), u[ok].astype(int)] - there[ok][:, 2]) / there[ok][:, 2]
    assert ok.mean() > 0.3 and np.median(error) < 0.01 and (error < 0.05).mean() > 0.8


def test_exif_states_the_true_focal_length(raw: Path) -> None:
    camera = json.loads((raw / "truth/cameras.json").read_text())["IMG_0001.jpg"]
    exif = Image.open(raw / "train/IMG_0001.jpg").getexif()
    fields = exif.get_ifd(0x8769)
    assert exif[0x0110] == "simulated phone" and fields[0x9003].startswith("2025:")
    assert float(fields[0x920A]) * float(fields[0xA20E]) / 25.4 == pytest.approx(camera["fx"], rel=1e-4)
    diagonal = np.hypot(camera["width"], camera["height"])
    assert fields[0xA405] / np.hypot(36, 24) == pytest.approx(camera["fx"] / diagonal, rel=1e-4)
    assert fields[0x829A] > 0 and fields[0x8827] > 0 and fields[0xA403] == 1


def test_test_viewpoints_are_new_and_inside_the_walk() -> None:
    for seed in range(2):
        world, shots = capture_writer.plan_capture(
            replace(SMALL, distractors=(), detail_px_per_m=COARSE), seed
        )
        hub = np.array([world.hub[0], world.hub[1] - 0.3])
        around = {"train": [], "test": []}
        for shot in shots:
            rotation = shot.camera.cam_from_world[:3, :3]
            np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-12)
            assert np.linalg.det(rotation) == pytest.approx(1.0)
            out = shot.camera.center[:2] - hub
            around[shot.split].append((np.arctan2(out[0], -out[1]), np.hypot(*out), shot.camera.center[2]))
        train, test = np.array(around["train"]), np.array(around["test"])
        assert (test[:, 0] > train[:, 0].min()).all() and (test[:, 0] < train[:, 0].max()).all()
        assert (test[:, 1] > SMALL.radius_m[0]).all() and (test[:, 1] < SMALL.radius_m[1]).all()
        assert (test[:, 2] > SMALL.eye_m[0]).all() and (test[:, 2] < SMALL.eye_m[1]).all()


def test_no_distractor_keeps_its_place_and_none_stands_in_the_scenery() -> None:
    twin = tuple(d for d in preset("tiny").distractors if d.kind == "twin")
    spec = replace(resized(preset("tiny"), views=14, width=96), detail_px_per_m=COARSE, distractors=twin)
    world, shots = capture_writer.plan_capture(spec, 1)
    spots = np.array([(p.x_m, p.y_m) for s in shots for p in s.placements])
    assert len(spots) > 7
    near = (np.linalg.norm(spots[:, None] - spots[None], axis=2) < 0.3).sum(1)
    assert near.max() <= 0.2 * spec.train_views
    gap = np.linalg.norm(spots[:, None] - world.keep_out[None, :, :2], axis=2) - world.keep_out[None, :, 2]
    assert gap.min() > 0


def test_an_identical_capture_is_left_alone_and_another_is_refused(raw: Path) -> None:
    stamp = (raw / "truth/cameras.json").stat().st_mtime_ns
    assert capture_writer.simulate(SMALL, raw, seed=4, depth=True)["reused"]
    assert (raw / "truth/cameras.json").stat().st_mtime_ns == stamp
    with pytest.raises(AwError, match="--overwrite"):
        capture_writer.simulate(SMALL, raw, seed=9, depth=True)


def test_overwrite_replaces_captures_only(little: Path, tmp_path: Path) -> None:
    shutil.copytree(little, tmp_path / "raw")
    (tmp_path / "raw/train/mine.jpg").write_bytes(b"x")
    with pytest.raises(AwError, match=r"also holds train/mine\.jpg"):
        capture_writer.simulate(LITTLE, tmp_path / "raw", seed=1, overwrite=True)
    (tmp_path / "raw/train/mine.jpg").unlink()
    (tmp_path / "raw/train/IMG_0001.jpg").write_bytes(b"spoilt")
    with pytest.raises(AwError, match="changed since"):
        capture_writer.simulate(LITTLE, tmp_path / "raw")
    made = capture_writer.simulate(LITTLE, tmp_path / "raw", overwrite=True)
    assert sha256_file(tmp_path / "raw/train/IMG_0001.jpg") == made["files"]["train/IMG_0001.jpg"]
    foreign = tmp_path / "holiday"
    foreign.mkdir()
    (foreign / "me.jpg").write_bytes(b"x")
    with pytest.raises(AwError, match="not a simulated capture"):
        capture_writer.simulate(LITTLE, foreign, overwrite=True)
    assert (foreign / "me.jpg").read_bytes() == b"x"


def test_a_run_that_breaks_leaves_nothing(tmp_path: Path) -> None:
    def breaks(shots):
        yield shots[0]
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        capture_writer.simulate(LITTLE, tmp_path / "raw", progress=breaks)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("detail", [3.0, 12.0])
def test_textures_are_finite_and_never_flat_at_any_resolution(detail: float) -> None:
    world, _ = capture_writer.plan_capture(replace(SMALL, detail_px_per_m=detail, distractors=()), 0)
    atlas = world.atlas
    assert np.isfinite(atlas.texels).all() and (atlas.texels >= 0).all()
    for name, t in atlas.index.items():
        start, count = atlas.offset[t, 0], atlas.width[t, 0] * atlas.height[t, 0]
        assert atlas.texels[start : start + count].std() > 0.005, name


def test_a_preset_is_found_by_name_and_resized_within_limits() -> None:
    with pytest.raises(AwError, match="did you mean 'courtyard-plain'"):
        preset("courtyard-plains")
    for words, message in (({"views": 2}, "--views 2"), ({"width": 10}, "--width 10")):
        with pytest.raises(AwError, match=message):
            resized(preset("tiny"), **words)


def test_a_tint_colours_its_own_sheet_and_leaves_the_head() -> None:
    red = next(d for d in PRESETS["courtyard-plain"].distractors if d.kind == "visitor")
    shapes = distractor_shapes(red, DistractorPose(0, 0.0, 0.0, 0.0, 0.5), PLANS["courtyard"])
    assert all(s.tint[1] < 0.1 * s.tint[0] for s in shapes if s.texture == red.texture)
    heads = [s.tint for s in shapes if s.texture == "skin"]
    assert heads and all(t == (1.0, 1.0, 1.0) for t in heads)


def test_size_and_lift_move_a_ball_off_the_ground() -> None:
    ball = replace(PRESETS["courtyard-plain"].distractors[1], size=0.25, lift_m=2.0)
    (shape,) = distractor_shapes(ball, DistractorPose(1, 0.5, -1.0, 0.0, 0.5), PLANS["courtyard"])
    assert shape.center == pytest.approx((0.5, -1.0, 1.0 + 0.1)) and shape.half == pytest.approx((0.1,) * 3)
    assert shape.owner == 2


def test_a_sheet_that_came_later_changes_no_earlier_bit(monkeypatch: pytest.MonkeyPatch) -> None:
    """World of the same seed with and without it: the same light, the same texels under the same names."""
    spec = replace(SMALL, detail_px_per_m=COARSE, distractors=())
    now, _ = capture_writer.plan_capture(spec, 5)
    monkeypatch.delitem(world_module.SHEETS, "cloth")
    before, _ = capture_writer.plan_capture(spec, 5)
    assert np.array_equal(now.light.sun, before.light.sun)
    for name, old in before.atlas.index.items():
        new = now.atlas.index[name]
        for level in range(before.atlas.levels[old]):
            texels = []
            for atlas, t in ((before.atlas, old), (now.atlas, new)):
                count = atlas.width[t, level] * atlas.height[t, level]
                texels.append(atlas.texels[atlas.offset[t, level] :][:count])
            assert np.array_equal(*texels), name


def test_a_record_nested_without_end_is_named(tmp_path: Path) -> None:
    (tmp_path / "raw/truth").mkdir(parents=True)
    (tmp_path / "raw/truth/capture.json").write_text("[" * 100_000)
    with pytest.raises(AwError, match="an unreadable truth"):
        capture_writer.simulate(SMALL, tmp_path / "raw")
