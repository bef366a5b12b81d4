"""What the sparse points add to masks: a surface where the render has none, and who looks there at all."""

import numpy as np
import pytest

from ambiguous_wild.core import Camera
from ambiguous_wild.methods.refinesplat.hyperparameters import MaskConfig
from ambiguous_wild.methods.refinesplat.multiview import MultiViewConfig
from ambiguous_wild.vision.sparse_surface import rarely_covered, static_surfaces
from tests.methods.on_device import noise
from tests.methods.test_refinesplat_pixels import (
    PLANE,
    H,
    W,
    asked,
    camera,
    looked,
    masks_of,
    others_of,
    pixel_evidence,
    store,
)

CAR = np.s_[12:28, 20:44]


def slope(cam: Camera, shape: tuple[int, int]) -> np.ndarray:
    """Depth [h, w] of the world plane z = PLANE + 0.3 x + 0.2 y in a camera that only shifts along x."""
    x = ((np.arange(shape[1]) + 0.5) * (W / shape[1]) - cam.cx) / cam.fx
    y = ((np.arange(shape[0]) + 0.5) * (H / shape[0]) - cam.cy) / cam.fy
    shift = -cam.cam_from_world[0, 3]
    return (PLANE + 0.3 * shift) / (1.0 - 0.3 * x[None, :] - 0.2 * y[:, None])


