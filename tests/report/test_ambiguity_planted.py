"""The report on scenes whose class is planted, and on a simulated capture against its truth."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from scipy import ndimage

from ambiguous_wild.io.motion_points import FILE, MotionPoints, write_motion_points
from ambiguous_wild.io.scene_folder import load_scene
from ambiguous_wild.metrics.ambiguity import COLOUR_METRIC
from ambiguous_wild.report import ambiguity_measure, ambiguity_sources, ambiguity_summary
from ambiguous_wild.simulate.capture_writer import simulate
from ambiguous_wild.simulate.presets import preset
from ambiguous_wild.vision.labhog import LabHog
from ambiguous_wild.vision.segments import GraphSegments
from tests.tiny_scene import TRAIN, write_tiny_scene

W, H = 160, 120
OBJECT = (slice(70, 110), slice(10, 50))  # the static thing, in every photo at its place
SEMANTIC = "semantic_lookalike_labhog"


def stripes(h: int, w: int) -> np.ndarray:
    """Slanted stripes of blue and white."""
    i, j = np.mgrid[:h, :w]
    return np.where(((i + j) // 5 % 2)[..., None], [230, 235, 240], [30, 40, 200]).astype(np.uint8)


def plant(root: Path, kind: str) -> tuple[Path, Path]:
    """A scene of the class, and the masks of its static thing."""
    write_tiny_scene(root)
    (root / "truth/clean").mkdir()
    objects = root.parent / "objects"
    objects.mkdir()
    rng = np.random.default_rng(0)
    wall = cv2.resize(
        rng.integers(90, 150, (12, 16, 3)).astype(np.uint8), (W, H), interpolation=cv2.INTER_CUBIC
    )
    for k, name in enumerate(TRAIN):
        clean = np.roll(wall, 7 * k, axis=1)
        clean[OBJECT] = stripes(40, 40)
        photo, mask = clean.copy(), np.zeros((H, W), np.uint8)
        like_wall = (slice(8, 60), slice(10 + 4 * k, 60 + 4 * k))
        twin = (slice(10, 50), slice(100 + 3 * k, 140 + 3 * k))
        if kind in ("colour", "both"):
            photo[like_wall] = photo[like_wall] + 12
            mask[like_wall] = 255
        if kind in ("semantic", "both"):
            photo[twin] = stripes(40, 40)
            mask[twin] = 255
        if kind == "neither":
            photo[twin] = (250, 10, 120)
            mask[twin] = 255
        still = np.zeros((H, W), np.uint8)
        still[OBJECT] = 255
        for path, image in (("images", photo), ("truth/clean", clean)):
            cv2.imwrite(str(root / path / name), image[:, :, ::-1])
        cv2.imwrite(str(root / "truth/distractor" / name), mask)
        cv2.imwrite(str(objects / name), still)
    for name in ("test_0.png", "test_1.png"):
        cv2.imwrite(str(root / "images" / name), wall[:, :, ::-1])
    return root, objects


def points_in(where: tuple[slice, slice], moving: int) -> MotionPoints:
    """A grid of features in a part of the photo, that move or stay in three others."""
    y, x = (
        axis.ravel()
        for axis in np.mgrid[where[0].start : where[0].stop : 4, where[1].start : where[1].stop : 4]
    )
    votes = np.full(len(x), 3, np.uint8)
    return MotionPoints(
        np.column_stack([x / W, y / H]).astype(np.float32),
        votes * np.uint8(not moving),
        votes * np.uint8(moving),
        np.full(len(x), moving, np.int16),
    )


def test_each_distractor_is_told_by_what_tells_it(tmp_path):
    """A piece in the wall's colour is told by its motion alone, where the scene has it."""
    root, _ = plant(tmp_path / "scene", "colour")
    scene = load_scene(root, verify=False)
    masks = ambiguity_sources.find_masks(scene, None, None)
    background = ambiguity_sources.find_background(scene, None, None, masks)
    for motion in (None, 1, 0):
        if motion is not None:
            pieces = {
                n: points_in((slice(8, 60), slice(10 + 4 * k, 60 + 4 * k)), motion)
                for k, n in enumerate(TRAIN)
            }
            write_motion_points(root / FILE, pieces)
        measured = ambiguity_measure.measure(scene, masks, background)
        found = [d for m in measured.photos for d in m.distractors]
        assert len(found) == len(TRAIN) and {d.colour for d in found} == {False}
        assert {d.motion for d in found} == {None if motion is None else bool(motion)}
        told = ambiguity_summary.summarise(measured)["told"]
        assert told["motion"] == (None if motion is None else motion * len(TRAIN))


