"""Evidence at pixels: structure against loops, other views against a known plane, regions by hand."""

import dataclasses

import numpy as np
import pytest
import torch

from ambiguous_wild.core import Camera
from ambiguous_wild.methods.refinesplat.evidence import ComparisonMaps
from ambiguous_wild.methods.refinesplat.hyperparameters import MaskConfig
from ambiguous_wild.methods.refinesplat.maps import (
    ViewQuantile,
    agreement_weight,
    colours_agree,
    common_offset,
)
from ambiguous_wild.methods.refinesplat.masks import InstanceLabels, PhotoMasks, make_masks
from ambiguous_wild.methods.refinesplat.multiview import (
    MultiViewConfig,
    MultiViewEvidence,
    MultiViewStore,
    discount,
    nearest_views,
)
from ambiguous_wild.methods.refinesplat.pixels import PixelEvidence
from ambiguous_wild.methods.refinesplat.structure import (
    correlation,
    structure_residual,
    unrelated_pair_residual,
)
from tests.methods.on_device import noise, number, tensor

H, W, FOCAL, PLANE = 40, 64, 60.0, 5.0
GREY_PHOTO = np.full((H, W, 3), 0.5, np.float32)


def camera(x: float) -> Camera:
    pose = np.eye(4)
    pose[0, 3] = -x
    return Camera(W, H, FOCAL, FOCAL, W / 2, H / 2, pose)


def plain(count: int) -> list[np.ndarray]:
    return [GREY_PHOTO] * count


def others_of(cameras, photos, config=None, surfaces=()) -> MultiViewStore:
    return MultiViewStore(cameras, photos, config or MultiViewConfig(), surfaces, "cpu")


def store(others: MultiViewStore, view: int, evidence: np.ndarray, depth: np.ndarray) -> None:
    evidence, depth = (tensor(np.asarray(x, np.float32)) for x in (evidence, depth))
    others.store(view, evidence, others.halved(view, depth))


def asked(others: MultiViewStore, view: int, image: np.ndarray = GREY_PHOTO) -> MultiViewEvidence:
    """What the others say about the surface that the view stored and its render shows, as arrays."""
    found = others.query(view, others.depth.of(view)[0], tensor(image))
    return MultiViewEvidence(*(x.numpy() for x in dataclasses.astuple(found)))


def pixel_evidence(photos, cameras, surfaces=(), **changes) -> PixelEvidence:
    config = dataclasses.replace(MaskConfig(memory=0.0), **changes)
    return PixelEvidence(
        [torch.from_numpy(photo) for photo in photos],
        cameras,
        surfaces or [None] * len(photos),
        config,
        "cpu",
    )


def masks_of(values, labels, config, ceiling=None, unseen=None, moving=None) -> PhotoMasks:
    """Of one photo whose evidence is `values`, judged alone."""
    count = int(labels.max())
    known = InstanceLabels([labels], [np.zeros(count, bool)], [None if unseen is None else ~unseen], "cpu")
    values, none = tensor(values), torch.full((1, known.most), torch.nan, dtype=torch.float64)
    ceiling = None if ceiling is None else number(ceiling)
    seen = None if unseen is None else tensor(~unseen)
    return make_masks(
        0, ComparisonMaps(values, values), known, (none, none), 0.5, config, ceiling, seen, moving
    )


def test_correlation_is_pearsons_over_each_box():
    a, b = noise(0, 20, 24), noise(1, 20, 24)
    b += 0.5 * a
    found = correlation(tensor(a), tensor(b))
    for y, x in ((3, 3), (9, 14), (16, 20)):
        box = (slice(y - 3, y + 4), slice(x - 3, x + 4))
        assert found[y, x] == pytest.approx(np.corrcoef(a[box].ravel(), b[box].ravel())[0, 1], abs=0.02)


def test_correlation_does_not_see_gain_and_plain_patches_agree():
    a = tensor(noise(0, 20, 24))
    assert correlation(a, 0.6 * a + 0.1).min() > 0.98
    assert torch.allclose(correlation(torch.full_like(a, 0.4), torch.full_like(a, 0.9)), torch.tensor(1.0))
    assert correlation(a, 1.0 - a).max() < -0.9
    # a plain coat before a textured wall
    assert correlation(a, torch.full_like(a, 0.5)).abs().max() < 0.15


