"""The first look: who passes by is left out before any training, whatever surfaces cannot be told counts."""

import dataclasses

import numpy as np
import pytest

from ambiguous_wild.core import Camera
from ambiguous_wild.methods.refinesplat.mask_prior import InitialMaskPriorConfig, initial_mask_prior
from ambiguous_wild.vision.sparse_surface import static_surfaces

WIDTH, HEIGHT, FOCAL = 64, 48, 60.0
VIEWS, DEPTH = 7, 4.0
JUDGE_ALL = InitialMaskPriorConfig(least=0.0)


def camera(view: int) -> Camera:
    pose = np.eye(4)
    pose[0, 3] = 0.12 * (view - VIEWS // 2)
    return Camera(WIDTH, HEIGHT, FOCAL, FOCAL, WIDTH / 2, HEIGHT / 2, pose)


def wall(view: int) -> np.ndarray:
    """The photo [H, W, 3] of a wall at DEPTH whose colour changes slowly along x and y."""
    u, v = np.meshgrid(np.arange(WIDTH) + 0.5, np.arange(HEIGHT) + 0.5)
    x = (u - WIDTH / 2) / FOCAL * DEPTH - camera(view).cam_from_world[0, 3]
    y = (v - HEIGHT / 2) / FOCAL * DEPTH
    return np.stack([0.5 + 0.2 * np.sin(2 * x), 0.5 + 0.2 * np.cos(1.5 * y), 0.4 + 0.05 * x], axis=2)


def points() -> np.ndarray:
    x, y = np.meshgrid(np.linspace(-3.2, 3.2, 24), np.linspace(-2.4, 2.4, 18))
    return np.stack([x.ravel(), y.ravel(), np.full(x.size, DEPTH)], axis=1)


def passers(shift: int = 9) -> tuple[list[np.ndarray], list[np.ndarray]]:
    """Photos with a square that stands elsewhere in each, and where it stands."""
    photos, masks = [], []
    for view in range(VIEWS):
        mask = np.zeros((HEIGHT, WIDTH), bool)
        mask[14:34, 2 + shift * view % 44 :][:, :16] = True
        photos.append(np.where(mask[..., None], [0.9, 0.1, 0.2], wall(view)))
        masks.append(mask)
    return photos, masks


def looks(photos, config=None, cloud=None, moving=None, certain=None):
    cameras = [camera(view) for view in range(VIEWS)]
    surfaces = static_surfaces(cameras, points() if cloud is None else cloud)
    moves = None if moving is None else [np.full(surface.shape, moving, np.float32) for surface in surfaces]
    sure = None if certain is None else [np.full(s.shape, certain) for s in surfaces]
    return initial_mask_prior(cameras, photos, surfaces, config or JUDGE_ALL, moves, sure)


def keeps(photos, config=None, cloud=None):
    return [look and look.keep((HEIGHT, WIDTH)) for look in looks(photos, config, cloud)]


def share_of(keep: np.ndarray, where: np.ndarray) -> float:
    return float((~keep)[where].mean())


def test_what_no_other_photo_shows_waits_and_the_wall_does_not():
    photos, masks = passers()
    for keep, mask in zip(keeps(photos), masks):
        assert keep.shape == (HEIGHT, WIDTH)
        assert share_of(keep, mask) > 0.85
        assert share_of(keep, ~mask) < 0.06


def test_a_wall_alone_counts_whole():
    photos = [wall(view) for view in range(VIEWS)]
    assert keeps(photos, InitialMaskPriorConfig()) == [None] * VIEWS
    assert all(keep.all() for keep in keeps(photos, JUDGE_ALL))


def test_a_start_can_bear_a_little():
    photos, masks = passers()
    share = float(np.mean(masks))
    assert all(keep is not None for keep in keeps(photos, InitialMaskPriorConfig(least=0.6 * share)))
    assert keeps(photos, InitialMaskPriorConfig(least=1.5 * share)) == [None] * VIEWS


def test_a_photo_of_other_exposure_is_not_left_out():
    photos = [wall(view) for view in range(VIEWS)]
    photos[3] = photos[3] + 0.2
    assert np.mean(~keeps(photos)[3]) < 0.05
    assert all(np.mean(~keep) < 0.05 for keep in keeps(photos))


@pytest.mark.parametrize("gain", [False, True])
def test_photos_of_other_exposures_each_are_no_crowd(gain):
    photos, masks = passers()
    rng = np.random.default_rng(2)
    change = [rng.uniform(0.6, 1.4) if gain else rng.uniform(-0.2, 0.2) for _ in photos]
    changed = [p * c if gain else p + c for p, c in zip(photos, change)]
    found = looks(changed, dataclasses.replace(JUDGE_ALL, crowd_weight=4.0))
    assert {look.weight for look in found} == {JUDGE_ALL.weight}
    assert wrong(changed, masks, JUDGE_ALL) < wrong(photos, masks, JUDGE_ALL) + 0.02


def test_where_nothing_is_known_everything_counts():
    photos, _ = passers()
    assert keeps(photos, cloud=points()[:3]) == [None] * VIEWS
    left = points()[points()[:, 0] < 0]
    right = np.s_[:, WIDTH // 2 + 14 :]  # no sparse point of a wall there
    assert all(keep[right].all() for keep in keeps(photos, cloud=left))
    alone = dataclasses.replace(JUDGE_ALL, known_by=VIEWS)  # more than there are others
    assert keeps(photos, alone) == [None] * VIEWS


def test_what_stands_still_before_the_wall_is_no_passer():
    """A static box before the wall hides it; views that see past it do not speak of the box's pixels."""
    box = np.array([[0.0, 0.0, 2.5]]) + np.stack(
        [*np.meshgrid(np.linspace(-0.4, 0.4, 9), np.linspace(-0.4, 0.4, 9)), np.zeros((9, 9))], axis=2
    ).reshape(-1, 3)
    photos = []
    for view in range(VIEWS):
        u, v = np.meshgrid(np.arange(WIDTH) + 0.5, np.arange(HEIGHT) + 0.5)
        x = (u - WIDTH / 2) / FOCAL * 2.5 - camera(view).cam_from_world[0, 3]
        y = (v - HEIGHT / 2) / FOCAL * 2.5
        on = (np.abs(x) < 0.4) & (np.abs(y) < 0.4)
        photos.append(np.where(on[..., None], [0.8, 0.3, 0.1], wall(view)))
    found = keeps(photos, cloud=np.concatenate([points(), box]))
    assert np.mean([~keep for keep in found]) < 0.06


def test_later_evidence_weighs_more_where_others_show_something_else_and_less_where_they_agree():
    photos, masks = passers()
    left = points()[points()[:, 0] < 0]
    for look, mask in zip(looks(photos), masks):
        factor = look.factor((HEIGHT, WIDTH))
        assert factor.dtype == np.float32 and factor.shape == (HEIGHT, WIDTH)
        assert 1.25 < np.median(factor[mask]) <= factor.max() <= 1.5
        assert 1 / 1.5 <= factor.min() <= np.median(factor[~mask]) < 1 / 1.25
    ignored = looks(photos, dataclasses.replace(JUDGE_ALL, weight=1.0))
    assert all(np.array_equal(look.factor((HEIGHT, WIDTH)), np.ones((HEIGHT, WIDTH))) for look in ignored)
    unknown = looks(photos, cloud=left)[VIEWS // 2].factor((HEIGHT, WIDTH))
    # no sparse point of a wall there: nobody could tell
    assert np.allclose(unknown[:, WIDTH // 2 + 14 :], 1.0, atol=1e-5)


def crowd(seed: int = 5) -> tuple[list[np.ndarray], list[np.ndarray]]:
    """Photos of which people at random places cover about half, and where they stand."""
    rng = np.random.default_rng(seed)
    photos, masks = [], []
    for view in range(VIEWS):
        photo, mask = wall(view), np.zeros((HEIGHT, WIDTH), bool)
        for _ in range(9):
            row, column = rng.integers(0, HEIGHT - 16), rng.integers(0, WIDTH - 12)
            photo[row : row + 16, column : column + 12] = rng.uniform(0.0, 1.0, 3)
            mask[row : row + 16, column : column + 12] = True
        photos.append(photo)
        masks.append(mask)
    return photos, masks


def wrong(photos, masks, config) -> float:
    """Share of all pixels that are kept though masked in truth, or the other way round."""
    return float(np.mean([keep == mask for keep, mask in zip(keeps(photos, config), masks)]))


def test_asked_again_a_crowd_is_told_better():
    once = dataclasses.replace(JUDGE_ALL, rounds=0)
    crowds = [crowd(seed) for seed in range(5)]
    assert 0.35 < np.mean([mask for _, masks in crowds for mask in masks]) < 0.6
    first = [wrong(*each, once) for each in crowds]
    last = [wrong(*each, JUDGE_ALL) for each in crowds]
    assert np.mean(last) < 0.9 * np.mean(first), (first, last)


def test_the_filter_takes_specks_and_leaves_edges():
    photos, masks = passers()
    rng = np.random.default_rng(3)
    for photo in photos:  # noise that no other photo shows
        specks = rng.random((HEIGHT, WIDTH)) < 0.02
        photo[specks] += 0.15
    plain = dataclasses.replace(JUDGE_ALL, rounds=0, smooth=0)
    smooth = dataclasses.replace(plain, smooth=5)
    assert wrong(photos, masks, smooth) < 0.7 * wrong(photos, masks, plain)
    for keep, mask in zip(keeps(photos, smooth), masks):
        assert share_of(keep, mask) > 0.85


def test_only_in_a_crowd_the_answers_weigh_as_in_a_crowd():
    config = dataclasses.replace(JUDGE_ALL, weight=1.5, crowd_weight=4.0)
    assert {look.weight for look in looks(passers()[0], config)} == {1.5}
    assert {look.weight for look in looks(crowd()[0], config)} == {4.0}


def test_features_that_move_count_but_in_a_crowd():
    for photos, counts in ((passers()[0], True), (crowd()[0], False)):
        without, still = looks(photos), looks(photos, moving=0.45)
        assert any(not np.array_equal(a.passing, b.passing) for a, b in zip(without, still)) == counts


def test_what_moves_by_flow_counts_in_a_crowd_and_is_masked_from_the_start():
    photos, _ = crowd()
    without, still = looks(photos), looks(photos, moving=0.2, certain=False)
    assert any(not np.array_equal(a.passing, b.passing) for a, b in zip(without, still))
    assert still[0].moving((HEIGHT, WIDTH)) is None
    assert looks(photos, moving=0.9)[0].moving((HEIGHT, WIDTH)) is None  # features are not that sure
    few = dataclasses.replace(JUDGE_ALL, least=0.9)  # whatever small share the rest masks
    surfaces = static_surfaces([camera(0)], points())
    corner = np.zeros(surfaces[0].shape, bool)
    corner[:20, :20] = True
    look = initial_mask_prior(
        [camera(0)], [wall(0)], surfaces, few, [np.full(corner.shape, 0.4, np.float32)], [corner]
    )[0]
    keep, moving = look.keep((HEIGHT, WIDTH)), look.moving((HEIGHT, WIDTH))
    np.testing.assert_array_equal(keep, ~moving)
    assert 0 < moving.mean() < 0.5


def test_later_masks_cover_a_few_times_what_the_first_look_masks():
    found = looks(passers()[0], dataclasses.replace(JUDGE_ALL, most=2.0, most_least=0.1))
    for look in found:
        assert look.most == pytest.approx(2.0 * np.mean(look.passing > 0.5))
    alone = [wall(view) for view in range(VIEWS)]
    assert {look.most for look in looks(alone, dataclasses.replace(JUDGE_ALL, most_least=0.1))} == {0.1}
    assert {look.most for look in looks(alone, dataclasses.replace(JUDGE_ALL, most=0))} == {1.0}
    assert {look.most for look in looks(crowd()[0], dataclasses.replace(JUDGE_ALL, most=9))} == {1.0}


def test_a_first_look_at_a_corner_says_nothing_of_a_masks_size():
    corner = [p for p in points() if p[0] < -1.9 and p[1] < -1.2]
    found = looks([wall(view) for view in range(VIEWS)], cloud=np.array(corner))
    assert any(found)
    assert all(look is None or look.most == 1.0 for look in found)


def test_a_crowd_that_no_answer_settles_ends_after_the_rounds():
    photos, _ = crowd()
    few = looks(photos, dataclasses.replace(JUDGE_ALL, rounds=2))
    more = looks(photos, dataclasses.replace(JUDGE_ALL, rounds=3))
    assert any(not np.array_equal(a.passing, b.passing) for a, b in zip(few, more))
    # and what is settled does not change any more
    calm, _ = passers()
    some = looks(calm, dataclasses.replace(JUDGE_ALL, rounds=50))
    many = looks(calm, dataclasses.replace(JUDGE_ALL, rounds=100))
    assert all(np.array_equal(a.passing, b.passing) for a, b in zip(some, many))


COLOURS = [(0.9, 0.1, 0.2), (0.1, 0.9, 0.2), (0.1, 0.2, 0.9), (0.9, 0.9, 0.1)]


@pytest.mark.parametrize(("colours", "kept"), [(COLOURS, True), (COLOURS[:1] * 4, False)])
def test_in_a_crowd_the_colour_that_most_photos_show_is_the_walls(colours, kept):
    """Three of seven photos show a part of the wall; before it the others show people."""
    photos, crowd = [wall(view) for view in range(VIEWS)], np.s_[16:34, :]
    for view, colour in zip((1, 3, 5, 6), colours):
        photos[view][crowd] = colour
    inner, once = np.s_[20:30, 16:48], dataclasses.replace(JUDGE_ALL, rounds=0, smooth=0, known_by=3)
    few = keeps(photos, dataclasses.replace(once, consensus=0))
    found = keeps(photos, dataclasses.replace(once, consensus=2, crowd=0.3))
    calm = keeps(photos, dataclasses.replace(once, consensus=2, crowd=0.9))
    alone = keeps(photos, dataclasses.replace(once, consensus=3, crowd=0.3))  # only two others show it
    assert all(np.array_equal(a, b) for a, b in zip(calm, few))
    for view in (0, 2, 4):
        assert few[view][inner].mean() < 0.1 and alone[view][inner].mean() < 0.1
        assert bool(found[view][inner].mean() > 0.9) == kept
    assert all(np.array_equal(found[view][inner], few[view][inner]) for view in (1, 3, 5, 6))
    if kept:
        assert not any(found[view][inner].any() for view in (1, 3, 5, 6))


@pytest.mark.parametrize("views", [2, 16])
def test_the_same_every_time(views):
    photos, _ = passers()
    config = dataclasses.replace(JUDGE_ALL, views=views, known_by=1)
    first, second = looks(photos, config), looks(photos, config)
    assert all(a.passing.dtype == np.float32 for a in first)
    assert all(np.array_equal(a.passing, b.passing) for a, b in zip(first, second))


def test_photos_without_a_surface_and_of_other_sizes_are_no_trouble():
    photos, masks = passers()
    cameras = [camera(view) for view in range(VIEWS)]
    surfaces = static_surfaces(cameras, points())
    surfaces[0], surfaces[1] = None, np.full_like(surfaces[1], np.nan)
    cameras[2] = cameras[2].resized(WIDTH // 2, HEIGHT // 2)
    photos[2] = photos[2][::2, ::2]
    surfaces[2] = surfaces[2][::2, ::2]
    found = initial_mask_prior(cameras, photos, surfaces, JUDGE_ALL)
    assert found[0] is None and found[1] is None
    assert all(np.isfinite(look.passing).all() for look in found[2:])
    assert share_of(found[2].keep((HEIGHT // 2, WIDTH // 2)), masks[2][::2, ::2]) > 0.8
    for few in (1, 2):
        these = slice(3, 3 + few)
        assert len(initial_mask_prior(cameras[these], photos[these], surfaces[these], JUDGE_ALL)) == few