def told(renders, *, known=True, size=(H // 2, W // 2), **config):
    """What the others say to view 0; `renders` are factors of the true depth that renders show."""
    cameras = [camera(0.1 * i) for i in range(len(renders))]
    surfaces = [(1.0 / slope(c, size)).astype(np.float32) for c in cameras] if known else ()
    photos = [np.full((H, W, 3), 0.5, np.float32)] * len(renders)
    other_views = others_of(cameras, photos, MultiViewConfig(**config), surfaces)
    for view, factor in enumerate(renders):
        store(other_views, view, noise(view, H, W), factor * slope(cameras[view], (H, W)))
    return asked(other_views, 0)


@pytest.mark.parametrize("others", [1.0, 3.0])  # whether their renders know the surface
def test_a_render_without_the_surface_is_told_what_one_with_it_is(others):
    right = told([1.0] * 5, known=False)
    wrong = told([2.5, *[others] * 4])
    assert np.isfinite(right.evidence).mean() > 0.9
    assert np.array_equal(np.isfinite(wrong.evidence), np.isfinite(right.evidence))
    assert np.allclose(wrong.evidence, right.evidence, atol=0.003, equal_nan=True)
    assert np.ptp(right.evidence[np.isfinite(right.evidence)]) > 0.1  # or anything would be close
    never = told([2.5, *[others] * 4], sparse=False)
    assert np.isnan(never.evidence).all()


def test_a_map_of_another_size_says_the_same():
    halves, thirds = told([2.5, *[1.0] * 4]), told([2.5, *[1.0] * 4], size=(H // 3, W // 3))
    inside = np.s_[2:-2, 2:-5]
    assert np.allclose(halves.evidence[inside], thirds.evidence[inside], atol=0.03)


def test_where_the_render_is_seen_by_enough_nobody_is_asked_again():
    """And three photos never have enough: a sparse surface that fewer see must not take what was heard."""
    for views in (3, 5):
        cameras = [camera(0.1 * i) for i in range(views)]
        far = [np.full((H // 2, W // 2), 1.0 / (4 * PLANE), np.float32)] * views
        with_, without = (
            others_of(cameras, [np.full((H, W, 3), 0.5, np.float32)] * views, MultiViewConfig(), s)
            for s in (far, ())
        )
        for view in range(views):
            for other_views in (with_, without):
                store(other_views, view, noise(view, H, W), np.full((H, W), PLANE))
        a, b = asked(with_, 1), asked(without, 1)
        middle = np.s_[:, 6:-6]  # which all see
        assert np.isfinite(b.evidence[middle]).all()
        assert np.array_equal(a.evidence[middle], b.evidence[middle])
        assert np.array_equal(a.weight[middle], b.weight[middle])


@pytest.mark.parametrize("views", [3, 7])
@pytest.mark.parametrize("plain", [True, False])
def test_a_car_before_a_field_that_is_not_learnt_is_not_excused(views, plain):
    """Its colour is neither weather nor, with three photos, something that few are heard on anyway."""
    photos = [np.array([0.35, 0.45, 0.25], np.float32) + 0.02 * noise(i, H, W, 3) for i in range(views)]
    photos[0][CAR] = [0.8, 0.15, 0.15] if plain else noise(9, 16, 24, 3).round()
    cameras = [camera(0.02 * i) for i in range(views)]
    surfaces = [np.full((H // 2, W // 2), 1.0 / PLANE, np.float32)] * views
    other_views = others_of(cameras, photos, MultiViewConfig(), surfaces)
    for view in range(views):
        depth = np.full((H, W), PLANE)
        if view == 0:
            depth[CAR] = 2.5 * PLANE
        store(other_views, view, np.ones((H, W)), depth)
    found = asked(other_views, 0)
    car = np.s_[8:12, 12:20]
    assert np.isfinite(found.evidence[car]).all()  # they do see what is behind it
    assert found.weight[car].mean() < 0.1  # a pixel may look like the field by chance
    assert found.weight[:4, 10:22].min() == 1.0  # and the field is excused


def looking(rng: np.random.Generator, away: bool = False) -> Camera:
    """A camera of any size above a slab of points, which it looks at or not."""
    centre = np.array([rng.uniform(-4, 4), -4.0, rng.uniform(-4, 4)])
    to = rng.uniform(-1, 1, 3) - centre if not away else np.array([0.1, -5.0, 0.0])
    z = to / np.linalg.norm(to)
    x = np.cross([0.0, 1.0, 0.0], z)
    x /= np.linalg.norm(x)
    pose = np.eye(4)
    pose[:3, :3] = np.stack([x, np.cross(z, x), z])
    pose[:3, 3] = -pose[:3, :3] @ centre
    width, height = [(201, 151), (130, 301), (64, 48), (777, 333)][rng.integers(4)]
    focal = rng.uniform(0.6, 1.2) * width
    return Camera(width, height, focal, 1.02 * focal, 0.48 * width, 0.53 * height, pose)


@pytest.mark.parametrize("least", [0, 1, 2, 4])
def test_who_has_a_place_in_the_frame_is_counted_one_by_one(least):
    rng = np.random.default_rng(1)
    points = rng.uniform(-1, 1, (900, 3)) * [3, 0.3, 3]
    cameras = [looking(rng) for _ in range(8)] + [looking(rng, away=True)]
    surfaces = static_surfaces(cameras, points)
    assert surfaces[-1] is None
    found = rarely_covered(cameras, surfaces, least)
    assert found[-1] is None
    checked = 0
    for view, (few, inverse) in enumerate(zip(found[:-1], surfaces[:-1])):
        cam = cameras[view]
        (h, w), (rows, columns) = inverse.shape, few.shape
        for i in range(0, rows, 5):
            for j in range(0, columns, 5):
                near = inverse[i * h // rows, j * w // columns]
                if not np.isfinite(near):
                    continue
                u, v = (j + 0.5) * cam.width / columns, (i + 0.5) * cam.height / rows
                local = [(u - cam.cx) / cam.fx / near, (v - cam.cy) / cam.fy / near, 1 / near, 1.0]
                world = np.linalg.inv(cam.cam_from_world) @ local
                count = 0
                for other, o in enumerate(cameras):
                    x, y, z, _ = o.cam_from_world @ world
                    if other != view and z > 0:
                        count += 0 <= x / z * o.fx + o.cx < o.width and 0 <= y / z * o.fy + o.cy < o.height
                assert few[i, j] == (count < least)
                checked += 1
    assert checked > 200


def test_outside_the_points_the_nearest_depth_holds_and_one_photo_asks_nobody():
    cameras = [camera(x) for x in (0.0, 0.2, 0.4)]
    surface = np.full((H, W), np.nan, np.float32)
    surface[5:9, 30:34] = 1.0 / PLANE
    whole = np.full((H, W), 1.0 / PLANE, np.float32)
    for a, b in zip(rarely_covered(cameras, [surface] * 3, 2), rarely_covered(cameras, [whole] * 3, 2)):
        assert np.array_equal(a, b) and a.any() and not a.all()
    assert not rarely_covered(cameras[:1], [whole], 2)[0].any()
    two = rarely_covered(cameras[:2], [whole] * 2, 2)[0]
    assert two[:, 0].all() and not two[:, 5:].any()  # one other is all there is
    assert rarely_covered(cameras[:1], [np.full((H, W), np.nan)], 2) == [None]


def evidence_of(cameras, surfaces, **config):
    photos = [np.full((H, W, 3), 0.5, np.float32) + 0.1 * noise(i, H, W, 3) for i in range(len(cameras))]
    pixels = pixel_evidence(photos, cameras, surfaces, multiview=MultiViewConfig(**config))
    renders = [noise(9 + view, H, W, 3) for view in range(len(cameras))]
    for last in (True, False):  # a view that is looked at before all others has nobody who sees the same
        found = [looked(pixels, view, render, store=last) for view, render in enumerate(renders)]
    return pixels, found


def test_where_nobody_else_looks_nothing_is_evidence_and_nothing_is_normal():
    cameras = [
        camera(x) for x in (0.0, 0.2, 0.4, 20.0, 40.0, 60.0, 80.0)
    ]  # four see none of the others' places
    surfaces = [np.full((H, W), 1.0 / PLANE, np.float32)] * 7
    pixels, found = evidence_of(cameras, surfaces)
    assert (found[0][:, :2] == 0.0).all() and found[0][:, 8:].min() > 0.0
    assert (found[0][~pixels.seen[0].numpy()] == 0.0).all()
    assert all((f == 0.0).all() for f in found[3:])
    assert pixels.normal.isfinite().tolist() == [True] * 3 + [False] * 4
    everywhere, found = evidence_of(cameras, surfaces, seen_by=0)
    assert everywhere.seen[0] is None and found[0][:, :2].min() > 0.0
    assert everywhere.normal.isfinite().all()
    without, found = evidence_of(cameras, ())
    assert without.seen[0] is None and (found[0][:, :1] == 0.0).all() and found[0][:, 8:].min() > 0.0


@pytest.mark.parametrize("settings", [{}, {"combine": "union"}, {"use_global": False}, {"dilation": 5}])
def test_an_instance_is_judged_by_what_may_be_judged_and_masked_whole(settings):
    labels = np.zeros((H, W), np.int32)
    labels[10:30, 20:40] = 1
    unseen = np.zeros((H, W), bool)
    unseen[:, :30] = True
    values = np.where(labels > 0, 13.0, 1.0)
    values[unseen] = 0.0
    config = MaskConfig(threshold="hard", hard=10.0, **settings)
    keep = masks_of(values, labels, config, unseen=unseen).keep.numpy()
    assert (keep[10:30, 20:40] == 0.0).all()
    assert (keep[unseen & (labels == 0)] == 1.0).all()
