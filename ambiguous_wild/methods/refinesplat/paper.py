"""The paper's method: `refinesplat-paper` (repaired where the print degenerates), `refinesplat-printed`.

docs/fidelity.md compares both with the paper, equation by equation. Settings that the paper does not state
have the values of `refinesplat`.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass, field
from typing import Literal

from ambiguous_wild.methods.refinesplat.density_control import EntropyDensityConfig, SupportConfig
from ambiguous_wild.methods.refinesplat.hyperparameters import MaskConfig, RefineSplatConfig
from ambiguous_wild.methods.refinesplat.mask_prior import InitialMaskPriorConfig
from ambiguous_wild.methods.refinesplat.merging import MergeConfig
from ambiguous_wild.vision.backends import BY_MACHINE, first_available

# Masks by entropy (Eqs. 3 to 7). Two forms are repaired: Kapur's for the additive objective of T_ent, and the
# standard deviation for the variance in T_glb. Of our gates and limits only `most` is on.
MASK = MaskConfig(
    statistic="entropy",
    variant="sigmoid",
    combine="union",
    scope="photo",
    threshold="kapur",
    spread="std",
    dilation=5,
    cosine="plain",
    gate=0.0,
    least=0.0,
    disagree=0.0,
    disagree_units=0.0,
    ceiling=0.0,
    global_gate=0.0,
    global_units=0.0,
    static_tracks=0.0,
    least_alpha=0.0,
    fill=0.0,
)
PRINTED_MASK = dataclasses.replace(
    MASK,
    threshold="literal",
    spread="var",
    perturbation=1e-6,  # "a small perturbation"
    most=1.0,
)
DENSITY = EntropyDensityConfig(
    merge=MergeConfig(most=0),
    support=SupportConfig(least_share=0.0),
)
PRINTED_DENSITY = dataclasses.replace(DENSITY, merge=MergeConfig(form="literal", most=0))


def features(size: str = "") -> str:
    """Return the paper's features, DINOv2 ViT-S/14, if this machine has their weights.

    Otherwise EfficientNet-Lite0, and without its weights `labhog`; docs/fidelity.md compares them.

    Args:
        size: size of the net's input as in the name of a back end, e.g. "@504".
    """
    return first_available(f"dinov2-small{size}", "efficientnet-lite0", "labhog")


def instances() -> str:
    """Return all masks of SAM 2, joined over photos by SfM tracks, if this machine has its weights.

    Otherwise segments grouped by EfficientNet-Lite0, and without its weights `graph`.
    """
    return first_available("sam2", "efficientnet-lite0", "graph")


@dataclass(frozen=True)
class PaperConfig(RefineSplatConfig):
    """All parts of the paper; its networks depend on this machine, see `features`, `instances`."""

    mask: MaskConfig = MASK
    first_look: InitialMaskPriorConfig = InitialMaskPriorConfig(on=False)  # noqa: RUF009
    features: str = field(default_factory=features, metadata=BY_MACHINE)
    instances: str = field(default_factory=instances, metadata=BY_MACHINE)
    untracked: Literal["drop", "add"] = "add"
    density: EntropyDensityConfig = DENSITY
    lambda_id: float = 1.0
    lambda_cr: float = 0.2
    entropy_limit: float = 0.1  # without, 7 dB below 3DGS (docs/fidelity.md)
    weigh_cr: bool = False
    entropy_every: int = 8  # PSNR is within 0.1 dB of the best interval's


@dataclass(frozen=True)
class PrintedConfig(PaperConfig):
    """The paper to the letter, without limits."""

    mask: MaskConfig = PRINTED_MASK
    features: str = field(default_factory=lambda: features("@504"), metadata=BY_MACHINE)
    density: EntropyDensityConfig = PRINTED_DENSITY
    entropy_limit: float = 0.0
    weigh_id: bool = False
    mask_every: int = 1
    entropy_every: int = 1
    reset_pause: float = 0.0
    min_reset_pause: int = 0
    lr_opacity: float = 0.025
