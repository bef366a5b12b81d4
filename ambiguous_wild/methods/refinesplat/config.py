"""Every hyper-parameter of RefineSplat in one place. `literal` values are the paper as printed."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from typing import Literal

from ambiguous_wild.core import AwError
from ambiguous_wild.core.config import check_limits
from ambiguous_wild.methods.refinesplat.density import EntropyDensityConfig
from ambiguous_wild.methods.refinesplat.first_look import FirstLookConfig
from ambiguous_wild.methods.refinesplat.identity import PsiConfig
from ambiguous_wild.methods.refinesplat.multiview import MultiViewConfig
from ambiguous_wild.methods.refinesplat.threshold import Form, Statistic, Variant
from ambiguous_wild.vision.backends import check_features, check_instances
from ambiguous_wild.vision.segments import SegmentConfig

Spread = Literal["var", "std", "robust", "hard"]  # of the threshold of M_global, see masking.global_mask
_ANY = math.inf


@dataclass(frozen=True)
class MaskConfig:
    """From photo and render to M_final. docs/notes/refinesplat.md: figures behind the defaults.

    `structure` judges pixels by colour and structure (structure.py) and needs no features; all other
    statistics are on the feature grid and are the paper's, or nearer to it. Fields marked F are used with
    those only.
    """

    statistic: Statistic = "structure"  # what is judged; `entropy` is printed
    combine: Literal["fused", "union"] = "fused"  # local and global: geometric mean, or the printed union
    threshold: Form = "kapur"  # of `statistic` between static and transient; `literal` is printed
    hard: float = 10.0  # T_hard, units of the statistic
    hold: float = 0.67  # a masked region reaches down to this share of the threshold
    fill: float = 0.01  # of the photo: enclosed gaps below it are filled
    base: float = 0.3  # of the residual counts even where the structure agrees perfectly
    memory: float = 0.5  # of a photo's earlier residuals in the present one; `structure` only
    multiview: MultiViewConfig = field(
        default_factory=MultiViewConfig
    )  # evidence of other views; `structure` only
    entropy_weight: float = 0.0  # how much the contrast of identities scales `structure`, 0 to 1
    variant: Variant = "softmax"  # of psi and its entropy; `sigmoid` is printed
    scope: Literal["scene", "photo"] = "scene"  # instances that the threshold divides; `photo` is printed
    gate: float = 3.0  # robust deviations an instance must stand above the median; 0 = printed
    least: float | None = (
        None  # and the statistic at least, in its unit: 10 of `structure`, else 4; 0 = printed
    )
    disagree: float = (
        3.0  # features only: `gate` for the feature distance between photo and render; 0 = printed
    )
    disagree_units: float = (
        3.0  # features only: and at least this many units of what blur and noise make; 0 = printed
    )
    # no threshold above this share of the residual of unrelated pictures (`unrelated_residual`); 0 = printed
    ceiling: float = 0.25  # `structure` only
    ceiling_least: float = 6.0  # `structure` only: the ceiling is at least so many units
    use_local: bool = True  # M_local; off is an ablation row
    use_global: bool = True  # M_global; off is an ablation row
    static_tracks: float = 0.0  # of the photo's mean SfM track density keeps an instance; 0 = printed
    least_alpha: float = (
        0.5  # below this opacity the model is not learnt yet and gives no evidence; 0 = printed
    )
    cosine: Literal["calibrated", "plain"] = "calibrated"  # features only: in U; `plain` is printed
    normal_units: float = 10.0  # features only: distance in units at which the calibrated cosine is 0
    box: int = 3  # features only: cells, box filter over U / H
    perturbation: float | None = (
        None  # features only: R = U / (H + this), printed; None: H is a tenth of its mean at least
    )
    spread: Spread = (
        "std"  # features only: T_glb = mean + this; `var` is printed; `hard`: T_hard in its place
    )
    global_hard: float = 10.0  # features only: that T_hard, a value of U / H
    global_gate: float = (
        6.0  # features only: robust deviations above the median that M_global needs; 0 = printed
    )
    global_units: float = 8.0  # features only: and the distance of the cell itself at least; 0 = printed
    dilation: int = 1  # px at the photo's resolution, 1 = none; 3, 5 (printed), 7 tried in the paper
    most: float = 0.7  # of a photo is masked at most: the surest pixels go first
    w2: float | None = None  # fixed weight of T_ent's lower subset; None = learnt

    def __post_init__(self) -> None:
        check_limits(
            self, "refinesplat.mask",
            hold=(0.01, 1), fill=(0, 1), base=(0, 1), memory=(0, 1), entropy_weight=(0, 1), most=(0, 1),
            least_alpha=(0, 1), w2=(0, 1), normal_units=(1e-6, _ANY), box=(1, _ANY), dilation=(1, _ANY),
            perturbation=(1e-12, _ANY),
            **dict.fromkeys(
                ("hard", "gate", "least", "disagree", "disagree_units", "ceiling", "ceiling_least",
                 "static_tracks",
                 "global_gate", "global_units", "global_hard"), (0, _ANY),
            ),
        )  # fmt: skip
        for name in ("box", "dilation"):
            if getattr(self, name) % 2 == 0:
                raise AwError(f"refinesplat.mask.{name} is an odd number, got {getattr(self, name)}")

    def limited(self, most: float) -> MaskConfig:
        """These settings for a photo of which no more than this share is masked."""
        return replace(self, most=min(self.most, most))

    @property
    def floor(self) -> float:
        """`least` in the unit of the statistic."""
        if self.least is not None:
            return self.least
        return 10.0 if self.statistic == "structure" else 4.0

    @property
    def needs_identities(self) -> bool:
        """Whether masks read psi at all."""
        return self.statistic != "structure" or self.entropy_weight > 0


@dataclass(frozen=True)
class RefineSplatConfig:
    """Times in nominal iterations (of 30 000); the `min_` fields are real iterations of the run."""

    mask: MaskConfig = field(default_factory=MaskConfig)
    first_look: FirstLookConfig = field(default_factory=FirstLookConfig)  # keep maps until masks begin
    features: str = "labhog"  # back end of phi, see docs/foundation-models.md; `dinov2-small` is the paper's
    instances: str = "graph"  # back end of the instance masks; `grounded-video:...` is the paper's
    segments: SegmentConfig = field(default_factory=SegmentConfig)  # of `graph`
    # instances that a video back end finds in a photo but does not track: left out, or added to that photo
    untracked: Literal["drop", "add"] = "drop"
    psi: PsiConfig = field(default_factory=PsiConfig)  # the frozen identity classifier
    density: EntropyDensityConfig = field(default_factory=EntropyDensityConfig)  # growth and merging
    mask_start: float = 500.0  # warm-up: until then the first look alone decides which pixels are kept
    min_mask_start: int = 250  # earlier renders show too little
    reset_pause: float = 300.0  # masks are not refreshed for so long after an opacity reset
    min_reset_pause: int = 200
    mask_every: int = 4  # each view's mask is refreshed at every k-th of its visits
    entropy_every: int = 4  # iterations between entropy terms, each weighing that many times as much
    # Both losses are off: with weight-free features their gradient to the image is that of colours and edges.
    # 900 iterations on a simulated courtyard gave 28.2 dB without them, 26.4 with 0.001 and 0.0002, 25.3 with
    # 0.02 and 0.004, 18.0 with the paper's 1 and 0.2.
    lambda_id: float = 0.0  # of L_id; 1 = printed
    lambda_cr: float = 0.0  # alpha_1, of L_cr; 0.2 = printed, 0.1 to 0.3 tried in the paper
    weigh_id: bool = True  # L_id of kept cells only; false = printed
    weigh_cr: bool = True  # L_cr of kept cells only; false = printed
    # their gradient to the image is no longer than this times that of L_GS (L2 norms); 0 = printed, no limit
    entropy_limit: float = 0.0
    lambda_dssim: float = 0.2  # of D-SSIM in L_GS
    ssim: Literal["map", "images"] = "map"  # keep weighs the map of SSIM (printed), or both its pictures
    factor: Literal["keep", "transient"] = "keep"  # of L_GS; `transient` is M_final itself, as printed
    lr_opacity: float = 0.05  # of Adam; 3DGS's present code has 0.025
    appearance: bool = False  # WildGaussians' embedding (32 a photo, 2 x 128), the paper's on Photo Tourism
    per_pixel_short: float = 0.85  # Gaussians per photo pixel at most, in short runs; others are given 1
    identities: int = 255  # P at most
    identity_tracks: int = 3  # SfM tracks that two instances must share to be one identity
    identity_share: float = 0.25  # and their share of the tracks of the one with fewer
    identity_similarity: float = 0.8  # cosine of mean features where no tracks run

    def __post_init__(self) -> None:
        check_limits(
            self, "refinesplat",
            mask_every=(1, _ANY), entropy_every=(1, _ANY), lambda_dssim=(0, 1), identities=(1, 255),
            identity_tracks=(1, _ANY), identity_share=(0, 1), identity_similarity=(-1, 1),
            per_pixel_short=(1e-3, _ANY), lr_opacity=(0, _ANY),
            **dict.fromkeys(
                ("mask_start", "min_mask_start", "reset_pause", "min_reset_pause", "lambda_id", "lambda_cr",
                 "entropy_limit"), (0, _ANY),
            ),
        )  # fmt: skip
        check_features(self.features)
        check_instances(self.instances)
        if self.density.decides == "entropy" and not (self.lambda_id or self.lambda_cr):
            raise AwError(
                "refinesplat.density.decides=entropy: both entropy losses are off, so nothing would "
                "grow; add --set refinesplat.lambda_cr=0.2, or decide by total"
            )
