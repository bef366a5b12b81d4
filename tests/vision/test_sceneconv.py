"""Features trained on a scene: a wall of texture seen by a camera that moves sideways."""

from __future__ import annotations

import dataclasses

import cv2
import numpy as np
import pytest
import torch

from ambiguous_wild.core import AwError
from ambiguous_wild.vision import precompute
from ambiguous_wild.vision import sceneconv as module
from ambiguous_wild.vision.labhog import blurred_noisy_copy
from ambiguous_wild.vision.sceneconv import (
    SceneConv,
    SceneConvConfig,
    info_nce,
    sample,
)

HEIGHT, WIDTH, STEP, COUNT = 62, 90, 8, 5
QUICK = SceneConvConfig(widths=(8, 16, 24), channels=16, steps=80, anchors=96)


def texture(seed: int, height: int, width: int) -> np.ndarray:
    """Grey in the large, with fine grain: colour alone does not tell places apart."""
    rng = np.random.default_rng(seed)
    fine = cv2.GaussianBlur(rng.standard_normal((height, width, 1)), (0, 0), 2.0)[:, :, None]
    slow = cv2.GaussianBlur(rng.standard_normal((height, width, 3)), (0, 0), 9.0)
    image = 0.5 + 0.12 * fine / fine.std() + 0.05 * slow / slow.std()
    return image.clip(0, 1).astype(np.float32)


@pytest.fixture(scope="module")
def scene():
    """Photos [62, 90, 3] and the tracks of points on the wall, true by construction."""
    wall = texture(0, HEIGHT, WIDTH + STEP * (COUNT - 1))
    photos = [torch.from_numpy(wall[:, k * STEP : k * STEP + WIDTH].copy()) for k in range(COUNT)]
    places = np.random.default_rng(1).uniform((0, 0), (wall.shape[1], HEIGHT), (400, 2))
    point, photo, xy = [], [], []
    for k in range(COUNT):
        here = places - [k * STEP, 0]
        seen = np.flatnonzero((here[:, 0] >= 0) & (here[:, 0] < WIDTH))
        point.append(seen)
        photo.append(np.full(len(seen), k))
        xy.append(here[seen])
    return photos, (np.concatenate(point), np.concatenate(photo), np.concatenate(xy))


@pytest.fixture(scope="module")
def trained(scene):
    features = SceneConv(QUICK)
    features.fit_scene(*scene)
    return features


