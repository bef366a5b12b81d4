"""Every hyper-parameter of RefineSplat in one place. `literal` values are the paper as printed."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from typing import Literal

from ambiguous_wild.core import AwError
from ambiguous_wild.core.config import check_limits
from ambiguous_wild.methods.refinesplat.density_control import EntropyDensityConfig
from ambiguous_wild.methods.refinesplat.identity import PsiConfig
from ambiguous_wild.methods.refinesplat.mask_prior import InitialMaskPriorConfig
from ambiguous_wild.methods.refinesplat.multiview import MultiViewConfig
from ambiguous_wild.methods.refinesplat.threshold import Form, Statistic, Variant
from ambiguous_wild.vision.backends import check_features, check_instances
from ambiguous_wild.vision.segments import SegmentConfig

Spread = Literal["var", "std", "robust", "hard"]  # threshold of M_global, see evidence.global_mask
_ANY = math.inf


@dataclass(frozen=True)
class MaskConfig:
    """How masks are made from photo and render.

    `structure` judges pixels by colour and structure (structure.py) and needs no features. All other
    statistics are on the feature grid, and are the paper's or closer to it. Fields marked "features only"
    need one of these.
    """

    statistic: Statistic = "structure"  # what is judged; `entropy` is printed
    combine: Literal["fused", "union"] = "fused"  # local and global: geometric mean, or the printed union
    threshold: Form = "kapur"  # of `statistic` between static and transient; `literal` is printed
    hard: float = 10.0  # T_hard, units of the statistic
    hold: float = 0.67  # masked regions grow down to this share of the threshold
    fill: float = 0.01  # enclosed gaps below this share of the photo are filled
    base: float = 0.3  # share of the residual that counts where the structure agrees perfectly
    memory: float = 0.5  # weight of a photo's earlier residuals; `structure` only
    multiview: MultiViewConfig = field(default_factory=MultiViewConfig)  # other views; `structure` only
    entropy_weight: float = 0.0  # how much the contrast of identities scales `structure`, 0 to 1
    variant: Variant = "softmax"  # form of psi and its entropy; `sigmoid` is printed
    scope: Literal["scene", "photo"] = "scene"  # instances that the threshold divides; `photo` is printed
    gate: float = 3.0  # robust deviations an instance must stand above the median; 0 = printed
    # least value of the statistic in its unit; None: 10 for `structure`, else 4; 0 = printed
    least: float | None = None
    disagree: float = 3.0  # features only: `gate` for the distance of photo and render; 0 = printed
    # features only: least distance of photo and render in units of what blur and noise cause; 0 = printed
    disagree_units: float = 3.0
    # no threshold above this share of `unrelated_pair_residual`; 0 = printed
    ceiling: float = 0.25  # `structure` only
    ceiling_least: float = 6.0  # `structure` only: least value of the ceiling, in units
    use_local: bool = True  # M_local; off is an ablation row
    use_global: bool = True  # M_global; off is an ablation row
    # share of the photo's mean density of SfM tracks from which an instance is kept; 0 = printed
    static_tracks: float = 0.0
    # below this opacity the model is not learnt yet and gives no evidence; 0 = printed
    least_alpha: float = 0.5
    cosine: Literal["calibrated", "plain"] = "calibrated"  # features only: in U; `plain` is printed
    normal_units: float = 10.0  # features only: distance in units at which the calibrated cosine is 0
    box: int = 3  # features only: cells, box filter over U / H
    # features only: R = U / (H + this), printed; None: H is at least a tenth of its mean
    perturbation: float | None = None
    # features only: T_glb = mean + this; `var` is printed; `hard`: T_hard instead
    spread: Spread = "std"
    global_hard: float = 10.0  # features only: this T_hard, a value of U / H
    # features only: robust deviations above the median that M_global needs; 0 = printed
    global_gate: float = 6.0
    global_units: float = 8.0  # features only: least distance of the cell itself; 0 = printed
    dilation: int = 1  # px at the photo's resolution, 1 = none; 3, 5 (printed), 7 tried in the paper
    most: float = 0.7  # largest share of a photo that is masked; the surest pixels come first
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
        """Return these settings for a photo of which at most this share may be masked."""
        return replace(self, most=min(self.most, most))

    @property
    def floor(self) -> float:
        """`least` in the unit of the statistic."""
        if self.least is not None:
            return self.least
        return 10.0 if self.statistic == "structure" else 4.0

    @property
    def needs_identities(self) -> bool:
        """Whether masks read psi."""
        return self.statistic != "structure" or self.entropy_weight > 0


@dataclass(frozen=True)
class RefineSplatConfig:
    """Times in nominal iterations (of 30 000); the `min_` fields are real iterations of the run."""

    mask: MaskConfig = field(default_factory=MaskConfig)
    first_look: InitialMaskPriorConfig = field(
        default_factory=InitialMaskPriorConfig
    )  # keep maps until masks begin
    features: str = "labhog"  # back end of phi, see docs/foundation-models.md; `dinov2-small` is the paper's
    instances: str = "graph"  # back end of the instance masks; `grounded-video:...` is the paper's
    segments: SegmentConfig = field(default_factory=SegmentConfig)  # settings of `graph`
    # instances that a video back end finds in a photo but does not track: left out, or added to that photo
    untracked: Literal["drop", "add"] = "drop"
    psi: PsiConfig = field(default_factory=PsiConfig)  # the frozen identity classifier
    density: EntropyDensityConfig = field(default_factory=EntropyDensityConfig)  # growth and merging
    mask_start: float = 500.0  # warm-up: until then the prior alone decides which pixels are kept
    min_mask_start: int = 250  # earlier renders show too little
    reset_pause: float = 300.0  # time after an opacity reset in which masks are not refreshed
    min_reset_pause: int = 200
    mask_every: int = 4  # each view's mask is refreshed at every k-th of its visits
    entropy_every: int = 4  # iterations between entropy terms, each weighing that many times as much
    # Both losses are off: with weight-free features their gradient to the image is that of colours and edges.
    # 900 iterations on a simulated courtyard gave 28.2 dB without them, 26.4 with 0.001 and 0.0002, 25.3 with
    # 0.02 and 0.004, 18.0 with the paper's 1 and 0.2.
    lambda_id: float = 0.0  # weight of L_id; 1 = printed
    lambda_cr: float = 0.0  # alpha_1, weight of L_cr; 0.2 = printed, 0.1 to 0.3 tried in the paper
    weigh_id: bool = True  # L_id of kept cells only; false = printed
    weigh_cr: bool = True  # L_cr of kept cells only; false = printed
    # largest L2 norm of their gradient to the image, times that of L_GS; 0 = printed, no limit
    entropy_limit: float = 0.0
    lambda_dssim: float = 0.2  # weight of D-SSIM in L_GS
    ssim: Literal["map", "images"] = "map"  # keep weights the map of SSIM (printed), or both its pictures
    factor: Literal["keep", "transient"] = "keep"  # factor of L_GS; `transient` is M_final itself, as printed
    lr_opacity: float = 0.05  # 3DGS's present code has 0.025
    appearance: bool = False  # WildGaussians' embedding (32 a photo, 2 x 128), the paper's on Photo Tourism
    identities: int = 255  # largest P
    identity_tracks: int = 3  # SfM tracks that two instances must share to be one identity
    identity_share: float = 0.25  # least share of the tracks of the instance with fewer
    identity_similarity: float = 0.8  # least cosine of mean features for instances without tracks

    def __post_init__(self) -> None:
        check_limits(
            self, "refinesplat",
            mask_every=(1, _ANY), entropy_every=(1, _ANY), lambda_dssim=(0, 1), identities=(1, 255),
            identity_tracks=(1, _ANY), identity_share=(0, 1), identity_similarity=(-1, 1),
            lr_opacity=(0, _ANY),
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
