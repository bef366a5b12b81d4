"""A scene that would give a wrong number is refused by whatever opens it; what is only unlikely is said."""

import re
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest

from ambiguous_wild.core import AwError
from ambiguous_wild.io.scene_folder import load_scene
from tests.command_line import aw
from tests.tiny_scene import FOCAL, HEIGHT, TEST, TRAIN, WIDTH, write_tiny_scene


def train_photo_as_test(root: Path) -> None:
    shutil.copy(root / "images" / TRAIN[0], root / "images" / TEST[0])


def train_photo_again_as_jpeg(root: Path) -> None:
    """Other bytes, the same pose and nearly the same picture."""
    photo = cv2.imread(str(root / "images" / TRAIN[0]))
    coded = cv2.imencode(".jpg", photo, [cv2.IMWRITE_JPEG_QUALITY, 97])[1]
    cv2.imwrite(str(root / "images" / TEST[0]), cv2.imdecode(coded, cv2.IMREAD_COLOR))
    text = (root / "sparse/0/images.txt").read_text()
    pose = re.search(rf"^\d+ (.*) {TRAIN[0]}$", text, re.M)[1]
    (root / "sparse/0/images.txt").write_text(
        re.sub(rf"^(\d+) .* {TEST[0]}$", rf"\1 {pose} {TEST[0]}", text, flags=re.M)
    )


def alpha(root: Path, *names: str) -> None:
    for name in names:
        photo = cv2.imread(str(root / "images" / name))
        shown = np.full((HEIGHT, WIDTH), 255, np.uint8)
        shown[:9] = 0
        cv2.imwrite(str(root / "images" / name), np.dstack([photo, shown]))


def one_pose(root: Path) -> None:
    text = (root / "sparse/0/images.txt").read_text()
    (root / "sparse/0/images.txt").write_text(
        re.sub(r"^(\d+) 1 0 0 0 \S+", r"\1 1 0 0 0 0", text, flags=re.M)
    )


def points_at(root: Path, xyz: str) -> None:
    lines = (root / "sparse/0/points3D.txt").read_text().splitlines()
    moved = [" ".join([(w := line.split())[0], *(xyz.split() or w[1:4]), *w[4:]]) for line in lines]
    (root / "sparse/0/points3D.txt").write_text("\n".join(moved) + "\n")


def points_behind(root: Path) -> None:
    text = (root / "sparse/0/points3D.txt").read_text()
    (root / "sparse/0/points3D.txt").write_text(text.replace(" 4.0 ", " -4.0 "))


def masks(root: Path, *names: str) -> None:
    (root / "masks").mkdir()
    for name in names:
        half = np.full((HEIGHT, WIDTH), 255, np.uint8)
        half[:9] = 0
        cv2.imwrite(str(root / "masks" / name), half)


def focal_lengths(root: Path) -> None:
    text = f"1 PINHOLE {WIDTH} {HEIGHT} {FOCAL} {10 * FOCAL} {WIDTH / 2} {HEIGHT / 2}\n"
    (root / "sparse/0/cameras.txt").write_text(text)


@pytest.mark.parametrize(
    ("spoil", "words"),
    [
        (train_photo_as_test, "test photos are training photos (test_0.png is train_0.png)"),
        (lambda root: alpha(root, *TEST), "alpha of 2 test photos hides pixels"),
        (one_pose, "all 6 cameras have one pose"),
        (lambda root: points_at(root, "0 0 4"), "all points of the sparse model lie at one place"),
        (points_behind, "no point of the sparse model lies in any training photo"),
        (lambda root: masks(root, "other.png"), "holds 1 mask, none of a photo of the scene (other.png)"),
    ],
)
def test_a_scene_that_would_give_a_wrong_number_is_refused_everywhere(tmp_path, spoil, words):
    scene = write_tiny_scene(tmp_path / "scene")
    spoil(scene)
    with pytest.raises(AwError) as refused:
        load_scene(scene)
    assert words in str(refused.value)
    for command in (
        ["bench", "--method", "3dgs", "--scene", scene, "--iterations", "20", "-o", tmp_path / "runs"],
        ["plan", scene, "--no-probe", "-o", tmp_path / "plan.json"],
        ["ambiguity-report", scene, "-o", tmp_path / "report"],
    ):
        answer = aw(*command)
        assert answer.returncode == 2 and words in " ".join(answer.stderr.split())
    assert sorted(p.name for p in tmp_path.iterdir()) == ["scene"]


@pytest.mark.parametrize(
    ("spoil", "words"),
    [
        (lambda root: masks(root, TRAIN[0]), "without a mask, so all of them trains: train_1.png"),
        (lambda root: masks(root, TRAIN[0], "typo.png"), "masks that belong to no photo: typo.png"),
        (lambda root: alpha(root, *TRAIN), "alpha of training photos is used as keep masks"),
        (train_photo_again_as_jpeg, "of one pose that look alike: test_0.png and train_0.png"),
        (focal_lengths, "focal lengths of x and y differ more than 2 times: "),
        (lambda root: (root / "train_list.txt").write_text(TRAIN[0]), "it has one training photo"),
    ],
)
def test_what_is_only_unlikely_is_said(tmp_path, spoil, words):
    scene = write_tiny_scene(tmp_path / "scene")
    spoil(scene)
    assert any(words in warning for warning in load_scene(scene).info["warnings"])


def test_a_mask_of_one_grey_is_no_mask(tmp_path):
    from ambiguous_wild.io.images import read_mask

    cv2.imwrite(str(tmp_path / "grey.png"), np.full((8, 8), 128, np.uint8))
    with pytest.raises(AwError, match="no mask of black and white"):
        read_mask(tmp_path / "grey.png")
