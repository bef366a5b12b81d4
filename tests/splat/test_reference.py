"""The judge judged: finite differences in float64, closed forms, and harmonics against scipy."""

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation
from scipy.special import sph_harm_y

from ambiguous_wild.core import Camera
from ambiguous_wild.splat.effects.geometry import higher_harmonics
from ambiguous_wild.splat.reference import harmonics, render_reference, rotations

from .scenes import camera, doubles, gaussians


@pytest.mark.parametrize("antialias", [False, True])
def test_autograd_equals_finite_differences(antialias):
    g = gaussians(21, n=6)
    g.means[:, 2] += 2.0
    g.opacity_logits[:] = torch.linspace(-1, 1, 6)
    cam, rng = camera(9, 8), np.random.default_rng(0)
    weights = torch.from_numpy(rng.normal(size=(8, 9, 5)))

    def loss(parameters):
        r = render_reference(parameters, cam, sh_degree=2, antialias=antialias, background=(0.2, 0.1, 0.7))
        return (torch.cat([r.image, r.alpha[..., None], r.depth[..., None]], -1) * weights).sum()

    parameters = doubles(g)
    loss(parameters).backward()
    for name, leaf in parameters.items():
        for _ in range(4):
            direction = torch.from_numpy(rng.normal(size=leaf.shape))
            step = 1e-6

            def moved(sign, name=name, leaf=leaf, direction=direction, step=step):
                changed = {k: v.detach() for k, v in parameters.items()}
                changed[name] = leaf.detach() + sign * step * direction
                return loss(changed).item()

            numeric = (moved(1) - moved(-1)) / (2 * step)
            analytic = (leaf.grad * direction).sum().item()
            # a pixel that crosses the 1/255 cut between the two sides jumps; the step is small enough
            assert analytic == pytest.approx(numeric, rel=2e-5, abs=1e-5), name


def test_one_gaussian_on_the_axis_is_the_closed_form():
    cam = Camera(11, 9, 20.0, 20.0, 5.5, 4.5, np.eye(4))
    g = gaussians(0, n=1)
    g.means[0] = torch.tensor([0.0, 0.0, 2.0])
    g.log_scales[:] = float(np.log(0.2))
    g.opacity_logits[:] = 0.5
    r = render_reference(doubles(g), cam, sh_degree=0, background=(0.0, 0.0, 1.0))
    variance = (0.2 * 20 / 2) ** 2 + 0.3  # px^2: focal * scale / depth, plus the blur
    y, x = np.mgrid[:9, :11] + 0.5
    alpha = np.exp(-((x - 5.5) ** 2 + (y - 4.5) ** 2) / (2 * variance)) / (1 + np.exp(-0.5))
    alpha[alpha < 1 / 255] = 0
    np.testing.assert_allclose(r.alpha.detach(), alpha, atol=1e-6)
    colour = np.maximum(g.sh0[0].numpy() * 0.5 / np.sqrt(np.pi) + 0.5, 0)
    expected = alpha[..., None] * colour + (1 - alpha[..., None]) * [0, 0, 1]
    np.testing.assert_allclose(r.image.detach(), expected, atol=1e-6)
    np.testing.assert_allclose(r.depth.detach(), alpha * 2.0, atol=1e-6)


def test_harmonics_are_the_real_ones_of_scipy():
    rng = np.random.default_rng(0)
    d = rng.normal(size=(50, 3))
    d /= np.linalg.norm(d, axis=1, keepdims=True)
    theta, phi = np.arccos(d[:, 2]), np.arctan2(d[:, 1], d[:, 0])
    expected = []
    for degree in (1, 2, 3):
        for order in range(-degree, degree + 1):
            y = sph_harm_y(degree, abs(order), theta, phi)
            part = y.real if order == 0 else np.sqrt(2) * (y.imag if order < 0 else y.real)
            expected.append(part)  # with the Condon-Shortley phase, as 3DGS's constants have it
    np.testing.assert_allclose(harmonics(torch.from_numpy(d), 3).numpy(), np.stack(expected, 1), atol=1e-12)


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_harmonics_of_effects_are_the_judges(degree):
    d = torch.nn.functional.normalize(torch.from_numpy(np.random.default_rng(1).normal(size=(50, 3))), dim=1)
    assert torch.equal(higher_harmonics(d, degree), harmonics(d, degree))


def test_rotations_are_those_of_scipy():
    q = np.random.default_rng(0).normal(size=(20, 4))
    expected = Rotation.from_quat(q[:, [1, 2, 3, 0]]).as_matrix()
    np.testing.assert_allclose(rotations(torch.from_numpy(q)).numpy(), expected, atol=1e-12)
