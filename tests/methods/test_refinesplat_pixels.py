"""Evidence at pixels: structure against loops, other views against a known plane, regions by hand."""

import numpy as np
import pytest

from ambiguous_wild.core import AwError, Camera
from ambiguous_wild.methods.refinesplat import masking
from ambiguous_wild.methods.refinesplat.agreement import (
    agree,
    agreement_weight,
    colour_difference,
    common_offset,
    quantile_of,
)
from ambiguous_wild.methods.refinesplat.config import MaskConfig
from ambiguous_wild.methods.refinesplat.evidence import Maps, make_masks
from ambiguous_wild.methods.refinesplat.multiview import (
    MultiViewConfig,
    MultiViewEvidence,
    OtherViews,
    discount,
    nearest_views,
)
from ambiguous_wild.methods.refinesplat.pixels import PixelEvidence
from ambiguous_wild.methods.refinesplat.structure import (
    correlation,
    mean_difference,
    structure_residual,
    unrelated_residual,
)
from ambiguous_wild.methods.refinesplat.threshold import t_ent

H, W, FOCAL, PLANE = 40, 64, 60.0, 5.0


def camera(x: float) -> Camera:
    pose = np.eye(4)
    pose[0, 3] = -x
    return Camera(W, H, FOCAL, FOCAL, W / 2, H / 2, pose)


def noise(seed: int, *shape: int) -> np.ndarray:
    return np.random.default_rng(seed).random(shape).astype(np.float32)


def plain(count: int) -> list[np.ndarray]:
    return [np.full((H, W, 3), 0.5, np.float32)] * count


def test_correlation_is_pearsons_over_each_box():
    a, b = noise(0, 20, 24), noise(1, 20, 24)
    b += 0.5 * a
    found = correlation(a, b)
    for y, x in ((3, 3), (9, 14), (16, 20)):
        box = (slice(y - 3, y + 4), slice(x - 3, x + 4))
        assert found[y, x] == pytest.approx(np.corrcoef(a[box].ravel(), b[box].ravel())[0, 1], abs=0.02)


def test_correlation_does_not_see_gain_and_plain_patches_agree():
    a = noise(0, 20, 24)
    assert correlation(a, 0.6 * a + 0.1).min() > 0.98
    assert np.allclose(correlation(np.full_like(a, 0.4), np.full_like(a, 0.9)), 1.0)
    assert correlation(a, 1.0 - a).max() < -0.9
    assert np.abs(correlation(a, np.full_like(a, 0.5))).max() < 0.15  # a plain coat before a textured wall


def test_a_blurred_render_is_less_evidence_than_another_texture_of_the_same_residual():
    photo = noise(2, H, W, 3)
    smooth = photo.mean() + 0.3 * (photo - photo.mean())
    other = noise(3, H, W, 3)
    other = photo + (other - photo) * np.abs(smooth - photo).mean() / np.abs(other - photo).mean()
    assert structure_residual(photo, smooth).mean() < 0.75 * structure_residual(photo, other).mean()
    assert structure_residual(photo, photo).max() == 0.0


