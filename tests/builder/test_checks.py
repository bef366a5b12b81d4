"""Capture checks on captures whose fault is planted, and on the clean one that has none."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from ambiguous_wild.builder.checks import CaptureCheck, check_capture, noise, refuse_failed
from ambiguous_wild.builder.photo_comparison import (
    candidate_pairs,
    compare_photos,
    confirmed_matches,
    photo_features,
)
from ambiguous_wild.core import AwError
from ambiguous_wild.io.images import image_size
from tests.builder.capture_maker import eyes, render, texture, write_capture

COUNT = 8


@pytest.fixture(scope="module")
def clean() -> list[np.ndarray]:
    """Photos of the two walls, [H, W, 3] uint8."""
    return [render(eye, np.array([0.0, 0.0, 5.2])) for eye in eyes(COUNT)]


def checks(folder: Path, photos: list[np.ndarray]) -> dict[str, CaptureCheck]:
    folder.mkdir()
    for i, photo in enumerate(photos):
        cv2.imwrite(str(folder / f"p{i:02d}.png"), photo[:, :, ::-1])
    return {c.name: c for c in check_capture(folder).checks}


def lit(photo: np.ndarray, stops: np.ndarray | float) -> np.ndarray:
    """The photo with its light (linear, per channel) changed by so many stops."""
    codes = photo / 255.0
    linear = np.where(codes <= 0.04045, codes / 12.92, ((codes + 0.055) / 1.055) ** 2.4) * 2.0 ** np.asarray(
        stops
    )
    back = np.where(
        linear <= 0.0031308, 12.92 * linear, 1.055 * np.maximum(linear, 1e-9) ** (1 / 2.4) - 0.055
    )
    return (255 * back.clip(0, 1) + 0.5).astype(np.uint8)


def states(found: dict[str, CaptureCheck]) -> dict[str, str]:
    return {name: c.state for name, c in found.items()}


def test_a_good_capture_raises_no_alarm(clean: list[np.ndarray], tmp_path: Path) -> None:
    found = checks(tmp_path / "raw", clean)
    assert "warning" not in states(found).values(), found
    assert found["focal length"].state == "unknown" and found["ISO"].state == "unknown"
    assert all(c.advice == "" for c in found.values() if c.state == "ok")


def test_drifting_exposure_and_colour_are_measured_where_exif_is_silent(
    clean: list[np.ndarray], tmp_path: Path
) -> None:
    darker = [lit(p, -1.2 * i / (COUNT - 1)) for i, p in enumerate(clean)]
    found = checks(tmp_path / "dark", darker)
    assert found["exposure"].state == "warning" and "EXIF silent" in found["exposure"].basis
    assert found["white balance"].state == "ok"
    # 1.2 stops over the whole capture, 1.1 of them between the 5th and 95th percentile photo
    assert float(found["exposure"].finding.split()[-2]) == pytest.approx(1.1, abs=0.15)
    warm = [lit(p, np.array([0.6, 0.0, -0.6]) * i / (COUNT - 1)) for i, p in enumerate(clean)]
    found = checks(tmp_path / "warm", warm)
    assert found["white balance"].state == "warning" and found["exposure"].state == "ok"


def test_soft_photos_are_named_and_a_moving_focus_is_seen(clean: list[np.ndarray], tmp_path: Path) -> None:
    soft = list(clean)
    soft[3] = cv2.GaussianBlur(clean[3], (0, 0), 2.5)
    found = checks(tmp_path / "one", soft)
    assert found["blur"].state == "warning" and found["blur"].photos == ("p03.png",)
    moving = [cv2.GaussianBlur(p, (0, 0), 0.1 + 0.35 * i) for i, p in enumerate(clean)]
    assert checks(tmp_path / "all", moving)["focus"].state == "warning"


def test_a_stranger_does_not_hang_together_and_a_copy_is_a_duplicate(
    clean: list[np.ndarray], tmp_path: Path
) -> None:
    stranger = cv2.resize(texture(9), (320, 240))
    again = cv2.convertScaleAbs(clean[2], alpha=0.97)
    found = checks(tmp_path / "raw", [*clean, again, stranger])
    assert found["overlap"].photos == ("p09.png",)
    assert found["overlap"].finding.startswith("about 9 of 10 photos will be registered; the others share")
    assert found["overlap"].advice == "take 2 or 3 photos between p08.png and p09.png"
    assert found["near-duplicates"].photos == ("p08.png",)


def test_few_pairs_that_overlap_are_counted(clean: list[np.ndarray], tmp_path: Path) -> None:
    strangers = [cv2.resize(texture(20 + k), (320, 240)) for k in range(5)]
    few = checks(tmp_path / "few", [*clean[:3], *strangers])["overlap"]
    assert few.finding.endswith("; most pairs share too few features (3 of 28 share enough)")
    none = checks(tmp_path / "none", strangers)["overlap"].finding
    assert none.endswith("none will be registered; most pairs share too few features (0 of 10 share enough)")


@pytest.mark.parametrize("step", [0.12, 0.3])
def test_walking_where_one_looks_is_told(step: float, tmp_path: Path) -> None:
    ahead = [render(np.array([0.0, 0.0, step * k]), np.array([0.0, 0.0, 5.2])) for k in range(6)]
    assert checks(tmp_path / "forward", ahead)["motion"].state == "warning"


def test_strict_names_every_failed_check(clean: list[np.ndarray], tmp_path: Path) -> None:
    checks(tmp_path / "raw", clean)
    refuse_failed(check_capture(tmp_path / "raw"))
    (tmp_path / "raw/z.png").write_bytes(b"no photo")
    with pytest.raises(
        AwError, match=r"raw: 1 of 11 capture checks warn: files: 1 of 9 photos are left out: z\.png"
    ):
        refuse_failed(check_capture(tmp_path / "raw"))


def test_exif_decides_where_it_speaks(tmp_path: Path) -> None:
    from PIL import Image
    from PIL.TiffImagePlugin import IFDRational as rational

    write_capture(tmp_path / "raw", 4)
    for i, path in enumerate(sorted((tmp_path / "raw").iterdir())):
        image = Image.open(path)
        exif = Image.Exif()
        exif[0x0110] = "phone"
        camera = exif.get_ifd(0x8769)
        camera[0x829A], camera[0x829D] = rational(2**i, 100), rational(2, 1)
        camera[0x8827] = 100 * (i + 1)
        camera[0xA403], camera[0x920A] = 1, rational(4 + i, 1)
        image.save(path, quality=95, exif=exif)
    found = {c.name: c for c in check_capture(tmp_path / "raw").checks}
    # The photos are equally bright: the settings followed the light.
    said = "automatic: settings span 5.0 stops, the same surfaces differ by 0.0"
    assert found["exposure"] == CaptureCheck("exposure", "ok", "EXIF and pixels", said)
    assert found["white balance"] == CaptureCheck("white balance", "ok", "EXIF", "manual in every photo")
    assert found["ISO"].finding == "100 to 400" and found["ISO"].state == "warning"
    assert (
        found["focal length"].finding == "phone: 4.0 to 7.0 mm" and found["focal length"].state == "warning"
    )


def test_pairs_of_a_large_capture_grow_with_its_length() -> None:
    rng = np.random.default_rng(0)
    signs = [photo_features(rng.integers(0, 255, (40, 60, 3)).astype(np.uint8)) for _ in range(40)]
    pairs = candidate_pairs(signs)
    assert len(pairs) <= 40 * 12 and {(i, i + 1) for i in range(39)} <= set(pairs)
    assert len(candidate_pairs(signs[:5])) == 10


def test_featureless_photos_are_unknown_not_an_error() -> None:
    got = compare_photos([photo_features(np.full((60, 80, 3), 90, np.uint8))] * 3)
    assert np.isnan(got.offsets).all() and got.covisible.tolist() == [0, 0, 0] and not got.matches


def test_noise_of_a_grey_card_is_its_sigma() -> None:
    rng = np.random.default_rng(0)
    card = np.full((256, 256, 1), 120.0) + rng.normal(0, 4, (256, 256, 1))
    got = noise(np.repeat(card, 3, axis=2).round().astype(np.uint8))
    assert got == pytest.approx(4, rel=0.15)  # the flattest tenth lies below the mean
    assert np.isnan(noise(np.zeros((64, 64, 3), np.uint8)))


def test_matches_are_those_of_opencv():
    from ambiguous_wild.builder.photo_comparison import RATIO, _ratio_matches

    rng = np.random.default_rng(2)
    a = rng.integers(0, 256, (200, 128), dtype=np.uint8)
    b = rng.integers(0, 256, (150, 128), dtype=np.uint8)
    b[:80] = np.clip(a[40:120].astype(int) + rng.integers(-40, 41, (80, 128)), 0, 255)
    pairs = cv2.BFMatcher(cv2.NORM_L2).knnMatch(a.astype(np.float32), b.astype(np.float32), k=2)
    wanted = [(m.queryIdx, m.trainIdx) for m, n in pairs if m.distance < RATIO * n.distance]
    found = _ratio_matches(a, b)
    assert len(wanted) >= 80 and list(zip(*(part.tolist() for part in found))) == wanted


def test_few_matches_count_only_where_a_third_photo_confirms_them() -> None:
    def pair(count: int, shift: int = 0) -> tuple[np.ndarray, np.ndarray]:
        return np.arange(count), (np.arange(count) + shift) % 100

    strong = {(0, 1): pair(40), (1, 2): pair(40)}
    assert set(confirmed_matches({**strong, (0, 2): pair(13)})) == {(0, 1), (1, 2), (0, 2)}
    assert set(confirmed_matches({**strong, (0, 2): pair(13, shift=5)})) == {(0, 1), (1, 2)}  # other features
    assert set(confirmed_matches({**strong, (0, 2): pair(16, shift=5)})) == {(0, 1), (1, 2), (0, 2)}
    assert set(confirmed_matches({(0, 1): pair(40), (0, 2): pair(13)})) == {(0, 1)}  # no photo matches both


def test_the_command_draws_which_photos_overlap(clean: list[np.ndarray], tmp_path: Path) -> None:
    from click.testing import CliRunner

    from ambiguous_wild.cli.capture import screen_command

    checks(tmp_path / "raw", [*clean[:4], cv2.resize(texture(9), (320, 240))])
    drawn = check_capture(tmp_path / "raw").overlap_map()
    assert [p.kind for p in drawn.photos] == ["train"] * 4 + ["left out"]
    done = CliRunner().invoke(screen_command, [str(tmp_path / "raw"), "-o", str(tmp_path / "map.png")])
    assert done.exit_code == 0, done.output
    assert image_size(tmp_path / "map.png") == (1300, 860)
