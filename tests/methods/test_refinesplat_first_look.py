"""The first look: who passes by is left out before any training, whatever surfaces cannot be told counts."""

import dataclasses

import numpy as np
import pytest
import torch

from ambiguous_wild.core import Camera
from ambiguous_wild.methods.refinesplat.first_look import FirstLookConfig, first_look
from ambiguous_wild.vision.sparse_surface import static_surfaces

WIDTH, HEIGHT, FOCAL = 64, 48, 60.0
VIEWS, DEPTH = 7, 4.0
JUDGE_ALL = FirstLookConfig(least=0.0)


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


def looks(photos, config=None, cloud=None):
    cameras = [camera(view) for view in range(VIEWS)]
    surfaces = static_surfaces(cameras, points() if cloud is None else cloud)
    return first_look(cameras, photos, surfaces, config or JUDGE_ALL)


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
    assert keeps(photos, FirstLookConfig()) == [None] * VIEWS
    assert all(keep.all() for keep in keeps(photos, JUDGE_ALL))


def test_a_start_can_bear_a_little():
    photos, masks = passers()
    share = float(np.mean(masks))
    assert all(keep is not None for keep in keeps(photos, FirstLookConfig(least=0.6 * share)))
    assert keeps(photos, FirstLookConfig(least=1.5 * share)) == [None] * VIEWS


def test_a_photo_of_other_exposure_is_not_left_out():
    photos = [wall(view) for view in range(VIEWS)]
    photos[3] = photos[3] + 0.2
    assert np.mean(~keeps(photos)[3]) < 0.05
    assert all(np.mean(~keep) < 0.05 for keep in keeps(photos))


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
        factor = look.factor(1.5, (HEIGHT, WIDTH))
        assert factor.dtype == np.float32 and factor.shape == (HEIGHT, WIDTH)
        assert np.median(factor[mask]) == pytest.approx(1.5)
        assert np.median(factor[~mask]) == pytest.approx(1 / 1.5)
        assert np.array_equal(look.factor(1.0, (HEIGHT, WIDTH)), np.ones((HEIGHT, WIDTH)))
    unknown = looks(photos, cloud=left)[VIEWS // 2].factor(2.0, (HEIGHT, WIDTH))
    assert (unknown[:, WIDTH // 2 + 14 :] == 1.0).all()  # no sparse point of a wall there: nobody could tell


COLOURS = [(0.9, 0.1, 0.2), (0.1, 0.9, 0.2), (0.1, 0.2, 0.9), (0.9, 0.9, 0.1)]


@pytest.mark.parametrize(("colours", "kept"), [(COLOURS, True), (COLOURS[:1] * 4, False)])
def test_in_a_crowd_the_colour_that_most_photos_show_is_the_walls(colours, kept):
    """Three of seven photos show a part of the wall; before it the others show people."""
    photos, crowd = [wall(view) for view in range(VIEWS)], np.s_[16:34, :]
    for view, colour in zip((1, 3, 5, 6), colours):
        photos[view][crowd] = colour
    inner = np.s_[20:30, 16:48]
    few = keeps(photos, dataclasses.replace(JUDGE_ALL, consensus=0))
    found = keeps(photos, dataclasses.replace(JUDGE_ALL, consensus=2, crowd=0.3))
    calm = keeps(photos, dataclasses.replace(JUDGE_ALL, consensus=2, crowd=0.9))
    alone = keeps(photos, dataclasses.replace(JUDGE_ALL, consensus=3, crowd=0.3))  # only two others show it
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
    first, second = keeps(photos, config), keeps(photos, config)
    assert all(torch.equal(torch.from_numpy(a), torch.from_numpy(b)) for a, b in zip(first, second))
