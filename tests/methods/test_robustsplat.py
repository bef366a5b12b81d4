"""RobustSplat: what its net learns from, against plain numpy; its schedule; its state."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
import torch
from scipy import ndimage

from ambiguous_wild.core import AwError
from ambiguous_wild.methods import masking_common
from ambiguous_wild.methods.masking_common import MaskNet
from ambiguous_wild.methods.refinesplat.inputs import train_tracks
from ambiguous_wild.methods.robustsplat import (
    RobustSplatConfig,
    RobustSplatMask,
    _fit,
    build,
    coarse_spec,
    mask_loss,
)
from ambiguous_wild.vision import backends
from ambiguous_wild.vision.labhog import LabHog
from ambiguous_wild.vision.sceneconv import SceneConv
from tests.methods.baselines import data_of, parts_of, step_of, trained
from tests.tiny_scene import SQUARE, TRAIN, wall_colour

EARLY = {"min_mask_start": "20"}


def clean_photo(view: int) -> torch.Tensor:
    """The tiny scene's wall as the train view sees it, without the distractor."""
    columns, rows = np.meshgrid(np.arange(64) + 0.5, np.arange(48) + 0.5)
    x = 0.25 * view + (columns - 32) / 60 * 4
    return torch.from_numpy(wall_colour(x, (rows - 24) / 60 * 4).astype(np.float32))


def truth(view: int) -> np.ndarray:
    mask = np.zeros((48, 64), bool)
    mask[SQUARE, SQUARE.start + 4 * view : SQUARE.stop + 4 * view] = True
    return mask


# -- supervision --------------------------------------------------------------------------------------


def test_percentiles_are_numpys_within_a_bin():
    rng = np.random.default_rng(0)
    values = rng.beta(1.5, 6.0, 5000)
    histogram = masking_common.update_histogram(
        torch.zeros(10_000, dtype=torch.float64), torch.from_numpy(values).float(), 0.95
    )
    assert float(histogram.sum()) == 5000
    for share in (0.01, 0.6, 0.8, 1.0):
        exact = np.quantile(values, share, method="inverted_cdf")
        assert 0 <= masking_common.percentile(histogram, share) - exact <= 1e-4 + 1e-6


def test_percentile_is_the_smallest_edge_that_holds_the_share():
    ten = torch.tensor([1.0] * 10, dtype=torch.float64)
    assert masking_common.percentile(ten, 0.6) == pytest.approx(0.6)
    assert masking_common.percentile(ten, 0.61) == pytest.approx(0.7)
    assert masking_common.percentile(torch.zeros(10, dtype=torch.float64), 0.6) == 1.0


def test_the_histogram_forgets_as_it_should():
    histogram = torch.zeros(4, dtype=torch.float64)
    for value in (0.1, 0.6, 1.0):
        histogram = masking_common.update_histogram(histogram, torch.full((8,), value), 0.5)
    assert histogram.tolist() == [2.0, 0.0, 4.0, 8.0]  # 1.0 falls into the last bin


def test_bounds_against_loops():
    e = torch.from_numpy(np.random.default_rng(1).random((9, 13)).astype(np.float32))
    got = masking_common.inlier_map(e, 0.45).numpy()
    inlier = np.pad(e.numpy() < 0.45, 1).astype(float)
    for y in range(9):
        for x in range(13):
            near = inlier[y : y + 3, x : x + 3].sum() / 9
            assert got[y, x] == (inlier[y + 1, x + 1] == 1 or near > 0.5)


def test_the_cosine_target_is_the_printed_formula():
    c = torch.linspace(-1, 1, 41)
    assert torch.allclose(masking_common.cosine_target(c), (2 * c - 1).clamp(0, 1), atol=1e-6)


def test_the_calibrated_cosine_is_zero_at_normal_units():
    unit = 0.002
    cosine = 1 - unit * torch.tensor([0.0, 2.5, 5.0, 10.0, 40.0], dtype=torch.float64)
    got = masking_common.calibrated(cosine, unit, 10.0)
    assert torch.allclose(got, torch.tensor([1.0, 0.75, 0.5, 0.0, -1.0], dtype=torch.float64))
    assert torch.allclose(masking_common.cosine_target(got)[:3], torch.tensor([1.0, 0.5, 0.0]).double())


