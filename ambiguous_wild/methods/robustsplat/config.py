"""Every hyper-parameter of RobustSplat in one place; values without a comment are the authors'."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

from ambiguous_wild.core import AwError
from ambiguous_wild.splat.density import NO_SIZE_PRUNING, DensityConfig
from ambiguous_wild.vision.backends import BY_MACHINE, DINO, check_features, first_here, parse

_SIZES = dict.fromkeys((*DINO, "vgg16"), 252)  # px of a net's input without "@"; others take the photo's size
PUBLISHED = "dinov2-small-registers@504,normalise=raw"


def features() -> str:
    """The published features where their weights are on this machine, else EfficientNet-Lite0, else `labhog`.

    Of those that need no hub EfficientNet-Lite0 alone falls below 3DGS on no capture (docs/fidelity.md).
    """
    return first_here(PUBLISHED, "efficientnet-lite0", "labhog")


def _delayed_growth() -> DensityConfig:
    return DensityConfig(
        start=10_000.0, stop=20_000.0, resets=(15_000.0, 18_000.0), prune_scale=NO_SIZE_PRUNING
    )


@dataclass(frozen=True)
class RobustSplatConfig:
    """Times in nominal iterations (of 30 000); the `min_` fields are real iterations of the run.

    "auto" and None are the published form with DINO's features, and with all others, whose cells see a small
    part of the photo and whose cosines have other scales, what was tuned with `labhog` on
    two simulated captures that are not reported (240x135, 2000 iterations, 10 900 Gaussians). Distractors in
    the background's colours: 26.3 dB and IoU 0.41 with features of the cell alone, 29.1 dB and 0.62 with
    wider context and a wider net, both at lr 0.003; twins of static things: 29.5 dB and 0.68 with the latter.
    """

    features: str = field(default_factory=features, metadata=BY_MACHINE)  # see vision/backends.py
    coarse_features: str = ""  # of the coarse stage; "" = the same kind at 16/36 of the size, as published
    coarse_share: float = 16 / 36  # of the side of the pictures that coarse features see
    # what the cosine target is made of: the cosine; its distance in units of what blur makes; or in units of
    # the distance that a share `lower` of all cells lately stayed below
    cosine: Literal["auto", "calibrated", "plain", "relative"] = "auto"
    reach: float = 3.0  # of those units, where the relative target is 0
    normal_units: float = (
        10.0  # of distance, where the calibrated cosine is 0; the target is 0 from half of it on
    )
    inputs: Literal["auto", "standardised", "raw"] = "auto"  # of the net
    # cells over which local features are averaged and put beside the cell's own: a token of DINO sees the
    # whole photo, a cell of labhog 20 px
    context: tuple[int, ...] | None = None  # None: 5,15 with local features; DINO never takes any
    hidden: int | None = None  # None: 16, published; 64 with local features
    lr: float | None = None  # None: 0.001, published; 0.003 with local features
    density: DensityConfig = field(default_factory=_delayed_growth)
    lr_opacity: float = 0.025
    lambda_dssim: float = 0.2
    mask_start: float = 500.0
    min_mask_start: int = 300  # earlier renders show too little
    bootstrap: float = 20_000.0  # coarse supervision before, fine after
    coarse_divisor: int = 4  # of the render's side for the coarse residual
    coarse_render: Literal["render", "shrink"] = "render"  # a render of its own, or the full one shrunk
    lower: float = 0.6  # share of residuals that are surely static
    upper: float = 0.8  # share that may be static
    decay: float = 0.95  # of the running histogram
    bins: int = 10_000
    beta: float = 2000.0  # decay of the pull towards "all static"
    lambda_pull: float = 2.0
    lambda_cosine: float = 0.5
    lambda_residual: float = 0.5
    threshold: float = 0.25  # kept above
    erosion: int = 7  # px, side of the min-pool
    reset_pause: float = 300.0  # the net does not learn for so long after an opacity reset
    min_reset_pause: int = 200

    def __post_init__(self) -> None:
        for spec in (self.features, self.coarse_features):
            if spec:
                check_features(spec)
        if not 0 < self.lower <= self.upper <= 1:
            raise AwError(f"robustsplat: need 0 < lower <= upper <= 1, got {self.lower} and {self.upper}")
        if not 0 < self.coarse_share <= 1:
            raise AwError(f"robustsplat.coarse_share is above 0, at most 1, got {self.coarse_share}")
        if not 0 <= self.decay < 1:
            raise AwError(f"robustsplat.decay is from 0 to below 1, got {self.decay}")
        if self.reach <= 1:
            raise AwError(f"robustsplat.reach must be above 1, got {self.reach}")
        if self.erosion < 1 or self.erosion % 2 == 0:
            raise AwError(f"robustsplat.erosion is an odd number of px, got {self.erosion}")
        if any(size < 1 or size % 2 == 0 for size in self.context or ()):
            raise AwError(f"robustsplat.context holds odd numbers of cells, got {self.context}")
        for name in ("hidden", "bins", "coarse_divisor", "lr", "beta", "normal_units"):
            value = getattr(self, name)
            if value is not None and value <= 0:
                raise AwError(f"robustsplat.{name} must be above 0, got {value}")

    @property
    def net_context(self) -> tuple[int, ...]:
        """Sides in cells of the boxes whose means the net sees beside a cell's own features."""
        if not self.local:
            return ()
        return (5, 15) if self.context is None else self.context

    @property
    def net_hidden(self) -> int:
        """Width of the net."""
        return self.hidden or (64 if self.local else 16)

    @property
    def net_lr(self) -> float:
        """Learning rate of the net."""
        return self.lr or (3e-3 if self.local else 1e-3)

    @property
    def local(self) -> bool:
        """Whether a cell of the features sees a small part of the photo: all but DINO's."""
        return parse(self.features).name not in DINO

    @property
    def coarse_size(self) -> int | None:
        """Longer side in px of the coarse net's input; None: the features follow the size of the picture."""
        found = parse(self.features)
        size = _SIZES.get(found.name, 0) if found.size is None else found.size
        if found.size == 0 or not size:
            return None
        return round(size * self.coarse_share)