def test_a_blurred_render_is_less_evidence_than_another_texture_of_the_same_residual():
    photo = tensor(noise(2, H, W, 3))
    smooth = photo.mean() + 0.3 * (photo - photo.mean())
    other = tensor(noise(3, H, W, 3))
    other = photo + (other - photo) * (smooth - photo).abs().mean() / (other - photo).abs().mean()
    assert structure_residual(photo, smooth).mean() < 0.75 * structure_residual(photo, other).mean()
    assert structure_residual(photo, photo).max() == 0.0


def test_other_views_are_read_where_they_show_the_same_surface():
    """A mark on a plane, put into every view's evidence at its projection, is found where a view shows it."""
    cameras = [camera(x) for x in (0.0, 0.5, 1.0)]
    other_views = others_of(cameras, plain(3), MultiViewConfig(views=2))
    depth = np.full((H, W), PLANE, np.float32)
    for view in range(len(cameras)):
        column = int(FOCAL * (1.0 - (view * 0.5)) / PLANE + W / 2)  # of the world point (1, 0, PLANE)
        evidence = np.zeros((H, W), np.float32)
        evidence[:, max(column - 1, 0) : column + 2] = 1.0
        store(other_views, view, evidence, depth)
    found = asked(other_views, 0).evidence
    assert found.shape == (H // 2, W // 2)
    expected = (FOCAL * 1.0 / PLANE + W / 2) / 2
    assert abs(int(np.nanargmax(found[H // 4])) - expected) <= 1.0


def test_a_surface_at_another_depth_or_outside_says_nothing():
    cameras = [camera(0.0), camera(0.1)]
    other_views = others_of(cameras, plain(2))
    store(other_views, 0, np.ones((H, W)), np.full((H, W), PLANE))
    assert np.isnan(asked(other_views, 0).evidence).all()  # nobody else stored anything
    assert others_of(cameras[:1], plain(1)).query(0, torch.ones(H // 2, W // 2), tensor(GREY_PHOTO)) is None
    store(other_views, 1, np.ones((H, W)), np.full((H, W), 2 * PLANE))
    assert np.isnan(asked(other_views, 0).evidence).all()
    store(other_views, 1, np.ones((H, W)), np.full((H, W), 1.05 * PLANE))
    assert np.nanmin(asked(other_views, 0).evidence) == pytest.approx(1.0)
    assert (asked(other_views, 0).coverage == np.isfinite(asked(other_views, 0).evidence)).all()
    far = others_of([camera(0.0), camera(1000.0)], plain(2))
    store(far, 0, np.ones((H, W)), np.full((H, W), PLANE))
    store(far, 1, np.ones((H, W)), np.full((H, W), PLANE))
    assert np.isnan(asked(far, 0).evidence).all()


def test_quantiles_are_numpys_without_what_is_missing():
    stack = noise(4, 7, 5, 6)
    stack[noise(5, 7, 5, 6) < 0.4] = np.nan
    stack[:, 0, 0] = np.nan
    there = tensor((~np.isnan(stack)).sum(axis=0))
    for quantile in (0.0, 0.25, 0.5, 0.8, 1.0):
        with pytest.warns(RuntimeWarning):
            expected = np.nanquantile(stack, quantile, axis=0)
        found = ViewQuantile(7, quantile, "cpu").quantile_of(tensor(stack), there)
        assert np.allclose(found, expected, equal_nan=True, atol=1e-6)


def test_discount_by_hand():
    config = MultiViewConfig(strength=2.0, free=2.0)
    evidence = torch.full((4, 6), 10.0)
    said, whole = torch.full((2, 3), 0.6), torch.ones(2, 3)  # 6 units: 4 above what is free

    def left(said, weight, coverage=whole, confirmed=whole):
        return discount(evidence, MultiViewEvidence(said, weight, coverage, confirmed), number(0.1), config)

    assert np.allclose(left(said, whole), 10.0 / np.sqrt(1 + 2 * 4))
    assert np.allclose(left(said, 0.5 * whole), 10.0 / np.sqrt(1 + 2 * 2))
    for said_, weight in ((said, 0 * whole), (said * torch.nan, whole), (said * 0.1, whole)):
        assert torch.equal(left(said_, weight), evidence)
    assert discount(evidence, None, number(0.1), config) is evidence
    assert np.allclose(left(said, whole, 0.5 * whole), 5.0 / np.sqrt(1 + 2 * 4))
    assert np.allclose(
        left(said, whole, 0.5 * whole, 0 * whole), 5.0 * config.unconfirmed / np.sqrt(1 + 2 * 4)
    )


def test_a_render_is_confirmed_where_another_photo_shows_it():
    """The right half of the render is not what stands in the photos; nor with exposure between them."""
    cameras = [camera(0.02 * i) for i in range(3)]
    wrong = GREY_PHOTO.copy()
    wrong[:, W // 2 :] = 0.9
    points = [np.full((H // 2, W // 2), 1 / PLANE, np.float32)] * 3
    for others, image, depths in (
        (others_of(cameras, plain(3)), wrong, (PLANE, PLANE, PLANE)),
        (others_of(cameras, [GREY_PHOTO + 0.2, *plain(2)]), wrong + 0.2, (PLANE, PLANE, PLANE)),
        # renders disagree about the surface, the sparse points know it
        (others_of(cameras, plain(3), surfaces=points), wrong, (9, 18, 27)),
    ):
        for view, depth in enumerate(depths):
            store(others, view, np.ones((H, W)), np.full((H, W), depth))
        confirmed = asked(others, 0, image).confirmed
        assert (confirmed[:, : W // 4 - 2] == 1).all() and (confirmed[:, W // 4 + 2 :] == 0).all()
    untested = others_of(cameras, plain(3), MultiViewConfig(agree=0.0))
    for view in range(3):
        store(untested, view, np.ones((H, W)), np.full((H, W), PLANE))
    assert (asked(untested, 0, wrong).confirmed[:, :-4] == 1).all()


def test_a_masked_instance_is_masked_where_no_other_photo_looks():
    """Not one that is masked for a third, of which little may be masked, or that is static."""
    labels, static = np.zeros((H, W), np.int32), np.array([False, False, False, True])
    for instance, column in enumerate((2, 18, 34, 50), 1):
        labels[10:, column : column + 10] = instance
    maskable = np.zeros((H, W), bool)
    maskable[:30] = True
    maskable[:28, 34:44] = False
    masked = np.zeros((H, W), bool)
    masked[10:25, 2:12] = masked[24:30, 18:28] = masked[28:30, 34:44] = masked[10:30, 50:60] = True
    known = InstanceLabels([labels], [static], [maskable], "cpu")
    found = known.beyond(0, tensor(masked), tensor(maskable)).numpy()
    assert found[30:, 2:12].all() and found.sum() == 10 * 10
    # and in a mask of evidence
    values = 100.0 * masked.astype(np.float32)
    keep = masks_of(values, labels, MaskConfig(use_local=False), ceiling=20.0, unseen=~maskable).keep.numpy()
    assert (keep[30:, 2:12] == 0).all() and (keep[30:, 18:28] == 1).all()


def test_views_that_show_another_colour_have_no_word():
    """Half of the others see the same wall; in the rest something else stands before it."""
    cameras = [camera(0.02 * i) for i in range(7)]
    photos = [np.full((H, W, 3), 0.5, np.float32) for _ in cameras]
    photos[0][:, 3 * W // 4 :] = 0.9  # what stands before view 0 no other photo shows
    for photo in photos[1:4]:
        photo[:, : W // 5] = 0.1
    other_views = others_of(cameras, photos, MultiViewConfig(views=6, agreeing=0.5))
    for view in range(7):
        store(other_views, view, np.ones((H, W)), np.full((H, W), PLANE))
    weight = asked(other_views, 0).weight
    middle = weight[H // 4]
    assert middle[3 * W // 8 + 3 :].max() == 0.0
    assert middle[W // 10 + 3 : 3 * W // 8 - 3].min() == 1.0  # all others agree
    assert middle[2 : W // 10 - 3].min() == 1.0  # three of six do: half is enough
    never = others_of(cameras, photos, MultiViewConfig(views=6, agree=0.0))
    for view in range(7):
        store(never, view, np.ones((H, W)), np.full((H, W), PLANE))
    assert (asked(never, 0).weight == 1.0).all()


def test_weight_is_the_share_of_those_who_see_it_and_few_are_always_heard():
    seen, agreeing = torch.tensor([4, 4, 2]), torch.tensor([1, 0, 0])
    few = seen < 3
    assert agreement_weight(seen, agreeing, 0.5, few).tolist() == [0.5, 0.0, 1.0]
    assert agreement_weight(seen, agreeing, 0.5, ~few).tolist() == [1.0, 1.0, 0.0]


def test_exposure_and_white_balance_are_no_other_content():
    ours = (noise(3, 20, 24, 3) * 150).astype(np.uint8)
    brighter = ours + np.array([30, 40, 50], np.uint8)
    brighter[:6, :6] = 255 - brighter[:6, :6]

    def alike(theirs, seen=True):
        difference = tensor(ours.astype(np.float32) - theirs).view(1, -1, 3).mT
        same = torch.full_like(difference[:, 0], seen, dtype=torch.bool)
        return (
            colours_agree(difference, same, 0.06, common_offset(difference, same, 0.06)).view(20, 24).numpy()
        )

    found = alike(brighter)
    assert found[8:, 8:].all()
    assert found[:6, :6].mean() < 0.3
    assert not alike(brighter, False).any()  # nobody sees anything
    # a shift that few have in common is theirs
    half = ours.copy()
    half[:, :14] += np.uint8(60)
    found = alike(half)
    assert found[:, 14:].all()
    assert not found[:, :14].any()


def test_unrelated_content_gives_far_more_than_a_blurred_render():
    photos = [tensor(noise(i, H, W, 3)) for i in range(4)]
    whole = unrelated_pair_residual(photos)
    smooth = [p.mean() + 0.5 * (p - p.mean()) for p in photos]
    assert whole > 3 * np.median([structure_residual(p, q) for p, q in zip(photos, smooth)])
    assert unrelated_pair_residual([*photos, tensor(noise(9, H // 2, W, 3))]) == pytest.approx(whole, rel=0.2)
    assert unrelated_pair_residual([]) == 0.0


def test_no_threshold_is_above_the_ceiling():
    """Where half of everything is a distractor nothing stands apart: what is unrelated is masked anyway."""
    labels, values = np.ones((8, 8), np.int32), np.full((8, 8), 6.0)
    values[:, 4:] = 1.0
    open_, capped = (masks_of(values, labels, MaskConfig(scope="photo"), limit) for limit in (None, 3.0))
    assert open_.keep.min() == 1.0
    assert float(capped.cut.threshold) == 3.0
    assert (capped.keep[:, :4] == 0.0).all() and (capped.keep[:, 4:] == 1.0).all()
    pixels = pixel_evidence([noise(i, H, W, 3) for i in range(3)], [camera(0.1 * i) for i in range(3)])
    for share, least, expected in ((0.25, 0.0, 2.0), (0.25, 1.0, 2.0), (0.25, 4.0, 4.0)):
        pixels.config = MaskConfig(ceiling=share, ceiling_least=least)
        assert float(pixels.ceiling(number(share * pixels.unrelated / 2.0))) == pytest.approx(expected)
    pixels.config = MaskConfig(ceiling=0.0)
    assert pixels.ceiling(number(1.0)) is None


def test_nearest_views_are_near_and_look_the_same_way():
    back = camera(0.1)
    back = Camera(W, H, FOCAL, FOCAL, W / 2, H / 2, np.diag([-1.0, 1.0, -1.0, 1.0]) @ back.cam_from_world)
    found = nearest_views([camera(0.0), back, camera(0.2), camera(0.6), camera(0.4)], 3)
    assert found[0] == [2, 4, 3]
    assert all(view not in row for view, row in enumerate(found))
    assert nearest_views([camera(0.0), camera(1.0)], 8) == [[1], [0]]


def looked(
    pixels: PixelEvidence, view: int, image: np.ndarray, alpha: float = 1.0, depth: float = PLANE, **kwargs
) -> np.ndarray:
    a = torch.full((H, W), alpha)
    return pixels.compute(view, tensor(image), a, depth * a, **kwargs)[0].numpy()


def test_hard_surfaces_are_forgiven_and_what_one_view_shows_is_not():
    cameras = [camera(0.05 * i) for i in range(4)]
    photos = [np.full((H, W, 3), 0.5, np.float32) + 0.02 * noise(i, H, W, 3) for i in range(4)]
    renders = [np.full((H, W, 3), 0.5, np.float32) + 0.02 * noise(9 + i, H, W, 3) for i in range(4)]
    for photo in photos:
        photo[:12, :30] = 0.8  # every photo shows it, no render does: not learnt yet
    photos[0][24:36, 40:60] = 0.8  # one photo shows it
    pixels = pixel_evidence(photos, cameras)
    for view in range(4):
        looked(pixels, view, renders[view], store=True)
    found = looked(pixels, 0, renders[0], store=False)
    assert found[28:32, 46:54].min() > 3 * found[4:8, 6:20].max()
    assert np.median(found) < 3


def test_a_surface_that_too_few_others_see_is_no_evidence():
    """A render with a wrong depth, and no sparse points: no other photo could teach what is masked."""
    cameras, (render, *others) = [camera(0.05 * i) for i in range(4)], plain(4)
    photos = [render.copy(), *others]
    photos[0][H // 4 : 3 * H // 4, W // 4 : 3 * W // 4] = 0.9  # a distractor
    for least, wrong in ((2, 0.0), (0, 1.0)):
        pixels = pixel_evidence(photos, cameras, multiview=MultiViewConfig(seen_by=least))
        for view in range(4):
            looked(pixels, view, render, store=True)
        right = looked(pixels, 0, render, store=False)[H // 2, W // 2]
        far = looked(pixels, 0, render, depth=3 * PLANE, store=False)[H // 2, W // 2]
        assert right > 0.5 and far == pytest.approx(wrong * right)


def test_what_moves_for_certain_is_masked_where_the_render_agrees():
    labels, moving = np.ones((8, 8), np.int32), np.zeros((8, 8), bool)
    moving[2:5, 2:5] = True
    config = MaskConfig()
    masked = masks_of(np.zeros((8, 8)), labels, config, moving=tensor(moving)).keep.numpy() < 0.5
    np.testing.assert_array_equal(masked, moving)
    assert not (masks_of(np.zeros((8, 8)), labels, config).keep < 0.5).any()


def test_a_look_that_is_not_remembered_leaves_no_trace():
    photos = [noise(i, H, W, 3) for i in range(2)]
    pixels = pixel_evidence(photos, [camera(0.1 * i) for i in range(2)], memory=0.5)
    assert np.isfinite(looked(pixels, 0, noise(7, H, W, 3), store=False)).all()
    assert pixels.normal.isnan().all()
    looked(pixels, 0, noise(7, H, W, 3), store=True)
    before = {k: dict(rows) for k, rows in pixels.state_dict().items()}
    looked(pixels, 0, noise(8, H, W, 3), store=False)
    after = pixels.state_dict()
    assert before["normal"] == after["normal"]
    for name in ("before", "evidence", "depth"):
        assert all((before[name][v] == after[name][v]).all() for v in before[name])


def test_memory_averages_visits_and_thin_renders_are_no_evidence():
    photos, render = [np.full((H, W, 3), 0.5, np.float32)], np.full((H, W, 3), 0.9, np.float32)
    pixels = pixel_evidence(photos, [camera(0.0)], base=0.0, memory=0.5)
    looked(pixels, 0, render, store=True)
    # plain patches of any colour correlate: base alone counts
    assert float(pixels.normal[0]) == pytest.approx(0.0, abs=1e-6)
    pixels.config = dataclasses.replace(pixels.config, base=1.0)
    looked(pixels, 0, render, store=True)
    assert float(pixels.normal[0]) == pytest.approx(0.2, rel=1e-2)  # half of 0.4, half of the earlier 0
    assert looked(pixels, 0, render, alpha=0.2, store=False).max() <= 1.0