@pytest.mark.parametrize("kind", ["colour", "semantic", "both", "neither"])
def test_a_scene_is_classified_as_it_was_made(kind: str, tmp_path: Path) -> None:
    root, objects = plant(tmp_path / "scene", kind)
    facts = report(root, objects)
    assert facts["class"] == kind, facts
    assert facts[SEMANTIC]["unrelated"] < facts[SEMANTIC]["same_surface"] <= 1


def report(root: Path, objects: Path | None = None) -> dict:
    scene = load_scene(root)
    masks = ambiguity_sources.find_masks(scene, None, None)
    behind = ambiguity_sources.find_background(scene, None, None, masks)
    return ambiguity_summary.summarise(ambiguity_measure.measure(scene, masks, behind, objects=objects))


@pytest.fixture(scope="module")
def simulated(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A scene straight from a capture's truth: no COLMAP between."""
    root = tmp_path_factory.mktemp("simulated")
    spec = replace(preset("tiny"), train_views=4, test_views=2, width=160, height=90, detail_px_per_m=30.0)
    facts = simulate(spec, root / "raw", seed=3)
    scene = write_tiny_scene(root / "scene")
    for old in [*(scene / "images").iterdir(), *(scene / "truth/distractor").iterdir()]:
        old.unlink()
    (scene / "truth/clean").mkdir()
    names = []
    for photo in sorted((root / "raw/train").iterdir()):
        names.append(f"{photo.stem}.png")
        cv2.imwrite(str(scene / "images" / names[-1]), cv2.imread(str(photo)))
        for part in ("distractor", "clean"):
            data = (root / "raw/truth" / part / names[-1]).read_bytes()
            (scene / "truth" / part / names[-1]).write_bytes(data)
    poses = "".join(f"{k} 1 0 0 0 {-k} 0 0 1 {n}\n\n" for k, n in enumerate(names, 1))
    (scene / "sparse/0/images.txt").write_text(poses)
    (scene / "sparse/0/cameras.txt").write_text("1 PINHOLE 160 90 120 120 80 45\n")
    (scene / "sparse/0/points3D.txt").write_text("")
    (scene / "train_list.txt").write_text("\n".join(names) + "\n")
    (scene / "test_list.txt").write_text("")
    assert len(names) == len(facts["photos"]) == 4
    return scene


def test_scores_equal_a_direct_computation_from_the_truth(simulated: Path) -> None:
    facts = report(simulated)
    photos, masks, cleans = (
        [cv2.imread(str(p))[:, :, ::-1] / 255 for p in sorted((simulated / part).iterdir())]
        for part in ("images", "truth/distractor", "truth/clean")
    )
    covered = [m[..., 0] > 0.5 for m in masks]
    close = away = total = 0
    for photo, clean, mask in zip(photos, cleans, covered):
        for i, j in zip(*np.nonzero(mask)):
            distance = sum((photo[i, j, c] - clean[i, j, c]) ** 2 for c in range(3)) ** 0.5
            close, away, total = close + (distance < 0.3), away + distance, total + 1
    assert facts["occlusion"]["value"] == pytest.approx(np.mean([m.mean() for m in covered]), abs=1e-6)
    assert facts[COLOUR_METRIC]["value"] == pytest.approx(close / total, abs=1e-6)
    assert facts[COLOUR_METRIC]["mean_residual"] == pytest.approx(away / total, abs=1e-6)
    assert facts[COLOUR_METRIC]["distractor_px"] == total


@pytest.mark.parametrize("named", [True, False])
def test_cosines_and_the_share_equal_a_direct_computation(named: bool, tmp_path: Path) -> None:
    root, objects = plant(tmp_path / "scene", "both")
    compare(root, objects if named else None)


def test_of_a_simulated_capture_they_do_too(simulated: Path) -> None:
    compare(simulated, None)


def number(root: Path) -> None:
    """Give the planted scene numbers, as a simulated capture has: two of two halves that touch."""
    for part in ("instances", "objects"):
        (root / "truth" / part).mkdir()
    for k, name in enumerate(TRAIN):
        movers, still = np.zeros((H, W), np.uint8), np.zeros((H, W), np.uint8)
        movers[8:60, 10 + 4 * k : 60 + 4 * k] = 2
        movers[10:50, 100 + 3 * k : 118 + 3 * k] = 3
        movers[10:50, 118 + 3 * k : 140 + 3 * k] = 1
        still[OBJECT] = 9
        still[OBJECT[0], 10:26] = 4
        still[0:20, 100:150] = 5  # partly behind a distractor
        cv2.imwrite(str(root / "truth/instances" / name), movers)
        cv2.imwrite(str(root / "truth/objects" / name), still)


def test_numbers_of_a_capture_tell_what_touches_apart(tmp_path: Path) -> None:
    root, objects = plant(tmp_path / "scene", "both")
    number(root)
    compare(root, None)
    scene = load_scene(root)
    masks = ambiguity_sources.find_masks(scene, None, None)
    behind = ambiguity_sources.find_background(scene, None, None, masks)
    measured = ambiguity_measure.measure(scene, masks, behind)
    sizes = {1: 40 * 22, 2: 52 * 50, 3: 40 * 18}
    assert measured.objects
    for photo in measured.photos:
        assert {d.label: d.pixels for d in photo.distractors} == sizes
    # a user's own masks are other distractors, which have no numbers
    shutil.copytree(root / "truth/distractor", tmp_path / "own")
    own = ambiguity_sources.find_masks(scene, str(tmp_path / "own"), None)
    measured = ambiguity_measure.measure(scene, own, behind, objects=objects)
    assert {len(photo.distractors) for photo in measured.photos} == {2}


def compare(root: Path, objects: Path | None) -> None:
    """The report's semantic numbers against loops over pixels and regions."""
    facts = report(root, objects)[SEMANTIC]
    names = sorted(p.name for p in (root / "truth/distractor").iterdir())
    photos = [
        torch.from_numpy((cv2.imread(str(root / "images" / n))[:, :, ::-1] / 255).astype(np.float32))
        for n in names
    ]
    features, segments = LabHog(), GraphSegments()
    features.fit(photos)
    grids = np.stack([features(p).numpy() for p in photos]).astype(float)
    flat = grids.reshape(-1, grids.shape[-1])
    scale = np.where(flat.std(0) > 1e-9, flat.std(0), np.inf)
    values, vectors = np.linalg.eigh(np.cov((flat / scale).T, bias=True))
    matrix = vectors / np.sqrt(np.maximum(values, values.max() / 1000))
    grids = ((grids - flat.mean(0)) / scale) @ matrix

    def mean(k: int, mask: np.ndarray) -> np.ndarray:
        h, w = mask.shape
        rows, columns = np.nonzero(mask)
        cells = grids[k][rows * grids.shape[1] // h, columns * grids.shape[2] // w]
        return cells.mean(0) / np.linalg.norm(cells.mean(0))

    def parts(k: int, labels: np.ndarray) -> list[tuple[int, np.ndarray]]:
        masks = [labels == r for r in range(1, labels.max() + 1)]
        return [(m.sum(), mean(k, m)) for m in masks if m.sum() >= 0.002 * labels.size]

    moving, still, every = [], [], []
    for k, name in enumerate(names):
        distractor = cv2.imread(str(root / "truth/distractor" / name), 0) > 127
        numbers = [cv2.imread(str(root / "truth" / part / name), 0) for part in ("instances", "objects")]
        moving.append(parts(k, ndimage.label(distractor)[0] if numbers[0] is None else numbers[0]))
        every.append(parts(k, np.where(distractor, 0, segments.labels(photos[k]))))
        if objects is not None:
            things = (cv2.imread(str(objects / name), 0) > 127) & ~distractor
            still.append(parts(k, ndimage.label(things)[0]))
        elif numbers[1] is not None:
            still.append(parts(k, np.where(distractor, 0, numbers[1])))

    def best(k: int, unit: np.ndarray, statics: list) -> float:
        return max(unit @ u for j, other in enumerate(statics) if j != k for _, u in other)

    usual = np.quantile([best(k, u, every) for k, of in enumerate(every) for _, u in of], 0.05)
    found = [[(px, best(k, u, still or every)) for px, u in of] for k, of in enumerate(moving)]
    alike = sum(px for of in found for px, cosine in of if cosine >= usual)
    total = sum(px for of in found for px, _ in of)
    assert facts["usual_match"] == pytest.approx(usual, abs=1e-4)
    assert facts["value"] == pytest.approx(alike / total, abs=1e-6)
    tops = [max(cosine for _, cosine in of) for of in found if of]
    assert facts["cosine_most_similar"] == pytest.approx(np.mean(tops), abs=1e-4)
