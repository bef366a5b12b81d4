"""Stand-ins for gsplat's compiled kernels, in torch: its own Python runs around them, on the CPU."""

import contextlib
import sys
from types import ModuleType, SimpleNamespace
from unittest import mock

import torch

from ambiguous_wild.splat import device

from . import fake_gsplat


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
    shade = fake_gsplat.spherical_harmonics(
        degree, dirs.reshape(-1, 3), coeffs.reshape(-1, *coeffs.shape[-2:])
    )
    # rows left out are memory as it was
    return torch.where(masks[..., None], shade.view(dirs.shape), torch.nan)


def harmonics_bwd(bases, degree, dirs, coeffs, masks, v_colors, wanted):
    assert wanted
    v_colors = torch.where(masks[..., None], v_colors, 0.0).reshape(-1, 3)
    shapes, flat = (dirs.shape, coeffs.shape), (dirs.reshape(-1, 3), coeffs.reshape(-1, *coeffs.shape[-2:]))
    v_dirs, v_coeffs = pulled(lambda d, c: [fake_gsplat.spherical_harmonics(degree, d, c)], flat, [v_colors])
    return v_coeffs.view(shapes[1]), v_dirs.view(shapes[0])


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


@contextlib.contextmanager
def in_place():
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
    fake_gsplat._forget()
    with (
        mock.patch.dict(sys.modules, {"gsplat.cuda._backend": backend}),
        mock.patch.object(device, "accelerated", lambda _: True),
    ):
        yield
    fake_gsplat._forget()
