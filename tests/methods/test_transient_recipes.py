"""NexusSplats, HybridGS, T-3DGS and ForestSplats: formulas worked out in another way, and behaviour."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from ambiguous_wild.core.errors import AwError
from ambiguous_wild.methods.forestsplats import fill_superpixels
from ambiguous_wild.methods.hybridgs import COVERED, composite_over, planar_sums
from ambiguous_wild.methods.nexussplats import GEOMETRY, SHIFT, as_colour, boundary_weight, confident_pixels
from ambiguous_wild.methods.t3dgs import (
    TwoErrorHead,
    divergence,
    inverse_depth,
    likelihood_loss,
    total_variation,
)
from ambiguous_wild.splat.effects.autograd_effect import VisibleGaussians
from ambiguous_wild.splat.fields import STATIC, frames_of
from ambiguous_wild.splat.gaussians import SH_C0
from ambiguous_wild.splat.losses import photometric
from ambiguous_wild.splat.render import render
from tests.methods.baselines import data_of, masked_more_inside, parts_of, step_of, trained, trainer_of
from tests.splat.scenes import camera, gaussians, random


def slope(function, values, at, small=1e-3):
    """Central difference of a function of a tensor along one of its entries."""
    found = []
    for sign in (1, -1):
        moved = values.clone()
        moved[at] += sign * small
        found.append(float(function(moved)))
    return (found[0] - found[1]) / (2 * small)


# -- NexusSplats ----------------------------------------------------------------------------------


def test_uncertainty_is_blended_as_a_colour_without_a_background():
    g, view = gaussians(n=40), camera()
    values = torch.linspace(-1.5, 2.0, 40)
    drawn = render(as_colour(g, slice(None), values), view, sh_degree=0)
    raw = drawn.image[..., 0] - SHIFT * drawn.alpha

    # the blending is linear in the colours: two pictures with colours above 0 give it too
    def coloured(colours):
        return replace(g, sh0=((colours - 0.5) / SH_C0)[:, None].repeat(1, 3), sh_rest=g.sh_rest[:, :0])

    high, low = coloured(values.clamp(min=0)), coloured((-values).clamp(min=0))
    want = render(high, view, sh_degree=0).image[..., 0] - render(low, view, sh_degree=0).image[..., 0]
    torch.testing.assert_close(raw, want, rtol=0, atol=2e-5)


@pytest.fixture(scope="module")
def nexus(scene, tmp_path_factory):
    parts = parts_of("nexussplats", light_width="8", doubt_width="8", min_mask_start="1", mask_start="0")
    trainer = trainer_of(scene, tmp_path_factory.mktemp("nexus"), parts)
    trainer.gaussians.attributes["nexus_uncertainty"].copy_(random(len(trainer.gaussians), 32) - 0.5)
    return trainer


def test_gradients_of_the_uncertainty_are_those_of_its_loss(nexus):
    policy, step = nexus.hooks.mask, nexus.make_step(10, 0)
    keep, gradients = policy._weight(step, learn=True)
    distance = policy.distance(step)
    codes, leaf = step.gaussians.attributes["nexus_uncertainty"], policy.effect._leaf(step)

    def loss(raw):
        drawn = step.draw(gaussians=as_colour(step.gaussians, slice(None), raw), without=("nexussplats",))
        raw = (drawn.image[..., 0] - SHIFT * drawn.alpha).double()
        sigma = 0.1 + raw.exp().log1p()
        return (distance / (2 * sigma**2)).mean() + 0.5 * sigma.log().mean()

    found = gradients.attributes["nexus_uncertainty"]
    row = int(found.abs().sum(dim=1).argmax())
    slope_of_raw = slope(loss, policy.effect.uncertainty(codes, leaf), row, 0.05)
    with torch.enable_grad():
        code = codes[row : row + 1].clone().requires_grad_()
        (through,) = torch.autograd.grad(policy.effect.uncertainty(code, leaf).sum(), code)
    torch.testing.assert_close(found[row], (slope_of_raw * through[0]).float(), rtol=0.03, atol=1e-7)
    assert gradients.effect_grads["nexussplats"].keys() >= {
        "transient",
        "uncertainty_weight0",
        "uncertainty_bias2",
    }
    assert not gradients.sh0.any() and not gradients.screen.any()
    assert torch.equal(confident_pixels(keep), policy.predict(step))
    assert (
        confident_pixels(torch.tensor([1.5, 0.9])).tolist() == [1.0, 0.0]
        and confident_pixels(torch.tensor([0.9])).item() == 1.0
    )


def test_the_uncertainty_moves_gaussians_only_if_asked(nexus, monkeypatch):
    policy, step = nexus.hooks.mask, nexus.make_step(10, 0)
    _, alone = policy._weight(step, learn=True)
    assert not any(getattr(alone, name).any() for name in GEOMETRY)
    monkeypatch.setattr(policy, "config", replace(policy.config, through_geometry=True))
    _, whole = policy._weight(step, learn=True)
    assert all(getattr(whole, name).any() for name in GEOMETRY)
    assert torch.equal(alone.attributes["nexus_uncertainty"], whole.attributes["nexus_uncertainty"])


def test_errors_pull_back_what_is_very_certain(nexus, monkeypatch):
    policy, step = nexus.hooks.mask, nexus.make_step(10, 0)
    monkeypatch.setattr(policy.effect, "uncertainty", lambda codes, leaf: 0.1 * codes[:, 0] - 3.9)
    monkeypatch.setattr(policy, "distance", lambda step: torch.ones(step.photo.shape[:2]))
    weight, gradients = policy._weight(step, learn=True)
    gradient = gradients.attributes["nexus_uncertainty"][:, 0]
    assert (
        weight.max() > 3.0 and gradient.min() < 0.0 and gradient.max() <= 1e-9
    )  # a step against it raises sigma


def test_the_uncertainty_does_not_read_the_background(nexus, scene, tmp_path, monkeypatch):
    white = trainer_of(scene, tmp_path, nexus.hooks, behind=255)
    white.gaussians.attributes["nexus_uncertainty"].copy_(nexus.gaussians.attributes["nexus_uncertainty"])
    ones = torch.ones(white.data.photos[0].shape[:2])
    monkeypatch.setattr(white.hooks.mask, "distance", lambda step: ones)
    found = []
    for behind in (1.0, 0.0):
        drawing = white.drawing
        monkeypatch.setattr(white.hooks.mask, "behind", behind)
        monkeypatch.setattr(drawing, "hooks", replace(drawing.hooks, background=(behind,) * 3))
        found.append(white.hooks.mask._weight(white.make_step(10, 0), learn=True))
    (weight, gradients), (plain, of_plain) = found
    torch.testing.assert_close(weight, plain, rtol=1e-4, atol=1e-5)
    one, other = (g.attributes["nexus_uncertainty"] for g in (gradients, of_plain))
    torch.testing.assert_close(one, other, rtol=1e-3, atol=1e-8)


@pytest.mark.parametrize("view", [0, None])
def test_dropout_follows_the_hidden_layers_in_training_alone(nexus, view):
    effect, context = nexus.effects.effects[0], replace(nexus.make_step(10, 0), view=view)
    g, leaf = nexus.gaussians, effect._leaf(nexus.make_step(10, 0))
    ones = {name: torch.full_like(v, 1.0 if "weight" in name else 0.0) for name, v in leaf.items()}
    ones["toned_weight0"].zero_(), ones["toned_bias0"].fill_(1.0), ones["toned_weight1"].copy_(torch.eye(8))
    ones["toned_weight2"].fill_(0.01)
    base = torch.zeros(len(g), 3)
    colours = effect.forward(VisibleGaussians(base, g.means, g.attributes), ones, context)
    # of 8 units each is kept twice with probability 0.8 and then scaled by 1 / 0.8^2
    units = torch.logit((colours[:, 0] + 1) / 2) / 0.01 * (0.64 if view == 0 else 1.0)
    assert units.round().sub(units).abs().max() < 1e-2 and units.max() <= 8.01
    mean = 8 * 0.64 if view == 0 else 8.0
    assert float(units.mean()) == pytest.approx(mean, abs=0.3 if view == 0 else 1e-3)


def test_boundaries_widen_what_is_kept_and_not_what_is_learnt(nexus, monkeypatch):
    policy, step = nexus.hooks.mask, nexus.make_step(10, 0)
    plain, before = policy._weight(step, learn=True)
    monkeypatch.setattr(policy, "config", replace(policy.config, boundary=True))
    wide, after = policy._weight(step, learn=True)
    torch.testing.assert_close(wide, plain / boundary_weight(*plain.shape, plain))
    assert torch.equal(before.attributes["nexus_uncertainty"], after.attributes["nexus_uncertainty"])


def test_boundaries_weigh_least_at_the_lower_middle():
    weight = boundary_weight(41, 41, torch.zeros(1))
    assert weight.argmax() == 30 * 41 + 20 and weight[30, 20] == pytest.approx(1.0)
    assert weight[0, 0].item() == pytest.approx(math.exp(-(1.5**2 / 0.5 + 1 / 1.28)))


def test_volumes_are_pulled_down(nexus):
    step = nexus.make_step(10, 0)
    plain = step.rendered.backward(torch.zeros_like(step.photo))
    found = nexus.density.before_step(step, plain)
    product = step.gaussians.log_scales.exp().prod(dim=1)
    want = 0.01 * product / len(product)
    torch.testing.assert_close(found.log_scales - plain.log_scales, want[:, None].expand(-1, 3))


def test_uncertainty_finds_what_features_do_not_explain(scene, tmp_path):
    options = {"lr_code": "0.02", "appearance": "false", "min_mask_start": "150"}
    trainer = trained(scene, tmp_path, parts_of("nexussplats", **options), iterations=300)
    inside, outside = masked_more_inside(trainer)
    assert inside < outside - 0.2


# -- HybridGS -------------------------------------------------------------------------------------


def test_planar_sums_by_a_loop():
    planar = torch.randn(6, 9, generator=torch.Generator().manual_seed(1)) * 0.5
    planar[:, [5, 7]] = planar[:, [5, 7]].abs()
    height, width, reach = 20, 24, 4
    found = planar_sums(planar, height, width, reach).double().numpy()
    cell, want = math.sqrt(height * width / 6) * COVERED, np.zeros((height, width, 4))
    half = round(reach * cell)
    for p in planar.double().numpy():
        cx, cy = (np.tanh(p[0]) + 1) * width / 2, (np.tanh(p[1]) + 1) * height / 2
        factor = cell * np.array([[p[5] + 0.5, 0], [p[6], p[7] + 0.5]])
        inverse = np.linalg.inv(factor @ factor.T)
        for r in range(height):
            for c in range(width):
                d = np.array([c + 0.5 - cx, r + 0.5 - cy])
                g = np.exp(-0.5 * d @ inverse @ d)
                if g >= 1 / 255 and abs(c - np.floor(cx)) <= half and abs(r - np.floor(cy)) <= half:
                    want[r, c] += g / (1 + np.exp(-p[8])) * np.append(p[2:5], 1.0)
    assert found == pytest.approx(want, abs=1e-5)
    assert want.max() > 0.3


def test_planar_sums_have_their_gradients():
    planar = (torch.randn(3, 9, generator=torch.Generator().manual_seed(2)) * 0.3).double()
    weights = random(10, 12, 4).double()
    leaf = planar.clone().requires_grad_()
    (planar_sums(leaf, 10, 12, 6) * weights).sum().backward()
    for at in ((0, 0), (0, 1), (1, 3), (1, 5), (2, 6), (2, 7), (0, 8)):
        want = slope(lambda x: (planar_sums(x, 10, 12, 6) * weights).sum(), planar, at, 1e-6)
        assert leaf.grad[at].item() == pytest.approx(want, rel=1e-3, abs=1e-4)


def test_the_composite_by_hand():
    front, mask, back = (
        torch.full((1, 1, 3), 0.2),
        torch.full((1, 1), 0.25),
        torch.tensor([[[0.4, 1.6, -1.0]]]),
    )
    assert composite_over(front, mask, back)[0, 0].tolist() == pytest.approx([0.5, 0.95, 0.2])


def test_stages_share_the_loss_as_described(scene, tmp_path):
    trainer = trainer_of(scene, tmp_path, parts_of("hybridgs", points="60"))
    policy, effect = trainer.hooks.mask, trainer.effects.effects[0]
    early, apart, joint = (
        trainer.make_step(i, 0) for i in (10, 40, 80)
    )  # of 120: nominal 2500, 10 000, 20 000
    assert policy.keep(early) is None and policy.cotangent(early, None) is None
    keep = policy.keep(apart)
    front, mask = effect.layer(effect._leaf(apart)["planar"], apart)
    assert torch.equal(keep, 1 - mask) and 0 < keep.mean() < 1
    found = policy.cotangent(apart, keep)
    assert found.image is None

    def loss(moved):
        t, m = effect.layer(moved, apart)
        picture = composite_over(t, m, apart.rendered.image)
        return photometric(picture, apart.photo).value + 0.05 * m.mean()

    planar, gradient = effect._leaf(apart)["planar"], found.effect_grads["hybridgs"]["planar"]
    at = divmod(int(gradient[:, 2:5].abs().argmax()), 3)
    at = (at[0], at[1] + 2)
    assert gradient[at].item() == pytest.approx(slope(loss, planar, at, 2e-3), rel=0.05)
    assert policy.keep(joint) is None
    alone = trainer.drawing(trainer.gaussians, joint, ("hybridgs",)).image
    torch.testing.assert_close(joint.rendered.image, composite_over(front, mask, alone))
    assert torch.equal(trainer.render(joint.camera).image, alone)  # no layer in other views
    assert not effect.acts("fit")


def test_planar_layers_take_up_distractors(scene, tmp_path):
    options = {"points": "200", "apart": "5000", "joint": "15000"}
    trainer = trained(scene, tmp_path, parts_of("hybridgs", **options), iterations=500)
    inside, outside = masked_more_inside(trainer)
    assert inside < outside - 0.1


# -- T-3DGS ---------------------------------------------------------------------------------------


def test_the_likelihood_is_that_of_a_bivariate_normal():
    x, y = random(4, 5), random(4, 5, seed=1)
    found = torch.stack(
        [0.3 + random(4, 5, seed=2), 0.2 + random(4, 5, seed=3), 1.6 * random(4, 5, seed=4) - 0.8]
    )
    s1, s2, rho = found.double()
    covariance = torch.stack(
        [torch.stack([s1 * s1, rho * s1 * s2], -1), torch.stack([rho * s1 * s2, s2 * s2], -1)], -2
    )
    errors = torch.stack([x, y], -1).double()
    normal = torch.distributions.MultivariateNormal(torch.zeros(4, 5, 2).double(), covariance)
    # mean of -2 ln p - 2 ln(2 pi)
    want = (-2 * normal.log_prob(errors) - 2 * math.log(2 * math.pi)).mean()
    assert likelihood_loss(x, y, found).item() == pytest.approx(float(want), rel=1e-4)


def test_the_divergence_by_hand():
    one = torch.tensor([0.5, 0.2, 0.0]).reshape(3, 1, 1)
    other = torch.tensor([0.25, 0.4, 0.0]).reshape(3, 1, 1)
    assert divergence(one, one).item() == pytest.approx(0.0, abs=1e-6)
    # without correlation it is the Kullback-Leibler divergence: 0.5 (4 + 0.25 - ln(1) - 2)
    assert divergence(one, other).item() == pytest.approx(1.125)
    tilted = torch.tensor([0.5, 0.2, 0.6]).reshape(3, 1, 1)
    flat = torch.tensor([0.5, 0.2, 0.0]).reshape(3, 1, 1)
    # as coded: (1 + 1 - 0) / 0.64, where the exact one has 1 + 1
    assert divergence(tilted, flat).item() == pytest.approx(0.5 * (2 / 0.64 - math.log(0.64) - 2))


def test_the_head_gives_deviations_and_a_correlation():
    head = TwoErrorHead(27, 1, seed=0)
    widths = [27, 9, 4, 2]
    assert [c.out_channels for c in head.convs] == [27, 9, 9, 4, 4, 2] and head.last.in_channels == widths[3]
    found = head(torch.randn(2, 12, 16, 27, generator=torch.Generator().manual_seed(0)), 47, 63)
    assert found.shape == (2, 3, 47, 63)
    assert found[:, :2].min() > 0 and found[:, 2].abs().max() < 1
    again = TwoErrorHead(27, 1, seed=0)
    assert all(torch.equal(a, b) for a, b in zip(head.parameters(), again.parameters()))


def test_variation_is_of_the_range():
    ramp = torch.arange(5.0).expand(3, 5)
    assert total_variation(ramp).item() == total_variation(10 * ramp + 3).item() == pytest.approx(0.25)
    assert total_variation(torch.full((3, 4), 2.0)).item() == 0.0


def test_masks_of_a_photo_stand_in_after_a_reset(scene, tmp_path):
    policy, data = parts_of("t-3dgs", min_mask_start="1").mask, data_of(scene, tmp_path)
    policy.setup(data)
    step = step_of(data, 0, (data.photos[0] + 0.2).clamp(0, 1))
    policy.keep(step)
    policy.bank[0] = random(48, 64) > 0.5
    policy.on_opacity_reset(step)
    before = [p.clone() for p in policy.head.parameters()]
    later = replace(step, iteration=1010, nominal=10_100.0)
    assert torch.equal(policy.keep(later), policy.bank[0].float())
    assert policy.keep(replace(later, view=1, photo=data.photos[1])) is None  # none is known of it
    assert all(torch.equal(a, b) for a, b in zip(before, policy.head.parameters()))


def test_depth_is_smoothed(scene, tmp_path):
    trainer = trained(scene, tmp_path, parts_of("t-3dgs", variation="0.1"), iterations=60)
    step = trainer.make_step(60, 0)
    found = trainer.hooks.mask.cotangent(step, None)
    alpha, depth = step.rendered.alpha.double(), step.rendered.depth.double()

    def loss(moved):
        return 0.1 * total_variation(inverse_depth(alpha, moved))

    at = divmod(int(found.depth.abs().argmax()), 64)
    assert found.depth[at].item() == pytest.approx(slope(loss, depth, at, 1e-6), rel=0.05)


# -- ForestSplats ---------------------------------------------------------------------------------


def test_superpixels_are_filled_by_their_maximum():
    mask = torch.tensor([[0.1, 0.5, 0.0, 0.1], [0.2, 0.3, 0.1, 0.3]])
    segments = torch.tensor([[0, 0, 2, 2], [0, 0, 2, 2]])  # means 0.275 and 0.125
    found = fill_superpixels(mask, segments, 4, 0.2)
    assert found[:, :2].tolist() == [[0.5, 0.5]] * 2 and torch.equal(found[:, 2:], mask[:, 2:])


@pytest.fixture(scope="module")
def forest(scene, tmp_path_factory):
    options = {"points": "60", "width": "8", "side": "64"}
    return trainer_of(scene, tmp_path_factory.mktemp("forest"), parts_of("forestsplats", **options))


def test_the_mixture_and_where_its_gradient_goes(forest):
    step = forest.make_step(10, 2)
    frames, mask = frames_of(step.rendered), 1.0 - forest.hooks.mask.predict(step)
    want = mask[..., None] * frames["transient"].image + (1 - mask)[..., None] * frames[STATIC].image
    torch.testing.assert_close(step.rendered.image, want)
    assert torch.equal(forest.render(step.camera).image, frames[STATIC].image)
    gradients = step.rendered.backward(torch.ones_like(step.photo))
    assert gradients.fields["transient"].means.any() and gradients.means.any()
    assert {"bend0_weight0", "moved_bias0", "stem_weight0"} <= gradients.effect_grads["forestsplats"].keys()


def test_the_mask_learns_from_its_three_losses(forest):
    nets, step = forest.effects.effects[0], forest.make_step(10, 2)
    frames = frames_of(step.rendered)
    found = forest.hooks.fields.regularise(frames, step)[STATIC].effect_grads["forestsplats"]["last_bias0"]
    leaf, area = nets._leaf(step), max(0.006, 0.05 * math.exp(-0.001 * step.nominal))

    def loss(bias):
        m = nets.masked(step.photo, {**leaf, "last_bias0": bias})
        kept = photometric(frames[STATIC].image, step.photo, 1 - m, weighting="images").value
        apart = (m[..., None] * (frames["transient"].image - step.photo)).abs().mean()
        return 0.2 * kept + apart + area * m.square().mean()

    assert found.item() == pytest.approx(slope(loss, leaf["last_bias0"], 0, 1e-2), rel=0.02)


def test_the_field_is_bent_for_its_photo_alone(forest):
    field, nets = forest.drawing.others["transient"], forest.effects.effects[0]
    one, other = (nets.model(field.gaussians, forest.make_step(10, v))[0] for v in (0, 5))
    assert not torch.equal(one.means, other.means)
    assert float((one.means - field.gaussians.means).abs().max()) < 0.1  # heads start near zero
    assert torch.equal(one.opacity_logits, field.gaussians.opacity_logits)
    assert len(field.gaussians) == 60 and field.gaussians.sh_degree == 3


def test_bent_gradients_are_those_of_the_picture(forest):
    """Of a position of the field, through the net: against central differences."""
    step = forest.make_step(10, 1)
    gradients = step.rendered.backward(torch.ones_like(step.photo) / step.photo.numel())
    found = gradients.fields["transient"].opacity_logits
    row = int(found.abs().argmax())
    logits = forest.drawing.others["transient"].gaussians.opacity_logits
    shot_mask = 1.0 - forest.hooks.mask.predict(step)
    photo_term = forest.hooks.fields.regularise(frames_of(step.rendered), step)["transient"].image

    def loss(moved):
        kept = logits.clone()
        logits.copy_(moved)
        frames = frames_of(forest.make_step(10, 1).rendered)
        logits.copy_(kept)
        image = frames["transient"].image
        mixed = (shot_mask[..., None] * image).sum() / step.photo.numel()
        return mixed + (photo_term * image).sum()

    assert found[row].item() == pytest.approx(slope(loss, logits, row, 0.02), rel=0.05)


def test_what_cannot_be_is_refused():
    for method, options, message in (
        ("forestsplats", {"filled": "2"}, r"forestsplats\.filled"),
        ("hybridgs", {"joint": "10"}, r"hybridgs\.joint"),
        ("t-3dgs", {"beta": "-1"}, r"t-3dgs\.beta"),
        ("nexussplats", {"features": "dinov9"}, "dinov9"),
    ):
        with pytest.raises(AwError, match=message):
            parts_of(method, **options)
