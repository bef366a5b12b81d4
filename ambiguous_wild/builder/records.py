"""Records that one build stage hands to the next.

They are written as JSON with the keys below: a stage's result to stage.json, `SceneRecord` to scene.json.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, Literal, NotRequired, TypedDict

from ambiguous_wild.core.scene import Evaluation, FileEntry

PlainSettings = dict[str, str | int | bool | None]  # `BuildSettings` as JSON


class ExifRecord(TypedDict, total=False):
    """`io.photos.Exif` without the values that the file does not state."""

    make: str
    model: str
    focal_mm: float
    focal_35mm: float
    exposure_s: float
    f_number: float
    iso: float
    white_balance: int
    orientation: int
    latitude_deg: float
    longitude_deg: float
    altitude_m: float
    taken_at: str


PURE_ROTATION = "the camera only turned, which shows no depth"  # why no photo of a capture has a pose


@dataclass(frozen=True)
class ScreenedPhoto:
    """A photo of the capture that can be read."""

    source: str  # path relative to the capture folder
    name: str  # of its files in every stage, whatever their format, and in the scene
    side: Literal["train", "test"] | None = None
    sha256: str = ""
    width: int = 0  # px; 0: not measured, as of the other values below
    height: int = 0  # px
    exif: ExifRecord = field(default_factory=ExifRecord)
    camera: str | None = None  # make and model
    sharpness: float = 0.0  # variance of the Laplacian: the lower, the softer
    mean_luma: float = 0.0  # of 255
    notes: Sequence[str] = ()  # what reading converted
    copies: Sequence[str] = ()  # files of the capture with the same bytes, left out
    borders: Sequence[int] = (0, 0, 0, 0)  # px of one colour at the top, bottom, left and right

    @property
    def stem(self) -> str:
        """Its name without .png, the key of masks in scene.json."""
        return self.name.removesuffix(".png")

    @property
    def size(self) -> tuple[int, int]:
        """Width and height, px."""
        return self.width, self.height


@dataclass(frozen=True)
class PhotoSplit:
    """The registered photos, by name, as training and test photos."""

    train: list[str]
    test: list[str]
    how: str  # "list", "folders", "every-8" or "none"
    warnings: list[str]


class SkippedPhoto(TypedDict):
    """A photo that is left out."""

    source: str
    skipped: str  # the reason


class ScreenResult(TypedDict):
    """Result of the stage `screen`."""

    photos: list[dict[str, Any]]  # fields of `ScreenedPhoto`
    skipped: list[SkippedPhoto]
    warnings: list[str]


class MaskResult(TypedDict):
    """Result of the stage `masks`."""

    kept_share: dict[str, float]  # stem -> share of white pixels
    alpha: list[str]  # stems of photos whose alpha hides pixels


class FeatureResult(TypedDict):
    """Result of the stage `features`."""

    camera: str  # "single", "per-device", "per-folder" or "per-image"
    features: dict[str, int]  # name -> number


class FixedRecord(TypedDict):
    """What stands still in all photos of one camera and size while the rest moves."""

    photos: list[str]  # photos that it is masked in: names; sources in scene.json
    width: int  # px, of these photos
    height: int  # px
    share: float  # of the photo
    where: str  # "lower", "upper right", ...; see `FixedArea.where`


class FixedMask(FixedRecord):
    """`FixedRecord` with its keep mask."""

    mask: str  # file in the folder of the stage `matches`


class MatchResult(TypedDict):
    """Result of the stage `matches`."""

    matcher: str  # "exhaustive", "sequential" or "retrieval"
    pairs: int  # pairs tried
    verified: int  # pairs with a relative pose that other pairs confirm
    planar: int  # verified pairs whose matches lie on one plane
    connected: int  # photos that verified pairs connect, so that no more can be registered
    fixed: list[FixedMask]  # fixed to the camera; none of its features is matched


class ModelSummary(TypedDict):
    """Size and accuracy of a model."""

    images: int
    points: int
    error_px: float  # mean reprojection error
    track_length: float  # mean


class CameraFact(TypedDict):
    """A camera with the focal length that the photos determine."""

    photos: list[str]  # names; sources in scene.json
    focal_px: float
    focal_sd_px: float | None  # standard deviation; None: unknown


class SceneCamera(CameraFact):
    """A camera in scene.json, with its lens: what undistorted its photos."""

    model: str  # of COLMAP
    width: int  # px
    height: int  # px
    params: list[float]  # px and distortion, in COLMAP's order


class MappingResult(TypedDict):
    """Result of the stage `mapping`."""

    model: ModelSummary | None
    left_out: dict[str, str]  # name of a photo that is not registered -> reason
    partners: dict[str, int]  # name -> covisible photos that support its pose
    provisional: list[str]  # names of photos registered with little evidence
    hypotheses: dict[str, list[float]]  # name of a photo that is left out -> likely position
    links: list[tuple[str, str, int]]  # pairs of registered photos that agree, with their inliers
    unregistered_links: list[tuple[str, str, int]]  # other pairs, with the inliers of the first relative pose
    components: list[list[str]]  # names of the photos of each, the largest first
    reliable: int  # photos of the largest component that are not provisional
    cameras: list[CameraFact]
    plan: str  # "fast", "wider", "thorough" or "covariant"


def no_model() -> MappingResult:
    """Return the result of a mapping that registered no photo."""
    return {
        "model": None, "left_out": {}, "partners": {}, "provisional": [], "hypotheses": {}, "links": [],
        "unregistered_links": [], "components": [], "reliable": 0, "cameras": [], "plan": "",
    }  # fmt: skip


class ResampleResult(TypedDict):
    """Result of the stage `undistort`."""

    factor: int  # of the smaller copies; 1: there are none
    truth: dict[str, int] | None  # part of the truth -> photos that have it


class MotionResult(TypedDict):
    """Result of the stage `motion`: features of the train photos, and votes by optical flow."""

    static: int
    moving: int  # they fit another motion than that of the static scene
    silent: int  # photos without any vote
    sequence: int  # photos whose neighbours vote by optical flow; 0: the photos are no sequence
    unfit: list[str]  # photos of a sequence whose optical flow does not fit their poses


class MapResult(TypedDict):
    """Result of the stage `map`."""

    advice: list[str]  # where to take more photos


class PackageResult(TypedDict):
    """Result of the stage `package`."""

    files: int
    bytes: int


class LostPhoto(TypedDict):
    """A readable photo that is not in the scene."""

    source: str
    reason: str


class ChosenMethods(TypedDict):
    """The choices that the settings "auto" led to."""

    camera: str
    sfm: str  # "fast", "wider", "thorough" or "covariant"
    matcher: str
    mapper: str


class SceneCounts(TypedDict):
    """Numbers of photos, cameras, points, pairs and features."""

    photos: int
    readable: int
    registered: int
    train: int
    test: int
    cameras: int
    points: int
    points_seen_in_test_only: int
    points_of_track_length_2: int
    pairs: int
    pairs_verified: int
    features_that_stay: int  # features of train photos that are static by other photos
    features_that_move: int  # features of train photos that fit another motion
    photos_of_sequence: int  # train photos with votes by optical flow


class ScenePhoto(TypedDict):
    """One readable photo in scene.json."""

    source: str
    sha256: str
    split: str | None  # None: not in the scene
    width: int
    height: int
    sharpness: float
    mean_luma: float
    features: int
    partners: int  # covisible photos that support its pose; 0: not in the scene
    provisional: bool  # registered with little evidence
    notes: list[str]
    exif: ExifRecord  # without GPS


class BuildInputs(TypedDict):
    """Everything that the scene's files depend on."""

    photos: list[list[str | None]]  # source, stem, side, sha256, and "copy" where it is one
    masks: list[list[str]] | None  # path and sha256 of every file
    truth: list[list[str]] | None
    test_list: str | None  # sha256
    settings: PlainSettings
    versions: dict[str, str]


