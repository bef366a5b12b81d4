"""SIFT of OpenCV in COLMAP's form: places, order, masks, and the same for any number of threads."""

import cv2
import numpy as np
import pytest

from ambiguous_wild.builder.sfm_worker import features_of, sift


def blobs(height=240, width=320, seed=0):
    """Photo with bright discs at known places; [N, 3] x, y in COLMAP's pixels, radius."""
    rng = np.random.default_rng(seed)
    photo = np.full((height, width), 90, np.uint8)
    places = []
    for x in range(40, width - 30, 50):
        for y in range(40, height - 30, 50):
            radius = int(rng.integers(5, 9))
            cv2.circle(photo, (x, y), radius, 220, -1, cv2.LINE_AA)
            places.append((x + 0.5, y + 0.5, radius))  # the centre of pixel x
    return photo, np.array(places)


def test_discs_are_found_at_their_places():
    photo, places = blobs()
    points, words = sift(photo, 3000)
    assert points.shape[1] == 4 and words.shape == (len(points), 128) and words.dtype == np.uint8
    for x, y, radius in places:
        near = points[np.hypot(points[:, 0] - x, points[:, 1] - y) < 0.3]
        assert len(near) and np.any(np.abs(near[:, 2] - radius / 2**0.5) < 0.35 * radius)
    assert np.all(np.diff(points[:, 2]) <= 0)
    # unit length of the square roots, in bytes; elements above a half are cut
    assert (
        400
        < np.linalg.norm(words.astype(float), axis=1).min()
        <= np.linalg.norm(words.astype(float), axis=1).max()
        < 520
    )


def test_the_largest_are_kept():
    photo, _ = blobs()
    every, _ = sift(photo, 3000)
    some, words = sift(photo, 7)
    assert len(np.unique(some[:, :3], axis=0)) == 7 <= len(some) == len(words)
    assert some[-1, 2] >= every[len(some) :, 2].max()


def test_nothing_is_found_in_nothing():
    points, words = sift(np.full((100, 100), 128, np.uint8), 3000)
    assert points.shape == (0, 4) and words.shape == (0, 128)


@pytest.mark.parametrize("side", [1000, 160])
def test_photos_of_a_folder(side, tmp_path):
    """Places are those of the whole photo, if it is reduced too; black parts of a mask show nothing."""
    photo, places = blobs(480, 640)
    mask = np.full(photo.shape, 255, np.uint8)
    mask[:, :300] = 0
    (tmp_path / "masks").mkdir()
    names = ["a.png", "b.png", "c.png"]
    for name in names:
        cv2.imwrite(str(tmp_path / name), photo)
        cv2.imwrite(str(tmp_path / "masks" / f"{name}.png"), mask)
    runs = [list(features_of(tmp_path, tmp_path / "masks", names, 500, side, jobs)) for jobs in (1, 3)]
    for (name, points, words), (again, points2, words2), asked in zip(*runs, names):
        assert name == again == asked
        assert np.array_equal(points, points2) and np.array_equal(words, words2)
        assert len(points) and points[:, 0].min() >= 298 and points[:, 0].max() > 500
    if side == 1000:
        shown = places[places[:, 0] > 310]
        far = [np.hypot(*(runs[0][0][1][:, :2] - p[:2]).T).min() for p in shown]
        assert np.median(far) < 0.3
    with pytest.raises(OSError, match=r"d\.png"):
        list(features_of(tmp_path, None, ["d.png"], 500, side, 1))
