"""The ray caster against dense sampling of solids, and its two pictures against each other."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from ambiguous_wild.core import Camera
from ambiguous_wild.core.srgb import linear_to_srgb, srgb_to_linear
from ambiguous_wild.simulate import tracer
from ambiguous_wild.simulate.capture_writer import look_at, plan_capture
from ambiguous_wild.simulate.image_effects import PhotoRandom
from ambiguous_wild.simulate.kernels import BOX, CAPSULE, CYLINDER, ELLIPSOID, FAR, PLANAR, QUAD, _intersect
from ambiguous_wild.simulate.photo_render import compile_tracer, prepare_photo, trace_photo
from ambiguous_wild.simulate.presets import preset, resized
from ambiguous_wild.simulate.shapes import (
    UNSEEN,
    Shape,
    bounding_radius,
    capsule_between,
    shape_table,
    transformed,
)
from ambiguous_wild.simulate.tracer import Light, build_atlas, trace

HALF = (0.5, 0.5, 0.8)


def inside(kind: int, p: np.ndarray) -> np.ndarray:
    """Whether points [N, 3] lie in the solid, written from its definition."""
    x, y, z = np.abs(p).T
    if kind == BOX:
        return (x <= HALF[0]) & (y <= HALF[1]) & (z <= HALF[2])
    if kind == ELLIPSOID:
        return ((p / HALF) ** 2).sum(1) <= 1
    if kind == CAPSULE:
        return np.linalg.norm(np.column_stack([x, y, np.maximum(z - HALF[2], 0)]), axis=1) <= HALF[0]
    return (np.hypot(x, y) <= HALF[0]) & (z <= HALF[2])


@pytest.mark.parametrize("kind", [BOX, ELLIPSOID, CAPSULE, CYLINDER])
def test_first_hit_is_where_dense_samples_first_enter_the_solid(kind: int) -> None:
    rng = np.random.default_rng(kind)
    t = np.arange(0.0, 6.0, 2e-3)
    hits = 0
    for _ in range(150):
        start = rng.normal(size=3)
        start *= 2.5 / np.linalg.norm(start)
        direction = rng.uniform(-0.8, 0.8, 3) - start
        direction /= np.linalg.norm(direction)
        found = _intersect(kind, tuple(start), tuple(direction), HALF, FAR)
        within = inside(kind, start + t[:, None] * direction)
        if within.any():
            hits += 1
            assert found == pytest.approx(t[np.argmax(within)], abs=2.1e-3)
        elif found < FAR:  # only a graze may slip between the samples
            assert inside(kind, (start + found * direction)[None] * 0.999).all()
    assert hits > 50
    rim = rng.normal(size=(500, 3)) * 2
    assert bounding_radius(kind, HALF) >= np.linalg.norm(rim[inside(kind, rim)], axis=1).max()


def _scene() -> tuple[list[Shape], list[Shape], Light, dict[str, np.ndarray]]:
    rng = np.random.default_rng(3)
    textures = {n: rng.uniform(0.1, 0.9, (64, 64, 3)).astype(np.float32) for n in ("floor", "thing")}
    floor = Shape(QUAD, (0, 0, 0), (6, 6, 0), "floor", mapping=PLANAR, casts=False)
    ball = Shape(ELLIPSOID, (0.4, 0.3, 0.6), (0.6, 0.5, 0.6), "thing")
    post = capsule_between((-1, 0, 0), (-1.1, 0.3, 1.5), 0.2, "thing")
    sun = np.tile(np.array([0.4, -0.5, 0.77]) / np.linalg.norm([0.4, -0.5, 0.77]), (4, 1))
    light = Light(sun, np.ones(3), np.full(3, 0.5), np.full(3, 0.3))
    return [floor, ball], [replace(post, owner=1)], light, textures


def _camera(width: int = 80, height: int = 60) -> Camera:
    pose = look_at(np.array([0.2, -4.0, 1.6]), np.array([0.0, 0.0, 0.5]), 3.0)
    return Camera(width, height, 70.0, 70.0, width / 2, height / 2, pose)


def test_both_pictures_agree_to_the_bit_where_no_distractor_was_hit() -> None:
    static, moving, light, textures = _scene()
    atlas = build_atlas(textures)
    seen = trace(_camera(), shape_table(static, atlas), shape_table(moving, atlas), atlas, light)
    alone = trace(_camera(), shape_table(static, atlas), shape_table([], atlas), atlas, light)
    hit = seen.owner > 0
    assert 0.02 < hit.mean() < 0.5
    np.testing.assert_array_equal(seen.distracted[~hit], seen.clean[~hit])
    np.testing.assert_array_equal(seen.clean, alone.clean)  # a mover changes nothing of the static scene
    assert (np.abs(seen.distracted - seen.clean)[hit].sum(1) > 1e-4).mean() > 0.99
    assert not alone.owner.any()


def test_a_thrown_shadow_in_the_same_pass_is_that_of_a_pass_of_its_own() -> None:
    static, moving, light, textures = _scene()
    atlas = build_atlas(textures)
    nobody, people = shape_table([], atlas), shape_table(moving, atlas)
    x, y, z = 6.0 * light.sun[0]
    cloud = Shape(ELLIPSOID, (x + 0.3, y + 0.5, z), (0.9, 0.6, 0.4), "thing", owner=UNSEEN)
    thrown = shape_table([cloud], atlas)
    seen = trace(_camera(), shape_table(static, atlas), people, atlas, light, thrown)
    shaded = trace(_camera(), shape_table([*static, cloud], atlas), people, atlas, light)
    free = trace(_camera(), shape_table(static, atlas), nobody, atlas, light)
    np.testing.assert_array_equal(seen.clean, free.clean)
    np.testing.assert_array_equal(seen.distracted, shaded.distracted)
    np.testing.assert_array_equal(seen.owner, shaded.owner)
    np.testing.assert_array_equal(seen.shadow, (shaded.clean != free.clean).any(-1))
    assert seen.shadow is not None and 0.01 < seen.shadow.mean() < 0.5
    assert shaded.shadow is None and free.shadow is None


def test_a_distractor_behind_a_static_thing_is_not_seen() -> None:
    static, moving, light, textures = _scene()
    atlas = build_atlas(textures)
    wall = Shape(BOX, (0, -2.0, 1.0), (5, 0.05, 3.0), "thing")
    seen = trace(_camera(), shape_table([*static, wall], atlas), shape_table(moving, atlas), atlas, light)
    assert not seen.owner.any()


def test_depth_of_the_ground_is_that_of_the_plane() -> None:
    static, _, light, textures = _scene()
    atlas = build_atlas(textures)
    camera = _camera()
    depth = trace(camera, shape_table(static[:1], atlas), shape_table([], atlas), atlas, light).depth_m
    rows, cols = np.mgrid[40:60, 0:80] + 0.5
    rays = np.stack([(cols - camera.cx) / camera.fx, (rows - camera.cy) / camera.fy, np.ones_like(rows)], -1)
    up = rays @ camera.cam_from_world[:3, :3][:, 2]
    # The pixel holds the mean over four samples of a convex function of the row: 1 % at this size.
    np.testing.assert_allclose(depth[40:60], -camera.center[2] / up, rtol=0.01)


def test_fine_texture_far_away_turns_grey_instead_of_shimmering() -> None:
    checks = np.kron(np.indices((64, 64)).sum(0) % 2, np.ones((2, 2)))[..., None].repeat(3, 2)
    atlas = build_atlas({"checks": checks.astype(np.float32)})
    wall = Shape(
        QUAD, (0, 0, 0), (40, 40, 0), "checks", ((1, 0, 0), (0, 0, 1), (0, -1, 0)), PLANAR, (1.0, 1.0)
    )
    light = Light(np.tile([0.0, 0.0, 1.0], (4, 1)), np.zeros(3), np.full(3, 1.0), np.full(3, 1.0))
    camera = Camera(64, 48, 60.0, 60.0, 32, 24, look_at(np.array([0, -20.0, 0]), np.zeros(3), 0.0))
    seen = trace(camera, shape_table([wall], atlas), shape_table([], atlas), atlas, light)
    assert seen.clean.std() < 0.02  # unfiltered, its spread would be near 0.25
    np.testing.assert_allclose(seen.clean.mean(), 0.5, atol=0.02)


def test_colour_transfer_goes_there_and_back() -> None:
    x = np.linspace(0, 1, 257, dtype=np.float32)
    np.testing.assert_allclose(linear_to_srgb(srgb_to_linear(x)), x, atol=1e-5)
    assert srgb_to_linear(np.array(0.5)) == pytest.approx(0.21404, abs=1e-4)


def test_placing_keeps_distances() -> None:
    parts = [capsule_between((0, 0, 0), (0, 0.5, 1), 0.1, "x"), Shape(BOX, (1, 0, 0), (0.1, 0.2, 0.3), "x")]
    moved = transformed(parts, (3, -2, 1), 57.0, 2.0)
    gap = np.linalg.norm(np.subtract(parts[0].center, parts[1].center))
    assert np.linalg.norm(np.subtract(moved[0].center, moved[1].center)) == pytest.approx(2 * gap)
    for shape in moved:
        axes = np.array(shape.axes)
        np.testing.assert_allclose(axes @ axes.T, np.eye(3), atol=1e-12)


def test_the_kernels_that_are_compiled_ahead_are_those_of_a_capture():
    compile_tracer()
    spec = resized(preset("tiny"), views=3, width=64)
    world, photos = plan_capture(spec, 0)
    random = PhotoRandom(0, 0, 0.0)
    trace_photo(world, prepare_photo(spec, world, photos[0], random))
    assert len(tracer._tiles.signatures) == 1


GREY = {name: np.full((2, 2, 3), level, np.float32) for name, level in (("light", 0.8), ("dark", 0.05))}
FACING = ((1, 0, 0), (0, 0, 1), (0, -1, 0))  # axes of what faces -y
EVEN = Light(
    np.tile([0.0, 0.0, 1.0], (4, 1)), np.zeros(3), np.ones(3), np.ones(3)
)  # the same from everywhere


def _ahead(width: int = 120, height: int = 90) -> Camera:
    pose = look_at(np.array([0.0, -5.0, 1.0]), np.array([0.0, 0.0, 1.0]), 0.0)
    return Camera(width, height, 100.0, 100.0, width / 2, height / 2, pose)


def test_a_mirror_shows_what_stands_behind_it_in_a_reflected_world() -> None:
    """In the mirror in y = 0 a ball is seen as one at the reflected place is without it."""
    atlas = build_atlas(GREY)
    back = Shape(QUAD, (0, 6.0, 1), (30, 30, 0), "dark", FACING, PLANAR)
    front = replace(back, center=(0, -6.0, 1), axes=((1, 0, 0), (0, 0, -1), (0, 1, 0)))
    ball = Shape(ELLIPSOID, (0.9, -2.0, 1.3), (0.5, 0.5, 0.5), "light", owner=1)
    quad = Shape(QUAD, (0, 0, 1), (2.0, 1.5, 0), "dark", FACING, tint=(0.85,) * 3)
    mirrored = trace(
        _ahead(), shape_table([back, front], atlas), shape_table([ball], atlas), atlas, EVEN, None,
        shape_table([quad], atlas),
    )  # fmt: skip
    reflected = replace(ball, center=(0.9, 2.0, 1.3), owner=2)
    alone = trace(_ahead(), shape_table([back], atlas), shape_table([reflected, ball], atlas), atlas, EVEN)
    np.testing.assert_array_equal(mirrored.owner > 0, alone.owner > 0)  # itself and its image
    image = alone.owner == 2
    assert image.sum() > 100 and mirrored.shadow is None
    inner = image & (
        np.roll(image, 1, 0) & np.roll(image, -1, 0) & np.roll(image, 1, 1) & np.roll(image, -1, 1)
    )
    assert mirrored.distracted[inner] == pytest.approx(0.85 * alone.distracted[inner], rel=1e-5)
    assert mirrored.clean[inner] == pytest.approx(0.85 * alone.clean[inner], rel=1e-5)
    assert mirrored.depth_m[45, 60] == pytest.approx(5.0, abs=0.01) and alone.depth_m[45, 60] > 10


def test_a_pane_adds_what_it_reflects_and_only_what_changes_is_shadow() -> None:
    atlas = build_atlas(GREY)
    back = Shape(QUAD, (0, 6.0, 1), (30, 30, 0), "light", FACING, PLANAR)
    front = replace(back, texture="dark", center=(0, -6.0, 1), axes=((1, 0, 0), (0, 0, -1), (0, 1, 0)))
    behind = Shape(ELLIPSOID, (-0.8, 1.5, 1.0), (0.4, 0.4, 0.4), "dark", owner=1)
    before = Shape(ELLIPSOID, (0.6, -2.0, 1.3), (0.4, 0.4, 0.4), "light", owner=2)
    pane = shape_table([Shape(QUAD, (0, 0, 1), (2.0, 1.5, 0), "dark", FACING, tint=(0.0,) * 3)], atlas)
    static, people = shape_table([back, front], atlas), shape_table([behind, before], atlas)
    seen = trace(_ahead(), static, people, atlas, EVEN, None, pane)
    open_air = trace(_ahead(), static, people, atlas, EVEN)
    np.testing.assert_array_equal(seen.owner, open_air.owner)  # the reflection of a distractor is none
    rays = np.stack(np.meshgrid((np.arange(120) + 0.5 - 60) / 100, (np.arange(90) + 0.5 - 45) / 100), -1)
    share = 0.08 + 0.92 * (1 - 1 / np.sqrt(1 + (rays**2).sum(-1))) ** 5  # Schlick 1994
    inside = (np.abs(rays[..., 0]) < 0.38) & (np.abs(rays[..., 1]) < 0.28)
    plain = inside & (seen.owner == 0) & ~seen.shadow
    dark, light = 0.05, 0.8  # under light of 1 from everywhere
    expected = (1 - share) * light + share * dark
    assert seen.clean[inside][:, 0] == pytest.approx(expected[inside], abs=2e-4)
    np.testing.assert_array_equal(seen.distracted[plain], seen.clean[plain])
    assert 50 < seen.shadow.sum() < 2000  # the image of the light ball
    hidden = (open_air.owner == 1) & inside & ~seen.shadow
    assert np.median(seen.distracted[hidden][:, 0]) == pytest.approx(
        dark, abs=2e-3
    )  # behind: 0.92 + 0.08 of it
    assert open_air.shadow is None


def test_who_moves_during_the_exposure_is_there_at_each_instant_for_a_quarter_of_it() -> None:
    atlas = build_atlas(GREY)
    back = shape_table([Shape(QUAD, (0, 6.0, 1), (30, 30, 0), "dark", FACING, PLANAR)], atlas)
    x = np.array([-0.3, -0.1, 0.1, 0.3])
    posts = [
        Shape(BOX, (at, -2.0, 1.0), (0.36, 0.05, 0.5), "light", owner=1, instant=k) for k, at in enumerate(x)
    ]
    seen = trace(_ahead(), back, shape_table(posts, atlas), atlas, EVEN)
    row = seen.distracted[45, :, 0]
    centres = (np.arange(120) + 0.5 - 60) / 100 * 2.95  # m at the posts' front
    count = (np.abs(centres[:, None] - x) < 0.36).sum(1)
    edge = (np.abs(np.abs(centres[:, None] - x) - 0.36) < 0.04).any(1)
    assert row[~edge] == pytest.approx((0.05 + (0.8 - 0.05) * count / 4)[~edge], abs=1e-4)
    np.testing.assert_array_equal(seen.owner[45][~edge] > 0, count[~edge] > 0)
    assert set(count[~edge]) >= {0, 4}


def test_shadows_of_distractors_darken_what_the_truth_says_and_nothing_else() -> None:
    spec = replace(resized(preset("tiny"), views=4, width=128), detail_px_per_m=5.0, cast_shadows=True)
    world, shots = plan_capture(spec, 4)
    assert spec.has_shadows
    shares = []
    for number, shot in enumerate(shots[:4]):
        random = PhotoRandom(4, number, 0.0)
        cast = trace_photo(world, prepare_photo(spec, world, shot, random))
        without = trace_photo(world, prepare_photo(replace(spec, cast_shadows=False), world, shot, random))
        assert cast.shadow is not None and without.shadow is None
        np.testing.assert_array_equal(cast.clean, without.clean)
        np.testing.assert_array_equal(cast.owner, without.owner)
        outside = cast.owner == 0
        changed = (cast.distracted != cast.clean).any(-1) & outside
        np.testing.assert_array_equal(changed, cast.shadow & outside)
        assert (cast.distracted[changed] <= cast.clean[changed]).all()
        shares.append(changed.mean())
    assert 0.003 < np.mean(shares) < 0.2
