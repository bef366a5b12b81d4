"""The settings of a build, as scene.json records them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from ambiguous_wild.core.errors import AwError

CameraMode = Literal["auto", "single", "per-device", "per-image"]
Matcher = Literal["auto", "exhaustive", "sequential", "retrieval"]
Mapper = Literal["incremental", "global"]
Effort = Literal["auto", "fast", "thorough"]


MOST_FEATURES = 100_000  # a photo; SIFT finds fewer in any


@dataclass(frozen=True)
class BuildSettings:
    """Settings of `build_scene`; none depends on the machine."""

    factor: int | None = None  # downsampling; None: of 1, 2, 4, 8 the largest that leaves 480 px
    camera: CameraMode = "auto"  # auto: one camera if EXIF and size agree, else one a device or a photo
    sfm: Effort = "auto"  # auto: fast, then more where it leaves photos out
    matcher: Matcher = "auto"  # auto: exhaustive up to 25 photos (thorough: 200), then retrieval
    mapper: Mapper = "incremental"  # global is faster on many photos, weaker on few
    max_features: int = 3000  # SIFT features a photo
    max_side: int = 1600  # px; photos are reduced to this for SIFT only
    seed: int = 0  # of every random choice inside COLMAP
    masks_missing: Literal["error", "keep"] = "error"  # a photo without a mask: refuse, or use it whole
    strict: bool = False  # refuse the capture if one photo cannot be read
    name: str = ""  # of the scene; empty: the output folder's name
    license: str = ""  # of the photos, as the user states it

    def __post_init__(self) -> None:
        if self.factor is not None and not 1 <= self.factor <= 64:
            raise AwError(f"--factor must be between 1 and 64, got {self.factor}")
        if not 100 <= self.max_features <= MOST_FEATURES:
            raise AwError(
                f"--max-features must be between 100, to match anything, and {MOST_FEATURES}, "
                f"got {self.max_features}"
            )
        if not 0 <= self.seed < 2**31:
            raise AwError(f"--seed must be between 0 and 2147483647, got {self.seed}")
