"""GS-W, Splatfacto-W and SWAG: formulas against numbers worked out in another way, and behaviour."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from ambiguous_wild.methods import gsw as gs_w
from ambiguous_wild.methods.gsw import GswAppearance, GswConfig, VisibilityMask
from ambiguous_wild.methods.masking_common import d_keep
from ambiguous_wild.methods.splatfactow import SplatfactoDensity, trimmed_keep
from ambiguous_wild.splat.density import DensityConfig
from ambiguous_wild.splat.effects.autograd_effect import VisibleGaussians
from ambiguous_wild.splat.effects.geometry import (
    directions,
    frequencies,
    harmonics,
    in_picture,
    mean_of_visible,
    projected,
    ray_directions,
    with_penalty,
)
from ambiguous_wild.splat.losses import photometric
from ambiguous_wild.splat.step import ViewContext
from tests.methods.baselines import data_of, parts_of, step_of, trainer_of
from tests.splat.scenes import camera, gaussians, random

# -- what recipes share ---------------------------------------------------------------------------


def test_harmonics_up_to_degree_four_are_orthonormal():
    x, weights = np.polynomial.legendre.leggauss(12)
    phi = (np.arange(24) + 0.5) * np.pi / 12
    z, p = (a.ravel() for a in np.meshgrid(x, phi, indexing="ij"))
    ring = np.sqrt(1 - z * z)
    points = torch.from_numpy(np.stack([ring * np.cos(p), ring * np.sin(p), z], 1))
    basis = harmonics(points, 4).numpy()
    gram = basis.T @ (basis * np.repeat(weights, 24)[:, None] * np.pi / 12)
    assert gram == pytest.approx(np.eye(25), abs=1e-6)


def test_places_are_those_of_the_camera():
    view, means = camera(), gaussians(n=20, rest=3).means
    local = means.double().numpy() @ view.cam_from_world[:3, :3].T + view.cam_from_world[:3, 3]
    pixels, z = projected(means, view)
    front = local[:, 2] > 0.1
    want = local[:, :2] / local[:, 2:] * [view.fx, view.fy] + [view.cx, view.cy]
    assert pixels.numpy()[front] == pytest.approx(want[front], abs=1e-3)
    assert z.numpy() == pytest.approx(local[:, 2], abs=1e-5)
    towards = means.double().numpy() - view.center
    assert directions(means, view).numpy() == pytest.approx(
        towards / np.linalg.norm(towards, axis=1, keepdims=True), abs=1e-5
    )
    inside = front & (want >= 0).all(1) & (want <= [view.width, view.height]).all(1)
    assert in_picture(means, view, margin=0.0).numpy().tolist() == inside.tolist()


def test_rays_point_where_pixels_come_from():
    view = camera()
    rays = ray_directions(view, view.height, view.width, torch.zeros(1)).reshape(view.height, view.width, 3)
    point = torch.tensor(view.center, dtype=torch.float32) + 2.5 * rays[7, 11]
    assert projected(point[None], view)[0][0].tolist() == pytest.approx([11.5, 7.5], abs=1e-3)


def test_frequencies_and_penalty_by_hand():
    found = frequencies(torch.tensor([[0.5, -1.0]]), 2)[0]
    want = [
        0.5,
        -1.0,
        np.sin(0.5),
        np.sin(-1),
        np.cos(0.5),
        np.cos(1),
        np.sin(1),
        np.sin(-2),
        np.cos(1),
        np.cos(2),
    ]
    assert found.tolist() == pytest.approx(want)
    x = torch.tensor([1.0, 2.0], requires_grad=True)
    same = with_penalty(3.0 * x, 0.5 * x.square().sum())
    (same * torch.tensor([1.0, 10.0])).sum().backward()
    assert same.tolist() == [3.0, 6.0] and x.grad.tolist() == [3.0 + 1.0, 30.0 + 2.0]


def test_the_gradient_of_a_keep_map_is_that_of_the_loss():
    render, photo, keep = random(12, 14, 3), random(12, 14, 3, seed=1), random(12, 14, seed=2)
    found, small = d_keep(render, photo, keep), 1e-3
    for at in ((0, 0), (5, 7), (11, 13), (6, 2)):
        values = []
        for sign in (1, -1):
            moved = keep.clone()
            moved[at] += sign * small
            values.append(float(photometric(render, photo, moved, weighting="images").value))
        assert found[at].item() == pytest.approx((values[0] - values[1]) / (2 * small), abs=2e-5)


# -- GS-W -----------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def gsw(scene, tmp_path_factory):
    data = data_of(scene, tmp_path_factory.mktemp("cache"))
    effect = GswAppearance(GswConfig(side=32, width=4, dropout=0.0))
    effect.setup(data)
    return data, effect


def test_a_map_is_sampled_between_its_cells():
    maps = torch.arange(12.0).reshape(1, 3, 4)
    at = torch.tensor([[-0.25, 0.0], [5.0, -9.0]])  # column 1, row 1; outside: the corner
    assert gs_w.sample(maps, at)[:, 0].tolist() == pytest.approx([5.0, 3.0])


def shot_of(data, view=0, **changes):
    known = {"iteration": 1, "nominal": 10.0, "view": view, "camera": data.cameras[view or 0]}
    return ViewContext(**{**known, "photo": data.photos[view or 0], **changes})


def visible_of(effect, n=5):
    g = gaussians(n=n, rest=3)
    g.means.copy_(torch.tensor([0.0, 0.0, 4.0]) + 0.5 * (random(n, 3) - 0.5))
    extra = {name: row.values for name, row in effect.rows(g).items()}
    return VisibleGaussians(torch.zeros(n, 3), g.means, extra)


def test_colours_by_a_second_implementation(gsw):
    data, effect = gsw
    visible, context = visible_of(effect), shot_of(data)
    leaf = effect._leaf(context)
    found = effect.forward(visible, leaf, context)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(effect, "config", replace(effect.config, residual=False))
        published = effect.forward(visible, leaf, context)
    maps = gs_w.feature_maps(data.photos[0], leaf, 32).numpy()
    assert maps.shape[:2] == (3, 16)

    def bilinear(grid, x, y):
        h, w = grid.shape[1:]
        c, r = np.clip((x + 1) * w / 2 - 0.5, 0, w - 1), np.clip((y + 1) * h / 2 - 0.5, 0, h - 1)
        c0, r0 = int(c), int(r)
        c1, r1 = min(c0 + 1, w - 1), min(r0 + 1, h - 1)
        top = grid[:, r0, c0] * (1 - c + c0) + grid[:, r0, c1] * (c - c0)
        low = grid[:, r1, c0] * (1 - c + c0) + grid[:, r1, c1] * (c - c0)
        return top * (1 - r + r0) + low * (r - r0)

    def net(name, x):
        count = sum(key.startswith(f"{name}_weight") for key in leaf)
        for i in range(count):
            x = x @ leaf[f"{name}_weight{i}"].numpy() + leaf[f"{name}_bias{i}"].numpy()
            x = np.maximum(x, 0) if i + 1 < count else x
        return x

    view = data.cameras[0]
    for i in range(5):
        mean, places = visible.means[i].numpy(), visible.attributes["gsw_places"][i].numpy()
        local = view.cam_from_world[:3, :3] @ mean + view.cam_from_world[:3, 3]
        u, v = view.fx * local[0] / local[2] + view.cx, view.fy * local[1] / local[2] + view.cy
        assert 0 < u < view.width and 0 < v < view.height
        own = bilinear(maps[2], 2 * u / view.width - 1, 2 * v / view.height - 1)
        dynamic = np.concatenate([bilinear(maps[0], *places[:2]), bilinear(maps[1], *places[2:]), own])
        unit = (mean - effect.unit.centre.numpy()) / effect.unit.spread.numpy()
        code = [unit] + [f(2.0**k * unit) for k in range(10) for f in (np.sin, np.cos)]
        intrinsic = visible.attributes["gsw_intrinsic"][i].numpy()
        hidden = net("encoder", np.concatenate([*code, dynamic, intrinsic]))
        hidden = net("decoder", np.concatenate([hidden, intrinsic]))
        towards = (mean - view.center) / np.linalg.norm(mean - view.center)
        alone = 0.5 + net("head", np.concatenate([hidden, towards]))
        assert found[i].numpy() == pytest.approx(alone + 0.28209479 * intrinsic[:3], abs=2e-4)
        assert published[i].numpy() == pytest.approx(alone, abs=2e-4)


def test_without_a_photo_a_gaussian_samples_what_it_does_in_the_photos_that_show_it(gsw):
    data, effect = gsw
    visible, context = visible_of(effect), shot_of(data, view=None, photo=None)
    leaf, box = effect._leaf(context), visible.attributes["gsw_box"]
    found, total, count = (
        effect._usual(context, leaf, visible.means, box),
        torch.zeros(5, 16),
        torch.zeros(5, 1),
    )
    for photo, view in zip(data.photos, data.cameras):
        pixels, z = projected(visible.means, view)
        at = pixels / torch.tensor([view.width, view.height])
        shown = ((z > 0) & (at > 0).all(1) & (at < 1).all(1)).float()[:, None]
        map_ = gs_w.feature_maps(photo, leaf, 32)[2]
        total, count = total + shown * gs_w.sample(map_, 2.0 * at - 1.0), count + shown
    assert count.min() >= 1 and count.max() > 1
    torch.testing.assert_close(found, total / count)

    half = shot_of(data, view=None, fitting=True)
    camera = half.camera
    right = projected(visible.means, camera)[0][:, 0] > camera.width // 2
    assert right.any() and not right.all()
    mixed = effect.forward(visible, leaf, half)
    black = effect.forward(
        visible, leaf, shot_of(data, view=None, fitting=True, photo=half_black(half.photo))
    )
    assert torch.equal(mixed, black)  # the right half is not read


def half_black(photo):
    left = photo.clone()
    left[:, photo.shape[1] // 2 :] = 0.0
    return left


def test_intrinsic_features_start_as_harmonics_and_places_in_the_box(gsw):
    g = gaussians(n=30, rest=3)
    rows = gsw[1].rows(g)
    assert (
        torch.equal(rows["gsw_intrinsic"].values[:, :3], g.sh0)
        and not rows["gsw_intrinsic"].values[:, 3:].any()
    )
    assert rows["gsw_places"].values.abs().max() <= 1 and rows["gsw_places"].at(1.0) == pytest.approx(0.01)


def test_a_test_photo_shows_its_left_half_and_nothing_is_fitted(gsw):
    data, effect = gsw
    assert not effect.acts("fit") and effect.acts("shade")
    photo = data.photos[0]
    seen = effect._seen(shot_of(data, view=0, fitting=True))
    assert torch.equal(seen, photo[:, :32])
    assert effect._seen(ViewContext(iteration=1, nominal=1, view=None, camera=data.cameras[0])) is None


def test_masks_settle_where_residual_and_prior_balance(gsw):
    """Without SSIM the optimum is M = 1 - 2.67 e; with it the gradient is that of the whole loss."""
    data, effect = gsw
    policy = VisibilityMask(effect)
    step, mask = step_of(data, 0, data.photos[0] * 0.5), random(48, 64)
    found = policy.d_mask(step, mask)

    def loss(m):
        value = float(photometric(step.rendered.image, step.photo, m, weighting="images").value)
        return value + 0.15 * float((1 - m).square().mean())

    moved = [mask + s * 1e-2 * (torch.arange(64) == 20) for s in (1, -1)]
    assert float(found[:, 20].sum()) == pytest.approx((loss(moved[0]) - loss(moved[1])) / 2e-2, abs=1e-4)


# -- Splatfacto-W ---------------------------------------------------------------------------------


def test_what_is_trimmed_by_hand():
    error = torch.zeros(20, 20)
    error[5, 5], error[14:18, 14:18] = 0.9, 0.8
    keep = trimmed_keep(error, torch.tensor(17 / 400))
    # a pixel alone is kept for its neighbours' sake, a block loses its middle and edges
    assert keep[5, 5] == 1 and not keep[15:17, 15:17].any() and keep[:13].all()
    assert trimmed_keep(error, torch.tensor(0.0)).all()


def test_masks_take_more_the_larger_the_loss_and_never_the_upper_part(scene, tmp_path):
    policy, data = parts_of("splatfacto-w").mask, data_of(scene, tmp_path)
    policy.effect.setup(data)
    small, large = (step_of(data, 0, (data.photos[0] + d).clamp(0, 1)) for d in (0.02, 0.4))
    assert policy.keep(replace(small, nominal=5000.0)) is None
    policy.keep(small)
    assert policy.rounds == 1 and policy.low == policy.high
    keep = policy.keep(large)
    assert policy.high > policy.low and keep[: int(0.4 * 48)].all()
    assert 0.2 < float((keep == 0).float().mean()) <= 0.4
    assert policy.predict(small).mean() > keep.mean()
    policy.keep(replace(small, nominal=12_000.0))  # a new round: its largest loss starts anew
    assert policy.high == pytest.approx(float(policy._error(small).mean()))


def test_the_background_fills_what_is_open_and_its_alpha_term_acts_there(scene, tmp_path):
    parts, data = parts_of("splatfacto-w", alpha="0.15"), data_of(scene, tmp_path)
    effect = parts.effects[0]
    effect.setup(data)
    context = shot_of(data, nominal=5000.0)
    leaf = effect._leaf(context)
    sky = effect.background(leaf, context)
    assert sky.shape == (48, 64, 3)
    alpha = random(48, 64)
    toned = effect.tone(torch.zeros(48, 64, 3), alpha, leaf, context)
    torch.testing.assert_close(toned, ((1 - alpha)[..., None] * sky).clamp(0, 1))
    # the photo is the background in its left half
    photo = sky.clone()
    photo[:, 32:] += 0.1
    step = replace(step_of(data, 0, random(48, 64, 3)), photo=photo, nominal=5000.0)
    d_alpha = parts.mask.cotangent(step, None).alpha
    assert float(d_alpha.sum()) == pytest.approx(0.15) and not d_alpha[:, 34:].any()
    assert (d_alpha[2:-2, 2:30] > 0).all()


def test_the_background_replaces_that_of_the_scene(scene, tmp_path):
    parts = parts_of("splatfacto-w", width="8")
    black, white = (
        trainer_of(scene, tmp_path, parts, behind=behind).make_step(1, 0).rendered for behind in (0, 255)
    )
    assert black.alpha.min() < 0.5
    torch.testing.assert_close(black.image, white.image)


def test_colours_start_at_degree_zero(scene, tmp_path):
    trainer = trainer_of(scene, tmp_path, parts_of("splatfacto-w", width="8"))
    effect = trainer.effects.effects[0]
    context = shot_of(trainer.data)
    leaf = {**effect._leaf(context), "rest_bias0": torch.ones(45)}
    g = trainer.gaussians
    visible = VisibleGaussians(torch.zeros(len(g), 3), g.means, g.attributes)
    early, late = (effect.forward(visible, leaf, replace(context, nominal=n)) for n in (1000.0, 2000.0))
    # features are zero: every Gaussian has the photo's one colour, until directions count
    torch.testing.assert_close(early, early[:1].expand_as(early))
    towards = directions(g.means, context.camera)
    want = early + 0.4886025119 * (towards[:, 2] - towards[:, 1] - towards[:, 0])[:, None]
    torch.testing.assert_close(late, want, rtol=1e-4, atol=1e-5)


def test_growth_waits_after_a_reset():
    density = SplatfactoDensity(DensityConfig(grow_grad=1.0), extent=1.0, seed=0)
    density.setup(SimpleNamespace(photos=[0] * 6))
    g = gaussians(n=10, rest=3)
    density._match(g)
    density.grad_sum += 5.0
    density.views_seen += 1
    density.last_reset = 1000
    for iteration, count in ((1106, 0), (1107, 10)):
        growth = density.choose(SimpleNamespace(iteration=iteration, growth_cap=100), g)
        assert len(growth.clones) + len(growth.splits) == count


# -- SWAG -----------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def swag(scene, tmp_path_factory):
    trainer = trainer_of(scene, tmp_path_factory.mktemp("swag"), parts_of("swag", levels="2", entries="64"))
    return trainer, trainer.effects.effects[0]


def test_it_starts_as_3dgs_but_for_little(swag):
    trainer, effect = swag
    context = shot_of(trainer.data)
    base = random(len(trainer.gaussians), 3)
    colours = effect.forward(VisibleGaussians(base, trainer.gaussians.means), effect._leaf(context), context)
    assert float((colours - base).abs().max()) < 0.1
    assert effect.change(trainer.gaussians, effect._leaf(context), context) == {}  # gates have not begun


def test_means_over_what_is_seen_are_the_same_on_an_accelerator(swag, monkeypatch):
    """There a recipe gets all rows."""
    trainer, _ = swag
    g, view = trainer.gaussians, trainer.data.cameras[0]
    view = replace(view, fx=4 * view.fx, fy=4 * view.fy)  # sees a part
    seen, values = in_picture(g.means, view), random(len(g), 2)
    assert 0 < int(seen.sum()) < len(g)
    on_cpu = mean_of_visible(values[seen], g.means[seen], view)
    monkeypatch.setattr("ambiguous_wild.splat.backend.accelerated", lambda device: True)
    torch.testing.assert_close(mean_of_visible(values, g.means, view), on_cpu)
    torch.testing.assert_close(mean_of_visible(values[:, 0], g.means, view), values[seen, 0].mean())


def test_gates_close_by_their_logit_and_only_in_photos(swag):
    trainer, effect = swag
    g, context = trainer.gaussians, shot_of(trainer.data, nominal=5000.0)
    leaf = effect._leaf(context)
    seen = in_picture(g.means, context.camera)

    def opacity(bias, at=context):
        moved = {**leaf, "net_bias3": torch.tensor([0.0, 0.0, 0.0, bias])}
        moved["net_weight3"] = torch.zeros_like(leaf["net_weight3"])
        found = effect.change(g, moved, at)
        return torch.sigmoid(found["opacity_logits"])

    before = torch.sigmoid(g.opacity_logits)
    torch.testing.assert_close(opacity(-50.0), before)
    assert opacity(50.0)[seen].max() <= 1e-6 and torch.equal(opacity(50.0)[~seen], before[~seen])
    # the share that is closed is sigmoid of the logit
    closed = (opacity(0.5)[seen] < 0.5 * before[seen]).double().mean()
    assert float(closed) == pytest.approx(1 / (1 + np.exp(-0.5)), abs=0.08)
    # pictures without a photo leave out what is off in most photos
    other = replace(context, view=None, photo=None)
    effect._left_out = None
    assert torch.equal(opacity(-1.0, other), before)
    effect._left_out = None
    anywhere = torch.stack([in_picture(g.means, c, margin=0.0) for c in trainer.data.cameras]).any(dim=0)
    assert torch.equal(opacity(1.0, other) < 1e-6, anywhere)
    effect._left_out = None


def test_gates_are_pulled_open_by_their_penalty(swag):
    trainer, effect = swag
    g, context = trainer.gaussians, shot_of(trainer.data, nominal=5000.0)
    with torch.enable_grad():
        drawn, vjp = effect.model(g, context)
    zero = trainer.drawing(g, context).backward(torch.zeros(48, 64, 3))
    gradient = vjp(replace(zero, effect_grads={})).effect_grads["swag"]["net_bias3"]
    # nothing pulls on the picture: what is left is d(0.01 mean z)/d(logit of being off), which is positive
    assert not gradient[:3].any() and 0.0 < float(gradient[3]) < 0.01 * 0.25 / 0.1
    assert drawn.opacity_logits.shape == g.opacity_logits.shape