def test_the_relative_target_is_one_up_to_the_usual_distance():
    distance = torch.tensor([0.0, 0.5, 1.0, 1.5, 2.0, 3.0, 9.0])
    got = masking_common.relative_target(0.004 * distance, 0.004, 3.0)
    assert torch.allclose(got, torch.tensor([1.0, 1.0, 1.0, 0.75, 0.5, 0.0, 0.0]))
    assert torch.equal(masking_common.relative_target(torch.zeros(3), 0.0, 3.0), torch.ones(3))


def test_the_mask_loss_is_the_printed_sum():
    rng = np.random.default_rng(2)
    m, t, low, up = rng.random((4, 6, 8))
    got = mask_loss(*map(torch.from_numpy, (m, t, low, up)), 3000.0, RobustSplatConfig())
    bounds = np.maximum(m - up, 0) + np.maximum(low - m, 0)
    want = 0.5 * np.abs(m - t).mean() + 0.5 * bounds.mean() + 2 * np.exp(-1.5) * (1 - m).mean()
    assert float(got) == pytest.approx(want, rel=1e-12)


def test_the_static_region_is_eroded_by_three_pixels():
    mask = torch.full((30, 40), 0.26)
    mask[10:15, 20:24] = 0.25  # not above the threshold
    keep = masking_common.keep_of(mask, 0.25, 7).numpy()
    want = ndimage.binary_dilation(mask.numpy() <= 0.25, np.ones((7, 7)))
    assert np.array_equal(keep == 0, want)


# -- the net ------------------------------------------------------------------------------------------


def test_the_first_layer_before_enlarging_equals_after():
    g = torch.Generator().manual_seed(0)
    phi = torch.randn(9, 12, 27, generator=g)
    net = MaskNet(phi.mean((0, 1)), phi.std((0, 1)), 16, seed=4)
    big = torch.nn.functional.interpolate(phi.permute(2, 0, 1)[None], size=(36, 48), mode="bilinear")
    z = (big[0].permute(1, 2, 0) - net.mean) / net.std
    want = torch.sigmoid(net.last(torch.relu(net.first(z)))).squeeze(2)
    assert torch.allclose(net(phi, 36, 48), want, atol=1e-5)


def test_the_net_is_a_function_of_its_seed():
    mean, std = torch.zeros(5), torch.ones(5)
    one, same, other = (MaskNet(mean, std, 8, seed) for seed in (1, 1, 2))
    assert torch.equal(one.first.weight, same.first.weight)
    assert not torch.equal(one.first.weight, other.first.weight)
    assert float(one.first.weight.detach().abs().max()) <= 5**-0.5


# -- the policy ---------------------------------------------------------------------------------------


def policy_on(scene, tmp_path, **changes) -> RobustSplatMask:
    policy = RobustSplatMask(replace(RobustSplatConfig(coarse_render="shrink"), **changes))
    policy.setup(data_of(scene, tmp_path / "cache"))
    return policy


@pytest.mark.parametrize("bootstrap", [0.0, 30_000.0], ids=["fine", "coarse"])
def test_what_differs_from_the_render_is_learnt(scene, tmp_path, bootstrap):
    policy = policy_on(scene, tmp_path, bootstrap=bootstrap, lr=2e-2)
    for step in range(120):
        view = step % len(TRAIN)
        policy.keep(step_of(policy.data, view, clean_photo(view)))
    for view in range(len(TRAIN)):
        masked = policy.predict(step_of(policy.data, view, clean_photo(view))).numpy() < 0.5
        grown = cv2.dilate(truth(view).astype(np.uint8), np.ones((17, 17))).astype(bool)
        assert (masked & truth(view)).sum() > 0.8 * truth(view).sum()
        assert (masked & ~grown).mean() < 0.05


