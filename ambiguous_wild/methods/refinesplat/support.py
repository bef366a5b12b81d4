"""Gaussians that no kept pixel supports.

A Gaussian that is masked in every photo whose frame contains it is never corrected; a view between those
photos shows it as a dark blotch in mid-air. Such Gaussians are removed. If one was right, the hole it leaves
is no evidence for a mask (`least_alpha`) and is learnt again.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from ambiguous_wild.core import Camera
from ambiguous_wild.core.config import check_limits
from ambiguous_wild.splat.backend import backend_of
from ambiguous_wild.splat.density import rotation_matrices
from ambiguous_wild.splat.gaussians import Gaussians


@dataclass(frozen=True)
class SupportConfig:
    """When a Gaussian counts as unsupported."""

    least_share: float = 0.1  # of the looks must reach a kept pixel; 0 = never removed (printed)
    looks: int = 8  # with its centre in the frame, before it is judged
    every: int = 4  # iterations between looks

    def __post_init__(self) -> None:
        whole = (1, math.inf)
        check_limits(self, "refinesplat.density.support", least_share=(0, 1), looks=whole, every=whole)


class Support:
    """Per Gaussian, how often its centre was in the frame and how often it reached a kept pixel."""

    def __init__(self, config: SupportConfig) -> None:
        self.config = config
        self.looked = torch.zeros(0)  # [N]
        self.kept = torch.zeros(0)  # [N]

    def due(self, iteration: int) -> bool:
        """Whether this iteration counts."""
        return self.config.least_share > 0 and iteration % self.config.every == 0

    def look(self, gaussians: Gaussians, visible: Tensor, camera: Camera, keep: Tensor | None) -> None:
        """Add one view.

        Args:
            gaussians: N of them.
            visible: [N] bool, passed every cull of the render.
            camera: of the step.
            keep: [H, W] float32 at the camera's size, 1 = static; None = all of it.
        """
        backend = backend_of(gaussians.device)
        rows = backend.rows(lambda: visible)
        means = gaussians.means[rows]
        inside, supported = _on_kept(means, camera, keep)
        if keep is not None:
            hidden = backend.rows(lambda: inside & ~supported)
            # a large one is supported at its flanks too
            parts = means[hidden], gaussians.quats[rows][hidden], gaussians.log_scales[rows][hidden]
            supported[hidden] |= _flank_on_kept(*parts, camera, keep)
        inside &= visible[rows]
        self.looked[rows] += inside.to(self.looked.dtype)
        self.kept[rows] += (inside & supported).to(self.kept.dtype)

    def judge(self) -> Tensor:
        """Gaussians to remove, [N] bool; counts of judged ones that stay are halved."""
        judged = self.looked >= self.config.looks
        drop = judged & (self.kept < self.config.least_share * self.looked)
        half = torch.where(judged, 0.5, 1.0)
        self.looked, self.kept = self.looked * half, self.kept * half
        return drop

    def select(self, stay: Tensor) -> None:
        """Keep the rows `stay` [N] bool."""
        self.looked, self.kept = self.looked[stay], self.kept[stay]

    def match(self, count: int, device: torch.device) -> None:
        """Pad with zeros for new rows; after a resume, bring the counts to the device."""
        pad = torch.zeros(max(count - len(self.looked), 0), device=device)
        self.looked = torch.cat([self.looked.to(device), pad])
        self.kept = torch.cat([self.kept.to(device), pad])

    def state_dict(self) -> dict[str, Any]:
        return {"looked": self.looked, "kept": self.kept}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        self.looked, self.kept = state["looked"], state["kept"]


def _flank_on_kept(
    means: Tensor,  # [N, 3]
    quats: Tensor,  # [N, 4]
    log_scales: Tensor,  # [N, 3]
    camera: Camera,
    keep: Tensor | None,
) -> Tensor:
    """Gaussians whose flanks, one standard deviation along every axis, reach a kept pixel, [N] bool."""
    axes = rotation_matrices(quats) * log_scales.exp()[:, None, :]
    ends = means[:, None, :] + torch.cat([axes, -axes], dim=2).transpose(1, 2)
    _, flanks = _on_kept(ends.reshape(-1, 3), camera, keep)
    return flanks.reshape(-1, 6).any(dim=1)


def _on_kept(points: Tensor, camera: Camera, keep: Tensor | None) -> tuple[Tensor, Tensor]:
    """Of world points [N, 3]: inside the frame, and on a kept pixel, [N] bool each."""
    pose = backend_of(points.device).pose(camera, points)
    local = points @ pose[:3, :3].T + pose[:3, 3]
    z = local[:, 2].clamp(min=1e-6)
    u = torch.floor((local[:, 0] / z * camera.fx + camera.cx).clamp(-1.0, camera.width)).long()
    v = torch.floor((local[:, 1] / z * camera.fy + camera.cy).clamp(-1.0, camera.height)).long()
    inside = (local[:, 2] > 0) & (u >= 0) & (u < camera.width) & (v >= 0) & (v < camera.height)
    if keep is None:
        return inside, inside.clone()
    kept = keep[v.clamp(0, camera.height - 1), u.clamp(0, camera.width - 1)] > 0.5
    return inside, inside & kept
