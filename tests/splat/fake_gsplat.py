"""gsplat's calls in plain torch: every pixel against every Gaussian, gradients by autograd.

Stands in for the package where there is no GPU: the code around it runs with real numbers on the CPU, and
without any on torch's `meta` device. Signatures, shapes and conventions are those of release 1.5.3.
"""

import contextlib
import sys
import types

import torch

from ambiguous_wild.splat import backend, gsplat_calls
from ambiguous_wild.splat.reference import harmonics, rotations

_BOX = 3.33  # deviations a radius has at most
MAX_ALPHA = 0.999


def fully_fused_projection(
    means, covars, quats, scales, viewmats, Ks, width, height, eps2d=0.3, near_plane=0.01, far_plane=1e10,
    radius_clip=0.0, packed=False, sparse_grad=False, calc_compensations=False, camera_model="pinhole",
    opacities=None,
):  # fmt: skip
    assert covars is None and not packed and len(viewmats) == len(Ks) == 1
    assert opacities is None or opacities.shape == means.shape[:-1]
    assert len(means), "gsplat divides by their number, in C++"
    pose, k = viewmats[0].to(means), Ks[0].to(means)
    local = means @ pose[:3, :3].T + pose[:3, 3]
    front = (local[:, 2] >= near_plane) & (local[:, 2] <= far_plane)
    z = torch.where(front, local[:, 2], torch.ones_like(local[:, 2]))
    ray = torch.where(front[:, None], local[:, :2], 0.0) / z[:, None]
    focal, centre = torch.stack([k[0, 0], k[1, 1]]), k[:2, 2]
    size = torch.stack([torch.full_like(k[0, 0], side) for side in (width, height)])
    margin = 0.15 * size / focal
    clamped = torch.minimum(torch.maximum(ray, -centre / focal - margin), (size - centre) / focal + margin)
    zero = torch.zeros_like(z)
    jacobian = torch.stack(
        [
            torch.stack([focal[0] / z, zero, -focal[0] * clamped[:, 0] / z], 1),
            torch.stack([zero, focal[1] / z, -focal[1] * clamped[:, 1] / z], 1),
        ],
        1,
    )
    spread = jacobian @ pose[:3, :3] @ (rotations(quats) * scales[:, None, :])
    covariance = spread @ spread.transpose(1, 2)
    a, b, c = covariance[:, 0, 0] + eps2d, covariance[:, 0, 1], covariance[:, 1, 1] + eps2d
    determinant = a * c - b * b
    raw = torch.linalg.cross(spread[:, 0], spread[:, 1]).square().sum(1)
    compensation = (raw / determinant).clamp(min=1e-30).sqrt()
    conics = torch.stack([c, -b, a], 1) / determinant[:, None]
    means2d = ray * focal + centre
    drawn = opacities if not calc_compensations else opacities * compensation
    extent = (2.0 * (drawn.clamp(min=1 / 255) * 255).log()).sqrt().clamp(max=_BOX)
    radii = torch.ceil(extent[:, None] * torch.stack([a, c], 1).sqrt()).detach()
    seen = front & (determinant > 0) & (drawn >= 1 / 255) & (radii > radius_clip).any(1)
    seen &= ((means2d + radii > 0) & (means2d - radii < size)).all(1)
    radii = torch.where(seen[:, None], radii.clamp(max=2**30), 0.0).to(torch.int32)
    compensations = compensation[None] if calc_compensations else None
    return radii[None], means2d[None], local[None, :, 2], conics[None], compensations


def spherical_harmonics(degrees_to_use, dirs, coeffs, masks=None):
    directions = torch.nn.functional.normalize(dirs, dim=1)
    bands = harmonics(directions, degrees_to_use)
    used = coeffs[:, 1 : (degrees_to_use + 1) ** 2]
    return 0.28209479177387814 * coeffs[:, 0] + torch.einsum("nk,nkc->nc", bands, used)


def isect_tiles(means2d, radii, depths, tile_size, tile_width, tile_height, sort=True, segmented=False,
                packed=False, n_images=None, image_ids=None, gaussian_ids=None):  # fmt: skip
    assert not depths.requires_grad and depths.shape == radii.shape[:-1] == means2d.shape[:-1]
    order = torch.argsort(depths[0], stable=True)
    if means2d.device.type != "meta":  # there, as many as there are Gaussians
        order = order[(radii[0] > 0).all(1)[order]]
    return radii[..., 0], order.long(), order.to(torch.int32)


