"""Reference renderer and loss in float64 torch, every pixel against every Gaussian, by autograd.

It is slow on purpose: nothing is tiled, approximated or differentiated by hand. It has the conventions of
`render.render`; tests measure both back ends against it.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from ambiguous_wild.core import Camera

_C1 = 0.4886025119029199
_C2 = (1.0925484305920792, -1.0925484305920792, 0.31539156525252005, -1.0925484305920792, 0.5462742152960396)
_C3 = (
    -0.5900435899266435,
    2.890611442640554,
    -0.4570457994644658,
    0.3731763325901154,
    -0.4570457994644658,
    1.445305721320277,
    -0.5900435899266435,
)


# Two layers at the alpha clamp leave (1 - 0.99)^2, which is exactly 1e-4 and stops the pixel; float64 rounds
# it to just above, every float32 renderer to just below.
_STOP = 1e-4 * (1 + 1e-12)


@dataclass
class Reference:
    """Pictures in float64, part of the graph of the parameters."""

    image: Tensor  # [H, W, 3]
    alpha: Tensor  # [H, W]
    depth: Tensor  # [H, W]
    visible: Tensor  # [N] bool
    conic: Tensor  # [N, 2, 2] inverse of the blurred covariance in the image
    screen: Tensor  # [N, 2] projected means, part of the graph, so that autograd can return their gradient


def harmonics(directions: Tensor, degree: int) -> Tensor:
    """Return the real spherical harmonics 1 .. (degree + 1)^2 - 1 at unit directions [N, 3], [N, K]."""
    x, y, z = directions.unbind(1)
    terms: list[Tensor] = []
    if degree >= 1:
        terms += [-_C1 * y, _C1 * z, -_C1 * x]
    if degree >= 2:
        terms += [
            _C2[0] * x * y,
            _C2[1] * y * z,
            _C2[2] * (2 * z * z - x * x - y * y),
            _C2[3] * x * z,
            _C2[4] * (x * x - y * y),
        ]
    if degree >= 3:
        terms += [
            _C3[0] * y * (3 * x * x - y * y),
            _C3[1] * x * y * z,
            _C3[2] * y * (4 * z * z - x * x - y * y),
            _C3[3] * z * (2 * z * z - 3 * x * x - 3 * y * y),
            _C3[4] * x * (4 * z * z - x * x - y * y),
            _C3[5] * z * (x * x - y * y),
            _C3[6] * x * (x * x - 3 * y * y),
        ]
    return torch.stack(terms, 1) if terms else directions.new_zeros(len(directions), 0)


def rotations(quats: Tensor) -> Tensor:
    """Return rotation matrices [N, 3, 3] of quaternions [N, 4] (w, x, y, z) of any positive norm."""
    w, x, y, z = (quats / quats.norm(dim=1, keepdim=True)).unbind(1)
    rows = [
        1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
        2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
        2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y),
    ]  # fmt: skip
    return torch.stack(rows, 1).reshape(-1, 3, 3)


def render_reference(
    parameters: dict[str, Tensor],  # as Gaussians.items(), float64
    camera: Camera,
    *,
    sh_degree: int = 3,
    background: tuple[float, float, float] = (0.0, 0.0, 0.0),
    antialias: bool = False,
    max_alpha: float = 0.99,  # the clamp; 0.999 judges gsplat up to 1.5.3
    blur: float = 0.3,  # px^2
    shade: Callable[[Tensor], Tensor] | None = None,  # SH + 0.5 [N, 3] -> colours
) -> Reference:
    """Render with autograd. A tensor has H * W * N doubles, so this suits tens of Gaussians and pixels."""
    pose = torch.tensor(camera.cam_from_world)
    means = parameters["means"]
    local = means @ pose[:3, :3].T + pose[:3, 3]
    front = local[:, 2] >= 0.01
    z = torch.where(
        front, local[:, 2], torch.ones_like(local[:, 2])
    )  # keeps culled Gaussians out of the graph
    ray = local[:, :2] / z[:, None]
    focal = torch.tensor([camera.fx, camera.fy], dtype=torch.float64)
    centre = torch.tensor([camera.cx, camera.cy], dtype=torch.float64)
    size = torch.tensor([camera.width, camera.height], dtype=torch.float64)
    screen = ray * focal + centre

    # EWA: J at the centre clamped to the frustum widened by 0.3 of half its size.
    margin = 0.15 * size / focal
    clamped = torch.minimum(torch.maximum(ray, -centre / focal - margin), (size - centre) / focal + margin)
    jacobian = means.new_zeros(len(means), 2, 3)
    jacobian[:, 0, 0] = camera.fx / z
    jacobian[:, 1, 1] = camera.fy / z
    jacobian[:, :, 2] = -focal * clamped / z[:, None]
    half = rotations(parameters["quats"]) * torch.exp(parameters["log_scales"])[:, None, :]
    spread = jacobian @ pose[:3, :3] @ half
    covariance = spread @ spread.transpose(1, 2)
    blurred = covariance + blur * torch.eye(2, dtype=torch.float64)
    determinant = torch.linalg.det(blurred)
    opacity = torch.sigmoid(parameters["opacity_logits"])
    if antialias:
        ratio = torch.linalg.cross(spread[:, 0], spread[:, 1]).square().sum(1) / determinant
        opacity = opacity * ratio.clamp(min=1e-300).sqrt()
    visible = front & (opacity >= 1 / 255)
    conic = torch.linalg.inv(blurred)

    direction = torch.nn.functional.normalize(means - torch.tensor(camera.center), dim=1)
    k = (sh_degree + 1) ** 2 - 1
    harmonic = 0.28209479177387814 * parameters["sh0"] + 0.5
    harmonic = harmonic + torch.einsum(
        "nk,nkc->nc", harmonics(direction, sh_degree), parameters["sh_rest"][:, :k]
    )
    colour = (harmonic if shade is None else shade(harmonic)).clamp(min=0.0)

    rows, columns = torch.meshgrid(
        torch.arange(camera.height, dtype=torch.float64) + 0.5,
        torch.arange(camera.width, dtype=torch.float64) + 0.5,
        indexing="ij",
    )
    pixels = torch.stack([columns, rows], -1)
    image = means.new_zeros(camera.height, camera.width, 3)
    depth = means.new_zeros(camera.height, camera.width)
    through = means.new_ones(camera.height, camera.width)
    stopped = torch.zeros(camera.height, camera.width, dtype=torch.bool)
    touched = torch.zeros(len(means), dtype=torch.bool)
    for i in torch.argsort(local[:, 2].detach(), stable=True).tolist():
        if not visible[i]:
            continue
        d = pixels - screen[i]
        power = 0.5 * (conic[i, 0, 0] * d[..., 0] ** 2 + conic[i, 1, 1] * d[..., 1] ** 2)
        power = power + conic[i, 0, 1] * d[..., 0] * d[..., 1]
        e = opacity[i] * torch.exp(-power)
        # no gradient where alpha is clamped, a convention of all renderers
        alpha = torch.where(e > max_alpha, torch.full_like(e, max_alpha), e)
        alpha = torch.where(alpha < 1 / 255, torch.zeros_like(alpha), alpha)
        touched[i] = bool((alpha > 0).any())
        stopped = stopped | (through * (1 - alpha) <= _STOP)
        alpha = torch.where(stopped, torch.zeros_like(alpha), alpha)
        weight = through * alpha
        image = image + weight[..., None] * colour[i]
        depth = depth + weight * local[i, 2]
        through = through * (1 - alpha)
    image = image + through[..., None] * torch.tensor(background, dtype=torch.float64)
    return Reference(image, 1 - through, depth, touched, conic, screen)


def ssim_map_reference(a: Tensor, b: Tensor) -> Tensor:
    """Return what `losses.ssim_map` does, differentiable, for any device and float type."""
    taps = torch.exp(-((torch.arange(11, dtype=torch.float64) - 5.0) ** 2) / (2 * 1.5**2))
    taps = (taps / taps.sum()).to(a)

    def blur(x: Tensor) -> Tensor:
        x = torch.nn.functional.conv2d(
            x, taps.view(1, 1, 11, 1).expand(15, 1, 11, 1), padding=(5, 0), groups=15
        )
        return torch.nn.functional.conv2d(
            x, taps.view(1, 1, 1, 11).expand(15, 1, 1, 11), padding=(0, 5), groups=15
        )

    stack = torch.cat([a, b, a * a, b * b, a * b], 2).permute(2, 0, 1)[None]
    mean_a, mean_b, aa, bb, ab = blur(stack)[0].permute(1, 2, 0).split(3, 2)
    numerator = (2 * mean_a * mean_b + 0.01**2) * (2 * (ab - mean_a * mean_b) + 0.03**2)
    spread = (aa - mean_a**2) + (bb - mean_b**2) + 0.03**2
    return numerator / ((mean_a**2 + mean_b**2 + 0.01**2) * spread)


def photometric_reference(
    render: Tensor, photo: Tensor, keep: Tensor | None, lambda_dssim: float, weighting: str
) -> tuple[float, float, Tensor]:
    """Return L1, 1 - SSIM and the gradient of their mix as `losses.photometric`, by autograd."""
    with torch.enable_grad():
        x = render.detach().requires_grad_(True)
        y = photo
        weight = torch.ones_like(x[..., :1]) if keep is None else keep.to(x)[..., None]
        l1 = (weight * (x - y).abs()).mean()
        if weighting == "images":
            dssim = (1 - ssim_map_reference(weight * x, weight * y)).mean()
        else:
            dssim = (weight * (1 - ssim_map_reference(x, y))).mean()
        (gradient,) = torch.autograd.grad((1 - lambda_dssim) * l1 + lambda_dssim * dssim, x)
    return float(l1.detach()), float(dssim.detach()), gradient
