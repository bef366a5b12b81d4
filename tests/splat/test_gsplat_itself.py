"""gsplat's own Python, its checks and its graph, around a stand-in for its compiled kernels alone.

Runs where gsplat is installed, with or without a GPU: what the render call hands over must pass gsplat's
assertions on shapes, and come back through gsplat's own backward functions.
"""

import sys
from types import ModuleType, SimpleNamespace

import pytest
import torch

from ambiguous_wild.splat import device
from ambiguous_wild.splat.gpu import gsplat_seam
from ambiguous_wild.splat.render import render
from ambiguous_wild.stress.float64_check import agree, cloud
from ambiguous_wild.stress.float64_check import camera as front_camera

from . import fake_gsplat
from .scenes import camera, cotangents, gaussians, given

gsplat = pytest.importorskip("gsplat")


def pulled(function, inputs, cotangents):
    """Gradients of `function(*inputs)` for these cotangents; zeros where there is none."""
    with torch.enable_grad():
        leaves = [t.detach().requires_grad_(True) for t in inputs]
        outputs = function(*leaves)
        pairs = [(o, c) for o, c in zip(outputs, cotangents) if c is not None and o.requires_grad]
        return torch.autograd.grad(
            [o for o, _ in pairs], leaves, [c for _, c in pairs], allow_unused=True, materialize_grads=True
        )


def projection(means, quats, scales, opacities, viewmats, Ks, width, height, eps2d, near, clip, calc):
    return fake_gsplat.fully_fused_projection(
        means, None, quats, scales, viewmats, Ks, width, height, eps2d, near, radius_clip=clip,
        calc_compensations=calc, opacities=opacities,
    )  # fmt: skip


def projection_fwd(means, covars, quats, scales, opacities, viewmats, Ks, width, height, eps2d, near, far,
                   clip, calc, model):  # fmt: skip
    assert covars is None and model == "pinhole" and opacities.shape == means.shape[:-1]
    out = projection(means, quats, scales, opacities, viewmats, Ks, width, height, eps2d, near, clip, calc)
    return *out[:4], torch.ones_like(out[2]) if out[4] is None else out[4]


def projection_bwd(means, covars, quats, scales, viewmats, Ks, width, height, eps2d, model, radii,
                   conics, compensations, v_means2d, v_depths, v_conics, v_compensation, *more):  # fmt: skip
    calc = compensations is not None
    seen = (radii > 0).all(-1)

    def forward(m, q, s):
        opaque = torch.ones_like(m[:, 0])
        out = projection(m, q, s, opaque, viewmats, Ks, width, height, eps2d, 0.01, 0.0, calc)
        return [o for o in out[1:] if o is not None]

    cots = [v_means2d, v_depths, v_conics, *([v_compensation] if calc else [])]
    cots = [torch.where(seen.view(*seen.shape, *[1] * (c.dim() - 2)), c, 0.0) for c in cots]
    v_means, v_quats, v_scales = pulled(forward, (means, quats, scales), cots)
    return v_means, None, v_quats, v_scales, None


def harmonics_fwd(degree, dirs, coeffs, masks):
    shade = fake_gsplat.spherical_harmonics(degree, dirs, coeffs)
    # rows left out are memory as it was
    return torch.where(masks[:, None], shade, torch.nan)


def harmonics_bwd(bases, degree, dirs, coeffs, masks, v_colors, wanted):
    assert wanted
    v_colors = torch.where(masks[:, None], v_colors, 0.0)
    v_dirs, v_coeffs = pulled(
        lambda d, c: [fake_gsplat.spherical_harmonics(degree, d, c)], (dirs, coeffs), [v_colors]
    )
    return v_coeffs, v_dirs


def intersect_tile(
    means2d, radii, depths, image_ids, gaussian_ids, images, size, columns, rows, sort, segmented
):
    assert image_ids is None and gaussian_ids is None and images == 1 and radii.dtype == torch.int32
    return fake_gsplat.isect_tiles(means2d, radii, depths, size, columns, rows, sort, segmented)


def rasterize_fwd(means2d, conics, colors, opacities, backgrounds, masks, width, height, size, offsets, ids):
    picture, alpha = fake_gsplat.rasterize_to_pixels(
        means2d, conics, colors, opacities, width, height, size, offsets, ids, backgrounds
    )
    return picture, alpha, torch.zeros_like(alpha, dtype=torch.int32)[..., 0]


def rasterize_bwd(means2d, conics, colors, opacities, backgrounds, masks, width, height, size, offsets, ids,
                  alphas, last_ids, v_colors, v_alphas, absgrad):  # fmt: skip
    with torch.enable_grad():
        leaves = [t.detach().requires_grad_(True) for t in (means2d, conics, colors, opacities)]
        out = fake_gsplat.rasterize_to_pixels(
            *leaves, width, height, size, offsets, ids, backgrounds, absgrad=absgrad
        )
        found = torch.autograd.grad(
            out, leaves, [v_colors, v_alphas], allow_unused=True, materialize_grads=True
        )
    return getattr(leaves[0], "absgrad", None), *found


@pytest.fixture
def kernels(monkeypatch):
    """gsplat as it is installed, its compiled module replaced; tensors of the CPU take the GPU's path."""
    backend = ModuleType("gsplat.cuda._backend")
    backend._C = SimpleNamespace(
        CameraModelType="all of them",
        PINHOLE="pinhole",
        projection_ewa_3dgs_fused_fwd=projection_fwd,
        projection_ewa_3dgs_fused_bwd=projection_bwd,
        spherical_harmonics_fwd=harmonics_fwd,
        spherical_harmonics_bwd=harmonics_bwd,
        intersect_tile=intersect_tile,
        intersect_offset=fake_gsplat.isect_offset_encode,
        rasterize_to_pixels_3dgs_fwd=rasterize_fwd,
        rasterize_to_pixels_3dgs_bwd=rasterize_bwd,
    )
    monkeypatch.setitem(sys.modules, "gsplat.cuda._backend", backend)
    monkeypatch.setattr(device, "accelerated", lambda _: True)
    fake_gsplat.module("1.5.3")  # its clamp
    caches = (
        gsplat_seam.gsplat,
        gsplat_seam.ready,
        gsplat_seam.max_alpha,
        gsplat_seam._tests_tiles_by_ellipse,
    )
    for cache in caches:
        cache.cache_clear()
    yield
    for cache in caches:
        cache.cache_clear()


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("antialias", [False, True])
@pytest.mark.parametrize("degree", [0, 1])
def test_what_comes_out_is_what_float64_gives(kernels, seed, antialias, degree):
    measured = agree(cloud(30, seed), front_camera(), "cpu", "", sh_degree=degree, antialias=antialias)
    assert measured.error <= measured.tolerance, measured


def test_what_is_culled_leaves_no_number_that_is_none(kernels):
    """Colours of rows that are culled are memory as it was, NaN here; nothing of them may be read."""
    g, cam = gaussians(3), camera()
    rendered = render(g, cam, sh_degree=3)
    assert not rendered.visible.all()
    d = cotangents(cam.height, cam.width)
    grads = rendered.backward(given(d), frozenset({"absolute"}))
    for name in (*dict(g.items()), "screen", "screen_extra", "screen_abs"):
        assert torch.isfinite(getattr(grads, name)).all(), name
        assert not getattr(grads, name)[~rendered.visible].any(), name
    assert torch.isfinite(rendered.image).all()


def test_the_clamp_is_measured(kernels):
    assert gsplat_seam.max_alpha("cpu") == 0.999
    assert gsplat_seam.version() == gsplat.__version__