def isect_offset_encode(isect_ids, n_images, tile_width, tile_height):
    return isect_ids.new_zeros(n_images, tile_height, tile_width, dtype=torch.int32)


def rasterize_to_pixels(means2d, conics, colors, opacities, image_width, image_height, tile_size,
                        isect_offsets, flatten_ids, backgrounds=None, masks=None, packed=False,
                        absgrad=False):  # fmt: skip
    tall, wide = -(-image_height // tile_size), -(-image_width // tile_size)
    assert isect_offsets.shape == (1, tall, wide)
    ids = flatten_ids.long()
    rows = torch.arange(image_height, device=means2d.device).to(means2d) + 0.5
    columns = torch.arange(image_width, device=means2d.device).to(means2d) + 0.5
    x = columns.repeat(image_height)[:, None]
    y = rows.repeat_interleave(image_width)[:, None]
    centres = means2d[0, ids].expand(image_height * image_width, len(ids), 2)
    if absgrad:
        centres = centres.clone()
        everywhere = means2d.new_zeros(means2d.shape)

        def keep(gradient):
            means2d.absgrad = everywhere.index_add(1, ids, gradient.abs().sum(0)[None])

        centres.register_hook(keep)
    dx, dy = centres[..., 0] - x, centres[..., 1] - y
    a, b, c = conics[0, ids].unbind(1)
    sigma = 0.5 * (a * dx * dx + c * dy * dy) + b * dx * dy
    alpha = opacities[0, ids] * torch.exp(-sigma)
    alpha = torch.where(alpha > MAX_ALPHA, MAX_ALPHA, alpha)
    alpha = torch.where((alpha < 1 / 255) | (sigma < 0), torch.zeros_like(alpha), alpha)
    after = torch.cumprod((1 - alpha).double(), 1).to(alpha)
    drawn = after > 1e-4
    alpha = torch.where(drawn, alpha, torch.zeros_like(alpha))
    after = torch.cumprod(1 - alpha, 1)
    before = torch.cat([torch.ones_like(x), after], 1)
    weight = before[:, :-1] * alpha
    picture = weight @ colors[0, ids]
    if backgrounds is not None:
        picture = picture + before[:, -1:] * backgrounds
    shape = (1, image_height, image_width)
    return picture.reshape(*shape, -1), (1 - before[:, -1]).reshape(*shape, 1)


def rasterization(means, quats, scales, opacities, colors, viewmats, Ks, width, height, sh_degree, packed):
    """What the example trainer calls; needs `means2d` with a graph of its own in what it says of itself."""
    radii, means2d, depths, conics, _ = fully_fused_projection(
        means, None, quats, scales, viewmats, Ks, width, height, opacities=opacities
    )
    centre = torch.inverse(viewmats)[0, :3, 3]  # as gsplat does; the host waits for it
    shade = spherical_harmonics(sh_degree, means - centre, colors).add(0.5).clamp(min=0.0)
    columns, rows = -(-width // 16), -(-height // 16)
    _, ids, flat = isect_tiles(means2d.detach(), radii, depths.detach(), 16, columns, rows)
    offsets = isect_offset_encode(ids, 1, columns, rows)
    picture, alpha = rasterize_to_pixels(
        means2d, conics, shade[None], opacities[None], width, height, 16, offsets, flat
    )
    return picture, alpha, {"means2d": means2d, "radii": radii}


def module():
    """The package."""
    fake = types.ModuleType("gsplat")
    fake.__version__ = "1.5.3"
    calls = (
        fully_fused_projection,
        spherical_harmonics,
        isect_tiles,
        isect_offset_encode,
        rasterize_to_pixels,
        rasterization,
    )
    for call in calls:
        setattr(fake, call.__name__, call)
    return fake


@contextlib.contextmanager
def installed(monkeypatch):
    """As if gsplat were installed; tensors on the CPU take the GPU's way."""
    with monkeypatch.context() as patch:
        patch.setitem(sys.modules, "gsplat", module())
        _forget()
        patch.setattr(backend, "accelerated", lambda _: True)
        yield
    _forget()


def _forget():
    for what in (gsplat_calls.gsplat, gsplat_calls.max_alpha):
        what.cache_clear()
