"""What every back end of `render` gives back: the pictures, who was seen, and the way back."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

from torch import Tensor


@dataclass
class Gradients:
    """dL/dparameter of every Gaussian, plus the screen-space statistics density control reads.

    `screen` is dL/d(u, v) in 1/px for the cotangent `d_image` (with d_alpha and d_depth) alone;
    `screen_extra` the same for `d_image_extra` alone. `screen_abs` sums absolute values over pixels
    before the sum over pixels (AbsGS) and is filled only on request.
    """

    means: Tensor  # [N, 3]
    quats: Tensor  # [N, 4]
    log_scales: Tensor  # [N, 3]
    opacity_logits: Tensor  # [N]
    sh0: Tensor  # [N, 3]
    sh_rest: Tensor  # [N, K, 3]
    screen: Tensor  # [N, 2]
    screen_extra: Tensor | None = None  # [N, 2]
    screen_abs: Tensor | None = None  # [N, 2]


class Rendered(Protocol):
    """What a back end returns: the pictures, who was seen, and the way back."""

    image: Tensor  # [H, W, 3] float32, background included, not clamped
    alpha: Tensor  # [H, W] float32 in [0, 1]
    visible: Tensor  # [N] bool, passed every cull

    @property
    def radii(self) -> Tensor:
        """[N] float32 px, largest half extent of the 1/255 contour; 0 where not visible."""
        ...

    @property
    def depth(self) -> Tensor:
        """[H, W] float32, sum of weight times z; divide by alpha for the expected depth."""
        ...

    def backward(
        self,
        d_image: Tensor,  # [H, W, 3] dL/dimage
        *,
        d_image_extra: Tensor | None = None,  # [H, W, 3] a second cotangent, added; statistic kept apart
        d_alpha: Tensor | None = None,  # [H, W]
        d_depth: Tensor | None = None,  # [H, W]
        absolute: bool = False,  # fill Gradients.screen_abs
    ) -> Gradients:
        """Gradients of sum(d_image * image) + ... with respect to every raw parameter."""
        ...