def test_what_a_blurred_render_lacks_everywhere_is_usual(scene, tmp_path):
    """The plain target is low all over such a render; the relative one only where more is lost."""
    policy = policy_on(scene, tmp_path, cosine="relative", bootstrap=0.0)
    photo = policy.data.photos[0]
    blurred = torch.nn.functional.avg_pool2d(photo.permute(2, 0, 1)[None], 9, 1, 4, count_include_pad=False)[
        0
    ].permute(1, 2, 0)
    blurred[10:30, 20:44] = 1.0 - blurred[10:30, 20:44]
    step = step_of(policy.data, 0, blurred.contiguous())
    for _ in range(3):
        target = policy._target(step, learning=True)
    changed = torch.zeros(target.shape, dtype=torch.bool)
    changed[12:28, 22:42] = True
    assert float(target[changed].mean()) < 0.3 and float(target[~changed].mean()) > 0.7
    before = [counts.clone() for counts in policy.distances]
    policy.panels(step)
    assert all(torch.equal(a, b) for a, b in zip(before, policy.distances))


def test_nothing_is_masked_before_its_time_nor_learnt_by_looking(scene, tmp_path):
    policy = policy_on(scene, tmp_path)
    before = policy.net.first.weight.detach().clone()
    for kw in ({"nominal": 499.0}, {"iteration": 299}):
        assert policy.keep(step_of(policy.data, 0, clean_photo(0), **kw)) is None
        assert policy.predict(step_of(policy.data, 0, clean_photo(0), **kw)) is None
    assert policy.predict(step_of(policy.data, 0, clean_photo(0))) is not None
    assert torch.equal(before, policy.net.first.weight)
    assert not policy.histogram.any()
    policy.keep(step_of(policy.data, 0, clean_photo(0)))
    assert not torch.equal(before, policy.net.first.weight)


def test_the_net_rests_after_a_reset(scene, tmp_path):
    policy = policy_on(scene, tmp_path)

    def moves(iteration: int) -> bool:
        before = policy.net.first.weight.detach().clone()
        step = step_of(policy.data, 0, clean_photo(0), iteration=iteration, nominal=float(iteration))
        assert policy.keep(step) is not None
        return not torch.equal(before, policy.net.first.weight)

    policy.on_opacity_reset(step_of(policy.data, 0, clean_photo(0), iteration=15_000, nominal=15_000.0))
    assert [moves(i) for i in (15_001, 15_299, 15_300)] == [False, False, True]


def test_panels_show_and_learn_nothing(scene, tmp_path):
    policy = policy_on(scene, tmp_path)
    policy.keep(step_of(policy.data, 0, clean_photo(0)))
    state = [policy.histogram.clone(), policy.net.first.weight.detach().clone()]
    panels = policy.panels(step_of(policy.data, 0, clean_photo(0)))
    assert all(p.shape == (48, 64, 3) and p.dtype == np.uint8 for p in panels.values())
    red = next(p for name, p in panels.items() if name.startswith("disagreement"))
    inner = red[18:22, 18:22].astype(int)
    assert (inner[..., 0] > inner[..., 1]).all()  # the distractor differs from the render
    assert torch.equal(state[0], policy.histogram) and torch.equal(state[1], policy.net.first.weight)


def test_context_widens_what_the_net_sees_and_nothing_else(scene, tmp_path):
    plain, wide = policy_on(scene, tmp_path, context=()), policy_on(scene, tmp_path, context=(3,))
    phi = plain.inputs[0].numpy()
    assert np.array_equal(wide.inputs[0].numpy()[..., :27], phi)
    assert np.allclose(wide.inputs[0].numpy()[4, 6, 27:], phi[3:6, 5:8].mean((0, 1)), atol=1e-5)
    assert np.allclose(wide.inputs[0].numpy()[0, 0, 27:], phi[:2, :2].mean((0, 1)), atol=1e-5)
    with pytest.raises(AwError, match="context"):
        RobustSplatConfig(context=(4,))


def test_smaller_steps_get_masks_of_their_size(scene, tmp_path):
    policy = policy_on(scene, tmp_path)
    small = clean_photo(1)[::2, ::2].contiguous()
    assert policy.keep(step_of(policy.data, 1, small)).shape == (24, 32)