class BuildRecord(TypedDict):
    """Result of a build: the part of scene.json that a person reads."""

    name: str
    license: str
    factor: int
    images: str
    split: str  # "list", "folders" or "every-8"
    seed: int
    settings: PlainSettings
    chosen: ChosenMethods
    counts: SceneCounts
    reprojection_error_px: float
    mean_track_length: float
    cameras: list[SceneCamera]
    lost: list[LostPhoto]
    skipped: list[SkippedPhoto]
    warnings: list[str]
    photos: dict[str, ScenePhoto]
    masks: MaskResult | None
    fixed_to_camera: list[FixedRecord]
    truth: dict[str, int] | None
    evaluation: NotRequired[Evaluation]  # as a simulated capture says


class KeyedRecord(BuildRecord):
    """`BuildRecord` with what it was built from and how long that took."""

    build_key: str
    inputs: BuildInputs
    capture: str  # folder of the photos, relative to the scene's
    seconds: dict[str, float]  # stage -> s


class SceneRecord(KeyedRecord):
    """scene.json of a built scene."""

    schema: str
    schema_version: int
    files: dict[str, FileEntry]  # path -> sha256 and size


class CapturedPhoto(TypedDict):
    """One photo of a capture's capture.json."""

    photo: str
    source: NotRequired[str]  # of a copied photo
    frame: NotRequired[int]  # of a video or a camera
    time_s: NotRequired[float]
    sharpness: float


class LeftOut(TypedDict):
    """A photo of the source folder that was not copied."""

    source: str
    why: str


Kind = Literal["folder", "video", "camera", "several"]


class FrameCounts(TypedDict):
    """Frames of a video."""

    source: NotRequired[str]
    frames_read: int
    frames_announced: int | None  # by the header; None where it says nothing usable


class CaptureRecord(TypedDict):
    """capture.json of `aw capture`."""

    version: str
    kind: Kind
    source: str
    videos: NotRequired[list[FrameCounts]]  # of several sources
    frames_read: NotRequired[int]
    frames_announced: NotRequired[int | None]
    photos: list[CapturedPhoto]
    left_out: list[LeftOut]
