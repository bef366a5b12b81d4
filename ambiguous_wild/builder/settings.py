"""Settings of a build, as scene.json records them, and the plans of structure from motion they lead to.

The first plan costs little; if it leaves photos out, the next one does more work.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

from ambiguous_wild.builder.records import ScreenedPhoto
from ambiguous_wild.builder.retrieval import EXHAUSTIVE_LIMIT, FAST_EXHAUSTIVE_LIMIT, FEW_PHOTOS, NEIGHBOURS
from ambiguous_wild.core.errors import AwError

CameraMode = Literal["auto", "single", "per-device", "per-folder", "per-image"]
Matcher = Literal["auto", "exhaustive", "sequential", "retrieval"]
Mapper = Literal["incremental", "global", "truth"]
Effort = Literal["auto", "fast", "thorough"]


WIDER = 40  # pairs in the second attempt of a photo that was left out
MIN_REGISTERED = 0.9  # registered share that ends the attempts: more pairs seldom register the rest
HALF = 0.5  # the same of more than `FEW_PHOTOS` photos, before all pairs are matched
MANY_FEATURES = 8000  # of a photo in the last attempt at a small capture, whose photos may overlap little
RATIO, LOOSE_RATIO = 0.8, 0.9  # of the distances of matches; the second where photos may overlap little
MAX_FEATURES = 100_000  # largest --max-features; SIFT finds fewer in any photo


@dataclass(frozen=True)
class BuildSettings:
    """Settings of `build_scene`; none depends on the machine."""

    factor: int | None = None  # downsampling; None: of 1, 2, 4, 8 the largest that leaves 480 px
    camera: CameraMode = "auto"  # auto: one camera if EXIF and size agree, else one a device or a photo
    sfm: Effort = "auto"  # auto: fast, then more where it leaves photos out
    matcher: Matcher = "auto"  # auto: exhaustive up to 25 photos (thorough: 200), then retrieval
    mapper: Mapper = "incremental"  # global: faster on many photos, weaker on few; truth: simulated cameras
    part: int = 1  # of a capture that falls into parts, the one to build; 1 is the largest
    max_features: int = 3000  # SIFT features a photo, as COLMAP counts: up to 5400; thorough: at least 8000
    max_side: int = 1600  # px; photos are reduced to this for SIFT only
    seed: int = 0  # of every random choice inside COLMAP
    masks_missing: Literal["error", "keep"] = "error"  # a photo without a mask: refuse, or use it whole
    no_test: bool = False  # train on all photos; nothing can be measured then
    strict: bool = False  # refuse the capture if one photo cannot be read
    name: str = ""  # of the scene; empty: the output folder's name
    license: str = ""  # of the photos, as the user states it

    def __post_init__(self) -> None:
        if self.factor is not None and not 1 <= self.factor <= 64:
            raise AwError(f"--factor must be between 1 and 64, got {self.factor}")
        if not 100 <= self.max_features <= MAX_FEATURES:
            raise AwError(
                f"--max-features must be between 100, to match anything, and {MAX_FEATURES}, "
                f"got {self.max_features}"
            )
        if self.mapper == "truth" and (self.camera, self.part) != ("auto", 1):
            raise AwError("--mapper truth knows cameras and poses: leave out --camera and --part")
        if self.part < 1:
            raise AwError(f"--part must be 1 or more, got {self.part}")
        if not 0 <= self.seed < 2**31:
            raise AwError(f"--seed must be between 0 and 2147483647, got {self.seed}")


@dataclass(frozen=True)
class SfmPlan:
    """Settings of one attempt; `benchmarks/results/poses.md` compares the plans on real captures."""

    name: str  # "fast", "wider", "thorough" or "covariant"
    sift: str  # "opencv"; "colmap", three to five times as long; "covariant" (affine shape), twice that
    max_features: int  # a photo
    ratio: float  # largest ratio of the distances to the best and the second best match
    matcher: str  # "exhaustive", "retrieval" or "sequential"
    similar: int  # photos that each is matched with, for "retrieval"
    neighbours: int  # next photos in the order of capture, for "retrieval"
    ba_global_ratio: float  # all cameras are adjusted whenever the model has grown by this factor
    ba_global_max_refinements: int  # rounds of such an adjustment, at most
    ba_global_tolerance: float  # relative change of the error that ends a round; 0: the gradient ends it
    ba_local_max_refinements: int  # rounds of the adjustment after a photo was registered, at most
    ba_local_num_images: int  # images in it: the new one and those that share most points with it
    continues: bool = False  # only photos left out so far look for pairs, besides those matched so far
    worth: float = 0.0  # share of the photos that pairs must connect, else nothing is mapped
    below: float = 1.0  # the plan runs only if a smaller share of the photos is registered so far


def plans(photos: Sequence[ScreenedPhoto], settings: BuildSettings) -> list[SfmPlan]:
    """Return the attempts in order; each next one runs if the one before leaves photos out."""
    if settings.mapper == "truth":
        return [_thorough(len(photos), settings) if settings.sfm == "thorough" else _fast(photos, settings)]
    thorough = _thorough(len(photos), settings)
    # Other features find other pairs: a capture that one kind leaves in parts may be whole by the other.
    covariant = replace(thorough, name="covariant", sift="covariant", ratio=LOOSE_RATIO, below=MIN_REGISTERED)
    careful = [thorough, covariant] if len(photos) <= FEW_PHOTOS else [thorough]
    if settings.sfm == "thorough":
        return careful
    fast = _fast(photos, settings)
    if settings.sfm == "fast":
        return [fast]
    fast = replace(fast, worth=HALF)
    if fast.matcher != "retrieval":
        return [fast, *careful]
    wider = replace(
        fast, name="wider", similar=WIDER, neighbours=NEIGHBOURS, continues=True, below=MIN_REGISTERED
    )
    below = MIN_REGISTERED if len(photos) <= FEW_PHOTOS else HALF
    return [fast, wider, replace(thorough, below=below), *careful[1:]]


def _fast(photos: Sequence[ScreenedPhoto], settings: BuildSettings) -> SfmPlan:
    matcher = _matcher(len(photos), settings, FAST_EXHAUSTIVE_LIMIT)
    many = len(photos) > EXHAUSTIVE_LIMIT
    return SfmPlan(
        "fast",
        sift="opencv",
        max_features=settings.max_features,
        ratio=RATIO,
        matcher=matcher,
        similar=16 if many else 14,
        neighbours=5 if many else 2,
        ba_global_ratio=2.0,
        ba_global_max_refinements=1,
        # All photos are registered anew afterwards, and of many the last digits cost most of the time.
        ba_global_tolerance=1e-4 if len(photos) > FEW_PHOTOS else 0.0,
        ba_local_max_refinements=1,
        ba_local_num_images=4,
    )


def _thorough(count: int, settings: BuildSettings) -> SfmPlan:
    return SfmPlan(
        "thorough",
        sift="colmap",
        max_features=max(settings.max_features, MANY_FEATURES * (count <= FEW_PHOTOS)),
        ratio=RATIO,
        matcher=_matcher(count, settings, EXHAUSTIVE_LIMIT),
        similar=16,
        neighbours=5,
        ba_global_ratio=1.1,
        ba_global_max_refinements=5,
        ba_global_tolerance=0.0,
        ba_local_max_refinements=2,
        ba_local_num_images=6,
    )


def _matcher(count: int, settings: BuildSettings, limit: int) -> str:
    if settings.matcher != "auto":
        return settings.matcher
    return "exhaustive" if count <= limit else "retrieval"