def test_the_coarse_stage_has_features_of_its_own():
    assert coarse_spec(RobustSplatConfig()) == "labhog"
    for spec, coarse in (
        ("sceneconv", "sceneconv"),
        ("efficientnet-lite0", "efficientnet-lite0"),  # follows the size of the picture
        ("efficientnet-lite0@270,layer=stride4", "efficientnet-lite0@120,layer=stride4"),
        ("vgg16", "vgg16@112"),
        ("vgg16@0", "vgg16@0"),
    ):
        config = RobustSplatConfig(features=spec)
        assert coarse_spec(config) == coarse and config.local and config.net_context == (5, 15)
    published = RobustSplatConfig(features="dinov2-small-registers@504,normalise=raw")
    assert coarse_spec(published) == "dinov2-small-registers@224,normalise=raw"


def test_its_features_are_the_best_whose_weights_are_here(tmp_path, monkeypatch):
    monkeypatch.setenv("AW_WEIGHTS", str(tmp_path))
    monkeypatch.setenv("HF_HUB_CACHE", str(tmp_path / "hub"))
    monkeypatch.setattr(backends.importlib.util, "find_spec", lambda name: object())
    found = [RobustSplatConfig().features]
    for name in ("efficientnet-lite0", "dinov2-with-registers-small"):
        (tmp_path / name).mkdir()
        for file in ("efficientnet-lite0.safetensors", "config.json", "model.safetensors"):
            (tmp_path / name / file).write_bytes(b"{}")
        found.append(RobustSplatConfig().features)
    assert found == ["labhog", "efficientnet-lite0", "dinov2-small-registers@504,normalise=raw"]


def test_features_trained_on_the_scene_get_tracks_in_px_of_their_pictures(scene, tmp_path):
    class Recorded(SceneConv):
        def fit_scene(self, photos, tracks, folder=None):
            self.given = tracks

    data = policy_on(scene, tmp_path).data
    point, photo, xy = train_tracks(data.scene)
    whole, half = Recorded(), Recorded()
    _fit(whole, data.photos, data)
    _fit(half, [p[::2, ::2] for p in data.photos], data)
    assert np.array_equal(whole.given[2], xy) and np.array_equal(half.given[2], xy / 2)
    assert np.array_equal(half.given[0], point) and np.array_equal(half.given[1], photo)


def test_with_a_nets_features_everything_is_published():
    config = RobustSplatConfig(features="dinov2-small-registers@504,normalise=raw", context=(5,))
    assert (config.net_context, config.net_hidden, config.net_lr, config.local) == ((), 16, 1e-3, False)
    config = RobustSplatConfig(hidden=16, lr=1e-3, context=())
    assert (config.net_context, config.net_hidden, config.net_lr) == ((), 16, 1e-3)


@pytest.mark.parametrize(
    "wrong", [{"lower": 0.9}, {"coarse_share": 0.0}, {"decay": 1.0}, {"erosion": 4}, {"hidden": 0}]
)
def test_options_that_cannot_be_are_refused(wrong):
    with pytest.raises(AwError, match=next(iter(wrong))):
        RobustSplatConfig(**wrong)


# -- the recipe ---------------------------------------------------------------------------------------


def test_the_recipe_delays_growth_and_masks_both_pictures():
    parts = build(RobustSplatConfig())
    assert (parts.density_config.start, parts.density_config.stop) == (10_000.0, 20_000.0)
    assert parts.density_config.resets == (15_000.0, 18_000.0)
    assert parts.schedule.lr_opacity == 0.025
    assert parts.weighting == "images"


def test_the_seed_decides(scene, tmp_path):
    one, other = (
        trained(scene, tmp_path / str(seed), parts_of("robustsplat", **EARLY), 40, seed) for seed in (0, 1)
    )
    assert not torch.equal(one.hooks.mask.net.first.weight, other.hooks.mask.net.first.weight)


def test_features_are_fitted_without_a_list_of_all_photos(scene, tmp_path, monkeypatch):
    data, given, fit = data_of(scene, tmp_path), [], LabHog.fit
    monkeypatch.setattr(LabHog, "fit", lambda features, photos: (given.append(photos), fit(features, photos)))
    parts_of("robustsplat", features="labhog").mask.setup(data)
    assert given[0] is data.photos