def test_other_views_are_read_where_they_show_the_same_surface():
    """A mark on a plane, put into every view's evidence at its projection, is found where a view shows it."""
    cameras = [camera(x) for x in (0.0, 0.5, 1.0)]
    other_views = OtherViews(cameras, plain(3), MultiViewConfig(views=2))
    depth = np.full((H, W), PLANE, np.float32)
    for view in range(len(cameras)):
        column = int(FOCAL * (1.0 - (view * 0.5)) / PLANE + W / 2)  # of the world point (1, 0, PLANE)
        evidence = np.zeros((H, W), np.float32)
        evidence[:, max(column - 1, 0) : column + 2] = 1.0
        other_views.remember(view, evidence, depth)
    found = other_views.ask(0).evidence
    assert found.shape == (H // 2, W // 2)
    expected = (FOCAL * 1.0 / PLANE + W / 2) / 2
    assert abs(int(np.nanargmax(found[H // 4])) - expected) <= 1.0


def test_a_surface_at_another_depth_or_outside_says_nothing():
    cameras = [camera(0.0), camera(0.1)]
    other_views = OtherViews(cameras, plain(2), MultiViewConfig())
    other_views.remember(0, np.ones((H, W)), np.full((H, W), PLANE))
    assert other_views.ask(0) is None  # nobody else was asked
    other_views.remember(1, np.ones((H, W)), np.full((H, W), 2 * PLANE))
    assert np.isnan(other_views.ask(0).evidence).all()
    other_views.remember(1, np.ones((H, W)), np.full((H, W), 1.05 * PLANE))
    assert np.nanmin(other_views.ask(0).evidence) == pytest.approx(1.0)
    far = OtherViews([camera(0.0), camera(1000.0)], plain(2), MultiViewConfig())
    far.remember(0, np.ones((H, W)), np.full((H, W), PLANE))
    far.remember(1, np.ones((H, W)), np.full((H, W), PLANE))
    assert np.isnan(far.ask(0).evidence).all()


def test_quantiles_are_numpys_without_what_is_missing():
    stack = noise(4, 7, 5, 6)
    stack[noise(5, 7, 5, 6) < 0.4] = np.nan
    stack[:, 0, 0] = np.nan
    for quantile in (0.0, 0.25, 0.5, 0.8, 1.0):
        with pytest.warns(RuntimeWarning):
            expected = np.nanquantile(stack, quantile, axis=0)
        assert np.allclose(quantile_of(stack, quantile), expected, equal_nan=True, atol=1e-6)


def test_discount_by_hand():
    config = MultiViewConfig(strength=2.0, free=2.0)
    evidence = np.full((4, 6), 10.0, np.float32)
    said = np.full((2, 3), 0.6)  # 6 units: 4 above what is free
    whole, half = np.ones((2, 3), np.float32), np.full((2, 3), 0.5, np.float32)
    assert np.allclose(
        discount(evidence, MultiViewEvidence(said, whole), 0.1, config), 10.0 / np.sqrt(1 + 2 * 4)
    )
    assert np.allclose(
        discount(evidence, MultiViewEvidence(said, half), 0.1, config), 10.0 / np.sqrt(1 + 2 * 2)
    )
    assert np.array_equal(discount(evidence, MultiViewEvidence(said, 0 * whole), 0.1, config), evidence)
    assert np.array_equal(discount(evidence, MultiViewEvidence(said * np.nan, whole), 0.1, config), evidence)
    assert np.array_equal(discount(evidence, MultiViewEvidence(said * 0.1, whole), 0.1, config), evidence)
    assert discount(evidence, None, 0.1, config) is evidence


def test_views_that_show_another_colour_have_no_word():
    """Half of the others see the same wall; in the rest something else stands before it."""
    cameras = [camera(0.02 * i) for i in range(7)]
    photos = [np.full((H, W, 3), 0.5, np.float32) for _ in cameras]
    photos[0][:, 3 * W // 4 :] = 0.9  # what stands before view 0 no other photo shows
    for photo in photos[1:4]:
        photo[:, : W // 5] = 0.1
    other_views = OtherViews(cameras, photos, MultiViewConfig(views=6, agreeing=0.5))
    for view in range(7):
        other_views.remember(view, np.ones((H, W)), np.full((H, W), PLANE))
    weight = other_views.ask(0).weight
    middle = weight[H // 4]
    assert middle[3 * W // 8 + 3 :].max() == 0.0
    assert middle[W // 10 + 3 : 3 * W // 8 - 3].min() == 1.0  # all others agree
    assert middle[2 : W // 10 - 3].min() == 1.0  # three of six do: half is enough
    never = OtherViews(cameras, photos, MultiViewConfig(views=6, agree=0.0))
    for view in range(7):
        never.remember(view, np.ones((H, W)), np.full((H, W), PLANE))
    assert (never.ask(0).weight == 1.0).all()


def test_weight_is_the_share_of_those_who_see_it_and_few_are_always_heard():
    seen = np.array([[[True, True, True]]] * 2 + [[[True, True, False]]] * 2)  # 4, 4, 2 views
    agreeing = np.array([[[True, False, False]]] + [[[False, False, False]]] * 3)
    few = seen.sum(axis=0) < 3
    assert agreement_weight(seen, agreeing, 0.5, few).tolist() == [[0.5, 0.0, 1.0]]
    assert agreement_weight(seen, agreeing, 0.5, ~few).tolist() == [[1.0, 1.0, 0.0]]


def test_exposure_and_white_balance_are_no_other_content():
    ours = (noise(3, 20, 24, 3) * 150).astype(np.uint8)
    brighter = ours + np.array([30, 40, 50], np.uint8)
    brighter[:6, :6] = 255 - brighter[:6, :6]
    everywhere = np.ones(ours.shape[:2], bool)

    def alike(theirs, same=everywhere):
        difference = colour_difference(ours, theirs)
        return agree(difference, same, 0.06, common_offset(difference, same))

    found = alike(brighter)
    assert found[8:, 8:].all()
    assert found[:6, :6].mean() < 0.3
    assert not alike(brighter, ~everywhere).any()  # nobody sees anything
    # a shift that few have in common is theirs
    half = ours.copy()
    half[:, :14] += np.uint8(60)
    found = alike(half)
    assert found[:, 14:].all()
    assert not found[:, :14].any()


def test_unrelated_content_gives_far_more_than_a_blurred_render():
    photos = [noise(i, H, W, 3) for i in range(4)]
    whole = unrelated_residual(photos)
    smooth = [p.mean() + 0.5 * (p - p.mean()) for p in photos]
    assert whole > 3 * np.median([structure_residual(p, q) for p, q in zip(photos, smooth)])
    assert unrelated_residual([*photos, noise(9, H // 2, W, 3)]) == pytest.approx(whole, rel=0.2)
    assert unrelated_residual([]) == 0.0
    a, b = noise(0, 9, 7, 3), noise(1, 9, 7, 3)
    assert np.allclose(mean_difference(a, b), np.abs(a - b).mean(axis=2), atol=1e-6)


def test_no_threshold_is_above_the_ceiling():
    """Where half of everything is a distractor nothing stands apart: what is unrelated is masked anyway."""
    labels = np.ones((8, 8), np.int32)
    values = np.full((8, 8), 6.0)
    values[:, 4:] = 1.0
    config = MaskConfig(dilation=1)
    open_, capped = (
        make_masks(Maps(values, values), labels, np.zeros(1, bool), [], 0.5, config, ceiling)
        for ceiling in (np.inf, 3.0)
    )
    assert open_.keep.min() == 1.0
    assert capped.cut.threshold == 3.0
    assert (capped.keep[:, :4] == 0.0).all()
    assert (capped.keep[:, 4:] == 1.0).all()
    pixels = PixelEvidence(
        [noise(i, H, W, 3) for i in range(3)], [camera(0.1 * i) for i in range(3)], MultiViewConfig(),
        base=0.3, least_alpha=0.5, memory=0.0,
    )  # fmt: skip
    assert pixels.ceiling(0, 0.0) == np.inf
    looked(pixels, 0, noise(7, H, W, 3), remember=True)
    share = 0.25 * pixels.unrelated / pixels.unit
    assert pixels.ceiling(0, 0.25) == pytest.approx(share)
    assert pixels.ceiling(0, 0.25, 0.5 * share) == pytest.approx(share)
    assert pixels.ceiling(0, 0.25, 2 * share) == pytest.approx(2 * share)
    assert pixels.ceiling(0, 0.0, 6.0) == np.inf


def test_nearest_views_are_near_and_look_the_same_way():
    back = camera(0.1)
    back = Camera(W, H, FOCAL, FOCAL, W / 2, H / 2, np.diag([-1.0, 1.0, -1.0, 1.0]) @ back.cam_from_world)
    found = nearest_views([camera(0.0), back, camera(0.2), camera(0.6), camera(0.4)], 3)
    assert found[0] == [2, 4, 3]
    assert all(view not in row for view, row in enumerate(found))
    assert nearest_views([camera(0.0), camera(1.0)], 8) == [[1], [0]]


def looked(pixels: PixelEvidence, view: int, image: np.ndarray, alpha: float = 1.0, **kwargs) -> np.ndarray:
    a = np.full((H, W), alpha, np.float32)
    return pixels.look(view, image, a, PLANE * a, **kwargs)


def test_hard_surfaces_are_forgiven_and_what_one_view_shows_is_not():
    cameras = [camera(0.05 * i) for i in range(4)]
    photos = [np.full((H, W, 3), 0.5, np.float32) + 0.02 * noise(i, H, W, 3) for i in range(4)]
    renders = [np.full((H, W, 3), 0.5, np.float32) + 0.02 * noise(9 + i, H, W, 3) for i in range(4)]
    for photo in photos:
        photo[:12, :30] = 0.8  # every photo shows it, no render does: not learnt yet
    photos[0][24:36, 40:60] = 0.8  # one photo shows it
    pixels = PixelEvidence(photos, cameras, MultiViewConfig(), base=0.3, least_alpha=0.5, memory=0.0)
    for view in range(4):
        looked(pixels, view, renders[view], remember=True)
    found = looked(pixels, 0, renders[0], remember=False)
    assert found[28:32, 46:54].min() > 3 * found[4:8, 6:20].max()
    assert np.median(found) < 3


def test_a_look_that_is_not_remembered_leaves_no_trace():
    cameras = [camera(0.1 * i) for i in range(2)]
    photos = [noise(i, H, W, 3) for i in range(2)]
    pixels = PixelEvidence(photos, cameras, MultiViewConfig(), base=0.3, least_alpha=0.5, memory=0.5)
    first = looked(pixels, 0, noise(7, H, W, 3), remember=False)
    assert np.isfinite(first).all()
    assert pixels.unit == 0.0
    looked(pixels, 0, noise(7, H, W, 3), remember=True)
    before = {k: dict(rows) for k, rows in pixels.state_dict().items()}
    looked(pixels, 0, noise(8, H, W, 3), remember=False)
    after = pixels.state_dict()
    assert before["normal"] == after["normal"]
    for name in ("before", "evidence", "depth"):
        assert all((before[name][v] == after[name][v]).all() for v in before[name])


def test_memory_averages_visits_and_thin_renders_are_no_evidence():
    pixels = PixelEvidence(
        [np.full((H, W, 3), 0.5, np.float32)], [camera(0.0)], MultiViewConfig(), base=0.0, least_alpha=0.5,
        memory=0.5,
    )  # fmt: skip
    looked(pixels, 0, np.full((H, W, 3), 0.9, np.float32), remember=True)
    assert pixels.unit == pytest.approx(
        0.0, abs=1e-6
    )  # plain patches of any colour correlate: base alone counts
    pixels.base = 1.0
    looked(pixels, 0, np.full((H, W, 3), 0.9, np.float32), remember=True)
    assert pixels.unit == pytest.approx(0.2, rel=1e-2)  # half of 0.4, half of the earlier 0
    assert looked(pixels, 0, np.full((H, W, 3), 0.9, np.float32), alpha=0.2, remember=False).max() <= 1.0


def test_hysteresis_keeps_weak_pixels_that_touch_strong_ones():
    values = np.zeros((6, 12))
    values[1:4, 1:5], values[2, 2] = 5.0, 9.0
    values[1:4, 8:11] = 5.0
    found = masking.hysteresis(values, 4.0, 8.0)
    assert found[1:4, 1:5].all()
    assert found.sum() == 12
    assert not masking.hysteresis(values, 4.0, np.inf).any()
    assert masking.hysteresis(values, 4.0, 4.5).sum() == 21


def test_small_gaps_are_filled_and_large_ones_are_not():
    mask = np.zeros((40, 40), bool)
    mask[5:15, 5:15], mask[8:10, 8:10] = True, False
    mask[20:38, 5:35], mask[22:36, 8:32] = True, False
    found = masking.fill_holes(mask, 0.01)
    assert found[8:10, 8:10].all()
    assert not found[22:36, 8:32].any()
    assert found.sum() == mask.sum() + 4
    assert np.array_equal(masking.fill_holes(mask, 0.0), mask)
    assert not masking.fill_holes(np.zeros((4, 4), bool), 0.5).any()


def test_thresholds_it_is_compared_with():
    values = np.array([1.0, 2.0, 3.0, 20.0])
    assert t_ent(values, form="hard", hard=12.0).flagged.tolist() == [False, False, False, True]
    assert t_ent(values, form="hard", hard=12.0, gate=50.0, least=99.0).threshold == 12.0
    assert t_ent(np.array([15.0]), form="hard", hard=12.0).flagged.tolist() == [True]
    statistics = t_ent(values, form="statistics")
    assert statistics.threshold == pytest.approx(values.mean() + values.std())
    assert t_ent(values, form="statistics", least=25.0).flagged.sum() == 0
    with pytest.raises(AwError, match="kapur"):
        t_ent(values, form="kapurr")  # type: ignore[arg-type]
