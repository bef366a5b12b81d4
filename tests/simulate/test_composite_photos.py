"""Distractors in plain photos: exact masks, clean test photos, the same bytes, and a capture that is read."""

from __future__ import annotations

import io
import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner
from PIL import Image

from ambiguous_wild.builder.collect import collect
from ambiguous_wild.cli.simulate import composite_command as command
from ambiguous_wild.core import AwError
from ambiguous_wild.io.files import sha256_file
from ambiguous_wild.io.images import read_gray, read_png_rgb
from ambiguous_wild.io.photos import Exif, read_photo
from ambiguous_wild.simulate.composite_photos import _write_jpeg, composite_photos
from ambiguous_wild.simulate.placement import CompositeConfig

NAMES = [f"p{i:02d}" for i in range(13)]
TEST = ["p03", "p09"]
TRAIN = [n for n in NAMES if n not in TEST]
CONFIG = CompositeConfig(coverage=0.15, patches=True, seed=3)
SEQUENCE = [f"f{i:03d}" for i in range(60)]


@pytest.fixture(scope="module")
def photos(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Smooth photos of different colours, the first turned by EXIF."""
    folder = tmp_path_factory.mktemp("photos")
    rows, columns = np.mgrid[:120, :168]
    for i, name in enumerate(NAMES):
        pixels = np.dstack([rows + 10 * i, columns, 250 - rows - 5 * i]).astype(np.uint8)
        _write_jpeg(folder / f"{name}.jpg", pixels, Exif(make="A", model="B", focal_mm=4.2, focal_35mm=26))
    first = Image.open(folder / "p00.jpg")
    tags = first.getexif()
    tags[0x0112] = 6
    first.save(folder / "p00.jpg", exif=tags, quality=95)
    (folder / "notes.txt").write_text("no photo")
    return folder


@pytest.fixture(scope="module")
def cutouts(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("cutouts")
    rgba = np.zeros((40, 30, 4), np.uint8)
    rgba[4:30, 5:25] = 250, 20, 250, 255
    Image.fromarray(rgba).save(folder / "one.png")
    return folder


@pytest.fixture(scope="module")
def made(photos: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("made") / "raw"
    composite_photos(photos, out, CONFIG)
    return out


@pytest.fixture(scope="module")
def sequence(cutouts: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Composite with `path` of 60 grey photos."""
    source, out = tmp_path_factory.mktemp("sequence"), tmp_path_factory.mktemp("made") / "raw"
    for name in SEQUENCE:
        _write_jpeg(source / f"{name}.jpg", np.full((72, 128, 3), 128, np.uint8), Exif())
    composite_photos(source, out, replace(CONFIG, patches=False, path=True), cutouts)
    return out


def jpeg_pixels(pixels: np.ndarray) -> np.ndarray:
    memory = io.BytesIO()
    Image.fromarray(pixels).save(memory, "jpeg", quality=95, subsampling=0)
    return np.asarray(Image.open(memory))


def hashes(folder: Path) -> dict[str, str]:
    return {str(p.relative_to(folder)): sha256_file(p) for p in sorted(folder.rglob("*")) if p.is_file()}


def test_only_pixels_in_the_mask_change(photos: Path, made: Path) -> None:
    changed = 0
    for name in TRAIN:
        clean = read_png_rgb(made / "truth/clean" / f"{name}.png")
        mask = read_gray(made / "truth/distractor" / f"{name}.png") > 0
        assert np.array_equal(clean, read_photo(photos / f"{name}.jpg")[1])
        photo = np.asarray(Image.open(made / "train" / f"{name}.jpg"))
        assert photo.shape == clean.shape and mask.shape == photo.shape[:2]
        gap = np.abs(photo.astype(int) - jpeg_pixels(clean)).max(2)
        # JPEG codes blocks of 8x8 px alone: those without a distractor are equal.
        h, w = (-(-n // 8) for n in mask.shape)
        blocks = np.zeros((h, w), bool)
        blocks[tuple(index // 8 for index in np.nonzero(mask))] = True
        block_mask = np.kron(blocks, np.ones((8, 8), bool))[: mask.shape[0], : mask.shape[1]]
        assert not gap[~block_mask].any()
        assert not gap[~mask].any() or np.percentile(gap[~mask], 99) < 30
        changed += bool(mask.any())
    assert changed == round(CONFIG.presence * len(TRAIN))


def test_coverage_is_near_the_setting(photos: Path, cutouts: Path, made: Path, tmp_path: Path) -> None:
    facts = json.loads((made / "truth/composite.json").read_text())
    assert facts["occlusion"]["mean"] == pytest.approx(CONFIG.coverage, rel=0.35)
    assert sorted(facts["photos"]) == [f"{n}.jpg" for n in TRAIN]
    for name, photo in facts["photos"].items():
        mask = read_gray(made / "truth/distractor" / f"{Path(name).stem}.png")
        assert set(np.unique(mask)) <= {0, 255}
        assert photo["occlusion"] == pytest.approx((mask > 0).mean(), abs=1e-6)
        assert len(photo["distractors"]) <= 3
        assert all(p["photo"] and Path(p["photo"]).stem in TRAIN for p in photo["distractors"])
    config = CompositeConfig(coverage=0.1, presence=1.0)
    facts = composite_photos(photos, tmp_path / "raw", config, cutouts)
    assert [c["name"] for c in facts["cutouts"]] == ["one"] and facts["occlusion"]["min"] > 0.03
    clean = read_png_rgb(tmp_path / "raw/truth/clean/p01.png")
    mask = read_gray(tmp_path / "raw/truth/distractor/p01.png") > 0
    gap = np.abs(np.asarray(Image.open(tmp_path / "raw/train/p01.jpg")).astype(int) - clean).max(2)
    assert (gap[mask] > 40).mean() > 0.9


def test_test_photos_are_clean(photos: Path, made: Path) -> None:
    assert sorted(p.stem for p in (made / "test").iterdir()) == TEST
    for name in TEST:
        clean = read_photo(photos / f"{name}.jpg")[1]
        assert np.array_equal(np.asarray(Image.open(made / "test" / f"{name}.jpg")), jpeg_pixels(clean))
        assert not (made / "truth/distractor" / f"{name}.png").exists()


def test_the_seed_decides_every_byte(photos: Path, made: Path, tmp_path: Path) -> None:
    composite_photos(photos, tmp_path / "again", CONFIG)
    assert hashes(tmp_path / "again") == hashes(made)
    composite_photos(photos, tmp_path / "other", CompositeConfig(coverage=0.15, patches=True, seed=4))
    assert hashes(tmp_path / "other") != hashes(made)


def test_photos_may_lie_in_images(photos: Path, made: Path, tmp_path: Path) -> None:
    shutil.copytree(photos, tmp_path / photos.name / "images")
    composite_photos(tmp_path / photos.name, tmp_path / "out", CONFIG)
    assert hashes(tmp_path / "out") == hashes(made)


def test_equal_names_in_several_folders_stay_apart(photos: Path, tmp_path: Path) -> None:
    for i, name in enumerate(NAMES):
        target = tmp_path / "rig" / ("left" if i < 6 else "right") / f"{i - 6 * (i >= 6)}.jpg"
        target.parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(photos / f"{name}.jpg", target)
    facts = composite_photos(tmp_path / "rig", tmp_path / "raw", CONFIG)
    capture = collect(tmp_path / "raw")
    assert sorted(s.stem for s in capture.sources if s.side == "test") == ["left_3", "right_3"]
    assert len({s.stem for s in capture.sources}) == len(NAMES)
    for name in facts["photos"]:
        own = Path(name).with_suffix(".png")
        clean = read_png_rgb(tmp_path / "raw/truth/clean" / own)
        assert np.array_equal(clean, read_photo(tmp_path / "rig" / name)[1])
        assert (tmp_path / "raw/truth/distractor" / own).is_file()


def test_the_builder_reads_the_capture(made: Path) -> None:
    capture = collect(made)
    assert capture.has_sides and capture.truth == made.resolve() / "truth"
    assert [s.stem for s in capture.sources if s.side == "test"] == TEST
    assert [s.stem for s in capture.sources if s.side == "train"] == TRAIN


def test_camera_settings_stay_and_photos_are_upright(made: Path) -> None:
    for path in (made / "train/p00.jpg", made / "train/p01.jpg", made / "test/p03.jpg"):
        photo, _ = read_photo(path)
        assert (photo.exif.make, photo.exif.focal_mm, photo.exif.focal_35mm) == ("A", pytest.approx(4.2), 26)
        assert photo.exif.orientation == 1 and photo.plain
    assert Image.open(made / "train/p00.jpg").size == (120, 168)


def test_the_command_says_what_comes_next(photos: Path, tmp_path: Path) -> None:
    words = [str(photos), "-o", str(tmp_path / "my raw"), "--patches", "--presence", "0.5"]
    lines = CliRunner().invoke(command, words, catch_exceptions=False).stdout.splitlines()
    assert "11 train photos, 6 of them with distractors" in lines[0] and "2 test photos" in lines[0]
    assert lines[-1] == f"next: aw build-scene '{tmp_path / 'my raw'}' -o SCENE"


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        ([], "--cutouts FOLDER"),
        (["--path", "--fixed", "stamp"], "--path moves cut-outs, and none are given"),
        (["--patches", "--pose", "lying"], "--pose needs the depths"),
        (["--patches", "--shadow", "0.5"], "--shadow needs the depths"),
        (["--patches", "--coverage", "0.5", "--presence", "0.3"], "raise --presence"),
        (["--cutouts", "nowhere"], "no folder"),
    ],
)
def test_errors_say_what_to_do(photos: Path, tmp_path: Path, words: list[str], expected: str) -> None:
    error = CliRunner().invoke(command, [str(photos), "-o", str(tmp_path / "raw"), *words]).exception
    assert isinstance(error, AwError) and expected in str(error) and AwError.exit_code == 2
    assert list(tmp_path.iterdir()) == []


def test_few_damaged_and_equal_names_leave_nothing(photos: Path, tmp_path: Path) -> None:
    folder, out = tmp_path / "photos", tmp_path / "raw"
    folder.mkdir()
    for name in NAMES[:5]:
        (folder / f"{name}.jpg").write_bytes((photos / f"{name}.jpg").read_bytes())
    with pytest.raises(AwError, match="holds 5 photos itself, at least 6"):
        composite_photos(folder, out, CONFIG)
    (folder / "p05.jpg").write_bytes((photos / "p05.jpg").read_bytes()[:900])
    with pytest.raises(AwError, match=r"cannot read photo .*p05.jpg: .*; replace or remove it"):
        composite_photos(folder, out, CONFIG)
    (folder / "P05.png").write_bytes(b"")
    with pytest.raises(AwError, match=r"same name: P05.png, p05.jpg; rename"):
        composite_photos(folder, out, CONFIG)
    assert [p.name for p in tmp_path.iterdir()] == ["photos"]


def test_on_a_path_pieces_move_alike_from_photo_to_photo(sequence: Path) -> None:
    facts = json.loads((sequence / "truth/composite.json").read_text())
    ways: dict[int, list[tuple[int, float, float, float]]] = {}
    for name, photo in facts["photos"].items():
        for piece in photo["distractors"]:
            at = (int(Path(name).stem[1:]), piece["x"], piece["y"], piece["height"])
            ways.setdefault(piece["track"], []).append(at)
    speeds = []
    for way in (np.array(way) for way in ways.values() if len(way) > 3):
        steps = np.diff(way[:, 1:], axis=0) / np.diff(way[:, :1], axis=0)  # a photo, also across test photos
        speeds.append(steps[:, 0].mean())
        assert np.ptp(steps[:, 0]) < 1e-6 + 0.2 * abs(speeds[-1])  # the same speed, but for the growth
        assert np.ptp(steps[:, 1]) < 1e-9 and np.abs(steps[:, 1:]).max() < 0.1
        assert 0.02 < abs(speeds[-1]) < 0.25
    assert len(speeds) > 5 and np.ptp(np.abs(speeds)) > 0.02 and min(speeds) < 0 < max(speeds)


def test_on_a_path_pieces_enter_and_leave_and_masks_are_exact(sequence: Path) -> None:
    facts = json.loads((sequence / "truth/composite.json").read_text())
    shares = [photo["occlusion"] for photo in facts["photos"].values()]
    assert facts["occlusion"]["mean"] == pytest.approx(CONFIG.coverage, rel=0.1)
    assert np.mean(np.array(shares) > 0) == pytest.approx(CONFIG.presence, abs=0.15)
    assert np.abs(np.diff(shares)).max() < 0.2  # nothing appears all at once
    always = np.full((72, 128), True)
    for name in facts["photos"]:
        mask = read_gray(sequence / "truth/distractor" / f"{Path(name).stem}.png") > 0
        clean = read_png_rgb(sequence / "truth/clean" / f"{Path(name).stem}.png")
        photo = np.asarray(Image.open(sequence / "train" / name)).astype(int)
        gap = np.abs(photo - clean).max(2)
        assert (gap[mask] > 20).mean() > 0.95 if mask.any() else not gap.any()
        assert (gap[~mask] > 60).mean() < 0.02  # JPEG at the edges
        always &= mask
    assert not always.any()
    assert len(list((sequence / "test").iterdir())) == 10


def test_on_a_path_the_seed_decides_every_byte(photos: Path, tmp_path: Path) -> None:
    for name, seed in (("one", 0), ("again", 0), ("other", 1)):
        composite_photos(photos, tmp_path / name, replace(CONFIG, path=True, presence=1.0, seed=seed))
    one, again, other = (hashes(tmp_path / name) for name in ("one", "again", "other"))
    assert one == again and one != other


def test_on_a_path_strips_cannot_cover_much(photos: Path, tmp_path: Path) -> None:
    rgba = np.zeros((12, 400, 4), np.uint8)
    rgba[1:-1, 1:-1] = 255
    (tmp_path / "cutouts").mkdir()
    Image.fromarray(rgba).save(tmp_path / "cutouts/strip.png")
    with pytest.raises(AwError, match=r"--coverage 0.4 is more than --path can cover \(0\.\d\d with"):
        composite_photos(photos, tmp_path / "raw", CompositeConfig(0.4, path=True), tmp_path / "cutouts")
    assert [p.name for p in tmp_path.iterdir()] == ["cutouts"]
