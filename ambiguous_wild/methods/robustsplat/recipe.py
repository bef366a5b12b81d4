"""RobustSplat as a recipe of parts.

Source: "RobustSplat: Decoupling Densification and Dynamics for Transient-Free 3DGS", ICCV 2025 (arXiv
2506.02751) and its released code. Densification and opacity resets wait until the static scene and the
masks are stable; a per-pixel net on frozen features learns from the agreement of photos with renders,
first at a low scale.

The published form is `features=dinov2-small-registers@504,normalise=raw`, the default where its weights are;
else EfficientNet-Lite0, else hand-made features (Lab and HOG). Settings that change with that are "auto" in
`config.py`.
"""

from __future__ import annotations

from ambiguous_wild.methods.robustsplat.config import RobustSplatConfig
from ambiguous_wild.methods.robustsplat.policy import RobustSplatMask
from ambiguous_wild.splat.parts import Parts, Schedule

Config = RobustSplatConfig


def build(options: RobustSplatConfig) -> Parts:
    """Mask net, delayed growth, both pictures masked before SSIM; the rest of the loop is 3DGS."""
    return Parts(
        mask=RobustSplatMask(options),
        density_config=options.density,
        schedule=Schedule(lr_opacity=options.lr_opacity),
        lambda_dssim=options.lambda_dssim,
        weighting="images",
    )