@pytest.mark.parametrize(("height", "width"), [(62, 90), (64, 88), (9, 8), (61, 91)])
def test_shape_and_length(trained, height, width):
    phi = trained(torch.from_numpy(texture(3, height, width)))
    assert phi.shape == (-(-height // 4), -(-width // 4), 16)
    assert phi.dtype == torch.float32
    assert torch.allclose((phi * phi).sum(2), torch.ones(phi.shape[:2]), atol=1e-3)


def test_training_finds_another_object_of_the_same_colours(scene, trained):
    """Grain from elsewhere, pasted into a photo: distances to a new imitated render tell where."""
    photos, _ = scene
    untrained = SceneConv(QUICK)
    torch.manual_seed(0)
    untrained.net = untrained._new_net().requires_grad_(False)

    def separation(features: SceneConv) -> float:
        shares = []
        for k, photo in enumerate(photos):
            other = photo.clone()
            other[20:44, 30:60] = torch.from_numpy(texture(100 + k, 24, 30))
            render = blurred_noisy_copy(photo, 50 + k)
            distance = (1 - (features(other) * features(render)).sum(2)).numpy()
            inside = np.zeros(distance.shape, dtype=bool)
            inside[6:10, 8:14] = True
            away = np.ones(distance.shape, dtype=bool)
            away[1:15, 3:19] = False  # what the pasted pixels reach
            shares.append((distance[inside][:, None] > distance[away][None]).mean())
        return float(np.mean(shares))

    assert separation(trained) > 0.97
    assert separation(trained) > separation(untrained) + 0.02


def test_same_scene_same_bits_whatever_the_thread_count_and_global_seed(scene):
    few = dataclasses.replace(QUICK, steps=10)
    once, again = SceneConv(few), SceneConv(few)
    once.fit_scene(*scene)
    threads = torch.get_num_threads()
    torch.manual_seed(77)
    before = torch.get_rng_state()
    try:
        torch.set_num_threads(2 if threads == 1 else 1)
        again.fit_scene(*scene)
        assert torch.get_num_threads() == (2 if threads == 1 else 1)
    finally:
        torch.set_num_threads(threads)
    assert torch.equal(before, torch.get_rng_state())
    one, two = once.net.state_dict(), again.net.state_dict()
    assert one.keys() == two.keys()
    assert all(torch.equal(one[name], two[name]) for name in one)


def test_the_cache_answers_for_the_same_scene_only(scene, trained, tmp_path, monkeypatch):
    photos, tracks = scene
    runs = []
    real = module.train

    def counted(*arguments):
        runs.append(1)
        return real(*arguments)

    monkeypatch.setattr(module, "train", counted)
    short = SceneConvConfig(widths=(4, 4, 4), channels=4, steps=2)
    first, second = SceneConv(short), SceneConv(short)
    first.fit_scene(photos, tracks, tmp_path)
    second.fit_scene(photos, tracks, tmp_path)
    assert len(runs) == 1
    assert torch.equal(first(photos[0]), second(photos[0]))
    assert first.unit == second.unit
    second.fit_scene(photos, (tracks[0], tracks[1], tracks[2] + 0.25), tmp_path)
    SceneConv(SceneConvConfig(widths=(4, 4, 4), channels=4, steps=3)).fit_scene(photos, tracks, tmp_path)
    second.fit_scene([1 - p for p in photos], tracks, tmp_path)
    assert len(runs) == 4
    # a damaged entry is made again
    for entry in tmp_path.glob("*.npz"):
        entry.write_bytes(b"nothing")
    precompute._tidy.cache_clear()
    first.fit_scene(photos, tracks, tmp_path)
    assert len(runs) == 5


def test_a_place_is_sampled_where_the_net_saw_it():
    """A cell's feature belongs to the centre of its 4x4 pixels; between cells it is linear."""
    ramp = torch.arange(6.0)[None, None, None].expand(1, 1, 5, 6)
    maps = torch.cat([ramp, torch.ones_like(ramp)], dim=1)
    found = sample(maps, np.array([[2.0, 2.0], [14.0, 6.0], [8.0, 10.0]]))
    assert torch.allclose(found[:, 0] / found[:, 1], torch.tensor([0.0, 3.0, 1.5]), atol=1e-5)


def test_info_nce_by_hand_and_neighbours_are_no_negatives():
    rng = np.random.default_rng(0)
    one, two = (rng.standard_normal((4, 3)) for _ in range(2))
    one /= np.linalg.norm(one, axis=1, keepdims=True)
    two /= np.linalg.norm(two, axis=1, keepdims=True)
    xy_one = np.array([[0.0, 0], [50, 0], [100, 0], [150, 0]])
    xy_two = np.array([[0.0, 0], [5, 0], [100, 0], [150, 0]])  # 0 and 1 are neighbours here only

    def by_hand(scores: np.ndarray, xy: np.ndarray) -> float:
        total = 0.0
        for k in range(4):
            rivals = [m for m in range(4) if m == k or np.abs(xy[m] - xy[k]).max() > 10]
            total += np.log(np.exp(scores[k, rivals]).sum()) - scores[k, k]
        return total / 4

    scores = one @ two.T / 0.2
    expected = 0.5 * (by_hand(scores, xy_two) + by_hand(scores.T, xy_one))
    found = info_nce(torch.from_numpy(one), torch.from_numpy(two), xy_one, xy_two, 0.2, 10.0)
    assert float(found) == pytest.approx(expected, rel=1e-9)


def test_large_photos_are_cut_around_a_shared_point(scene):
    photos, tracks = scene
    config = SceneConvConfig(widths=(4, 4, 4), channels=4, steps=4, window=32)
    features = SceneConv(config)
    features.fit_scene(photos, tracks)
    assert torch.isfinite(features(photos[0])).all()


def test_errors_name_what_to_do(scene):
    photos, (point, photo, xy) = scene
    with pytest.raises(AwError, match=r"sceneconv is not trained.*fit_scene"):
        SceneConv().fit(photos)
    with pytest.raises(AwError, match="without training photos"):
        SceneConv(QUICK).fit_scene([], (point, photo, xy))
    with pytest.raises(AwError, match=r"no two of 5 train photos share 32 SfM points .the most is 0.*labhog"):
        SceneConv(QUICK).fit_scene(photos, (np.arange(len(point)), photo, xy))
    with pytest.raises(AwError, match="photo 4 of 3: they belong to another split"):
        SceneConv(QUICK).fit_scene(photos[:3], (point, photo, xy))
    with pytest.raises(AwError, match="temperature"):
        SceneConvConfig(temperature=0.0)
