"""Records that the simulator writes as JSON, with the keys below."""

from __future__ import annotations

from typing import Any, NotRequired, TypedDict


class DrawnHour(TypedDict):
    """Time of day of a photo."""

    hour: float  # -1 morning, 0 noon, 1 evening


class DrawnShadow(TypedDict):
    """Shadow casters of a photo."""

    lobes: list[list[float]]  # x, y, radius, m


class RadialDistortion(TypedDict):
    """Lens distortion, as in COLMAP's RADIAL camera."""

    k1: float
    k2: float


class DrawnShutter(TypedDict):
    """Rolling shutter of a photo."""

    deg_s: list[float]  # angular velocity in camera axes
    readout_s: float


class DrawnBlur(TypedDict):
    """Motion blur of a photo."""

    exposure_s: float
    length_px: float


class DrawnDefocus(TypedDict):
    """Defocus of a photo."""

    radius_px: float  # 0 = sharp


class DrawnVignetting(TypedDict):
    """Vignetting of a photo."""

    falloff: float


class DrawnExposure(TypedDict):
    """Exposure drift of a photo."""

    stops: float


class DrawnBalance(TypedDict):
    """White balance of a photo."""

    gains: list[float]  # red, green, blue


class DrawnIso(TypedDict):
    """ISO of a photo."""

    iso: float


class DrawnJpeg(TypedDict):
    """First JPEG compression of a photo."""

    quality: int


class DrawnEffects(TypedDict, total=False):
    """What the effects drew for one photo; an effect that the spec does not name is absent."""

    time_of_day: DrawnHour
    specular: dict[str, float]  # empty: the same in all photos
    moving_shadow: DrawnShadow
    lens_distortion: RadialDistortion
    rolling_shutter: DrawnShutter
    motion_blur: DrawnBlur
    defocus: DrawnDefocus
    vignetting: DrawnVignetting
    exposure_drift: DrawnExposure
    white_balance: DrawnBalance
    iso_noise: DrawnIso
    jpeg: DrawnJpeg


class PlacedDistractor(TypedDict):
    """One distractor in one photo: `distractors.Placement` with its name and its share of the photo."""

    distractor: str
    occlusion: float
    which: int
    x_m: float
    y_m: float
    yaw_deg: float
    pose: float


class PhotoTruth(TypedDict):
    """Truth of one training photo."""

    occlusion: float  # share of the pixels that show a distractor
    distractors: list[PlacedDistractor]
    shadow: NotRequired[float]  # share of the pixels that a moving shadow darkens
    effects: NotRequired[DrawnEffects]


class Spread(TypedDict):
    """A figure over the training photos."""

    mean: float
    min: float
    max: float


class CameraRecord(TypedDict):
    """One camera of truth/cameras.json."""

    width: int  # px
    height: int  # px
    fx: float  # px
    fy: float
    cx: float
    cy: float
    cam_from_world: list[list[float]]  # [4, 4], OpenCV axes, m
    distortion: NotRequired[RadialDistortion]


class CaptureTruth(TypedDict):
    """truth/capture.json."""

    schema: int
    preset: str
    seed: int
    identity: str  # hash of spec, seed and code
    version: dict[str, str]
    spec: dict[str, Any]  # as in a YAML spec
    designed: dict[str, Any]  # `spec.Designed`
    mask: str  # what the masks mark, in words
    clean: str
    test: str
    occlusion: Spread
    photos: dict[str, PhotoTruth]
    licence: str
    files: NotRequired[dict[str, str]]  # path -> sha256, added last


class SimulatedCapture(CaptureTruth):
    """`CaptureTruth`, and whether the capture existed."""

    reused: bool


class PlacedCutout(TypedDict):
    """One cut-out in one photo: `layers.CutoutPlacement` with its name."""

    cutout: str
    which: int
    position: tuple[float, float, float]
    turn_deg: float
    standing: bool


class CompositePhoto(TypedDict):
    """One training photo of a composite."""

    occlusion: float
    distractors: list[PlacedCutout]


class CutoutRecord(TypedDict):
    """One cut-out of a composite."""

    name: str
    sha256: str  # of its file; empty where it was drawn
    height: float  # scene units


class CompositeSource(TypedDict):
    """The scene that a composite is made from."""

    name: str
    scene_json: str | None  # sha256


class CompositeRecord(TypedDict):
    """truth/composite.json."""

    schema: int
    version: str
    source: CompositeSource
    config: dict[str, Any]  # `CompositeConfig`
    mask: str
    poses: str
    cutouts: list[CutoutRecord]
    occlusion: Spread
    photos: dict[str, CompositePhoto]


class PastedPiece(TypedDict):
    """One distractor in one plain photo."""

    cutout: str
    photo: str  # that the piece was cut from; empty for cut-outs
    mirrored: bool
    x: float  # of its middle, over the photo's width
    y: float  # of its middle, over the photo's height
    height: float  # over the photo's height


class PastedPhoto(TypedDict):
    """One training photo of a capture with pasted distractors."""

    source: str  # file name of the clean photo
    sha256: str  # of the clean photo
    occlusion: float
    distractors: list[PastedPiece]


class PhotoFolder(TypedDict):
    """The folder of photos that a capture is made from."""

    name: str
    photos: int


class PastedCutout(TypedDict):
    """One cut-out of a capture with pasted distractors."""

    name: str
    sha256: str  # of its file


class PastedRecord(TypedDict):
    """truth/composite.json of a capture with pasted distractors."""

    schema: int
    version: str
    source: PhotoFolder
    config: dict[str, Any]  # `CompositeConfig` without pose and shadow
    mask: str
    cutouts: list[PastedCutout]
    occlusion: Spread
    photos: dict[str, PastedPhoto]
