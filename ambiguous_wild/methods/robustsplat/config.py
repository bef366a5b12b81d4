"""Every hyper-parameter of RobustSplat in one place; values without a word beside them are the authors'."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

from ambiguous_wild.core import AwError
from ambiguous_wild.splat.density import DensityConfig

NO_SIZE_PRUNING = 1e9  # extents; the authors prune by opacity alone
PUBLISHED_STEPS = 29_500  # of the net: from nominal 500 to 30 000, one an iteration


def _delayed_growth() -> DensityConfig:
    return DensityConfig(
        start=10_000.0, stop=20_000.0, resets=(15_000.0, 18_000.0), prune_scale=NO_SIZE_PRUNING
    )


@dataclass(frozen=True)
class RobustSplatConfig:
    """Times in nominal iterations (of 30 000); the `min_` fields are real iterations of the run.

    "auto" is the published form with a net's features and the calibrated one with hand-made ones.
    """

    features: str = "labhog"  # see vision/backends.py; published: dinov2-small-registers@504,normalise=raw
    coarse_features: str = ""  # of the coarse stage; "" = the same kind at 16/36 of the size, as published
    coarse_share: float = 16 / 36  # of the side of the pictures that hand-made coarse features see
    cosine: Literal["auto", "calibrated", "plain"] = "auto"  # what the cosine target is made of
    normal_units: float = 10.0  # calibrated: distance at which the cosine is 0 and half of it the target
    inputs: Literal["auto", "standardised", "raw"] = "auto"  # of the net
    # cells over which hand-made features are averaged and put beside the cell's own: a net's token sees the
    # whole photo, a hand-made cell 20 px
    context: tuple[int, ...] = ()
    hidden: int = 16
    lr: float = 1e-3
    density: DensityConfig = field(default_factory=_delayed_growth)
    lr_opacity: float = 0.025
    lambda_dssim: float = 0.2
    mask_start: float = 500.0
    min_mask_start: int = 300  # a render of fewer iterations means nothing
    bootstrap: float = 20_000.0  # coarse supervision before, fine after
    coarse_divisor: int = 4  # of the render's side for the coarse residual
    coarse_render: Literal["render", "shrink"] = "render"  # a render of its own, or the full one shrunk
    lower: float = 0.6  # share of residuals that is surely static
    upper: float = 0.8  # and of those that may be
    decay: float = 0.95  # of the running histogram
    bins: int = 10_000
    beta: float = 2000.0  # decay of the pull towards "all static"
    lambda_pull: float = 2.0
    lambda_cosine: float = 0.5
    lambda_residual: float = 0.5
    threshold: float = 0.25  # kept above
    erosion: int = 7  # px, side of the min-pool
    reset_pause: float = 300.0  # the net rests so long after an opacity reset
    min_reset_pause: int = 200

    def __post_init__(self) -> None:
        if not 0 < self.lower <= self.upper <= 1:
            raise AwError(f"robustsplat: need 0 < lower <= upper <= 1, got {self.lower} and {self.upper}")
        if not 0 < self.coarse_share <= 1:
            raise AwError(f"robustsplat.coarse_share is above 0, at most 1, got {self.coarse_share}")
        if not 0 <= self.decay < 1:
            raise AwError(f"robustsplat.decay is from 0 to below 1, got {self.decay}")
        if self.erosion < 1 or self.erosion % 2 == 0:
            raise AwError(f"robustsplat.erosion is an odd number of px, got {self.erosion}")
        if any(size < 1 or size % 2 == 0 for size in self.context):
            raise AwError(f"robustsplat.context holds odd numbers of cells, got {self.context}")
        for name in ("hidden", "bins", "coarse_divisor", "lr", "beta", "normal_units"):
            if getattr(self, name) <= 0:
                raise AwError(f"robustsplat.{name} must be above 0, got {getattr(self, name)}")

    @property
    def hand_made(self) -> bool:
        """Whether the features are not a net's."""
        return self.features.startswith("labhog")
