"""RefineSplat as a recipe of parts.

Source: "Rectifying Mask via Entropy for Distractor-Free 3DGS in Ambiguous Scenarios" (WACV 2027
submission).
"""

from __future__ import annotations

from ambiguous_wild.methods.refinesplat.config import RefineSplatConfig
from ambiguous_wild.methods.refinesplat.density import EntropyAwareDensity
from ambiguous_wild.methods.refinesplat.policy import RefineSplatMask
from ambiguous_wild.methods.wildgaussians import WildAppearance, WildGaussiansConfig
from ambiguous_wild.splat.parts import Parts, Schedule

Config = RefineSplatConfig


def build(options: RefineSplatConfig) -> Parts:
    """Masks, entropy terms and density control; the rest of the loop is 3DGS."""
    return Parts(
        mask=RefineSplatMask(options),
        density=EntropyAwareDensity,
        density_config=options.density,
        lambda_dssim=options.lambda_dssim,
        weighting=options.ssim,
        schedule=Schedule(per_pixel_short=options.per_pixel_short, lr_opacity=options.lr_opacity),
        effects=(WildAppearance(WildGaussiansConfig()),) if options.appearance else (),
    )
