"""Settings of each effect, one frozen dataclass an effect; None = not computed."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class ExposureDrift:
    """Automatic exposure: brightness drifts during the capture."""

    stops: float = 0.7  # largest deviation, in powers of two


@dataclass(frozen=True)
class WhiteBalance:
    """Automatic white balance: photos turn warm and cold."""

    warmth: float = 0.5  # stops between red and blue at most
    tint: float = 0.12  # stops of green against both at most


@dataclass(frozen=True)
class IsoNoise:
    """Shot and read noise of a small sensor."""

    iso: tuple[float, float] = (800.0, 1600.0)  # drawn anew for every photo


@dataclass(frozen=True)
class Vignetting:
    """Darker corners."""

    falloff: float = 0.45  # share of the light that the corners lack


@dataclass(frozen=True)
class LensDistortion:
    """Radial distortion as in COLMAP: x_d = x (1 + k1 r^2 + k2 r^4), of every photo, test photos too."""

    k1: float = -0.12
    k2: float = 0.0


@dataclass(frozen=True)
class MotionBlur:
    """The hand turns while the shutter is open."""

    exposure_s: float = 1 / 60
    speed_deg_s: float = 12.0  # of the hand, at most


@dataclass(frozen=True)
class RollingShutter:
    """The hand turns while the rows are read, from top to bottom."""

    readout_s: float = 1 / 40
    speed_deg_s: float = 12.0  # of the hand, at most


@dataclass(frozen=True)
class Defocus:
    """Some photos are out of focus as a whole."""

    share: float = 0.4  # of the train photos
    radius: tuple[float, float] = (0.0015, 0.004)  # of the disc, in widths of the photo


@dataclass(frozen=True)
class Jpeg:
    """Photos compressed once more, as by a messenger; colour at half the resolution."""

    quality: tuple[int, int] = (30, 55)  # 1 to 95, drawn anew for every photo


@dataclass(frozen=True)
class TimeOfDay:
    """Photos at different hours: colour and strength of sun and sky, direction of the sun."""

    strength: float = 1.0  # of the change of colour and brightness
    sweep_deg: float = 25.0  # greatest turn of the sun to either side


@dataclass(frozen=True)
class MovingShadow:
    """A shadow from outside the photo, at another place in every photo."""

    presence: float = 0.85  # share of the train photos with a shadow
    size_m: float = 0.7  # radius of the shadow caster


@dataclass(frozen=True)
class Specular:
    """Polished surfaces: reflections of sun and sky that move with the camera."""

    textures: tuple[str, ...] = ("stone",)  # polished textures
    strength: float = 0.6  # brightness of the highlight relative to the sun
    sharpness: float = 60.0  # exponent: the higher the smaller


@dataclass(frozen=True)
class Effects:
    """The effects of a capture; None = not computed."""

    time_of_day: TimeOfDay | None = None
    moving_shadow: MovingShadow | None = None
    specular: Specular | None = None
    lens_distortion: LensDistortion | None = None
    rolling_shutter: RollingShutter | None = None
    motion_blur: MotionBlur | None = None
    defocus: Defocus | None = None
    vignetting: Vignetting | None = None
    exposure_drift: ExposureDrift | None = None
    white_balance: WhiteBalance | None = None
    iso_noise: IsoNoise | None = None
    jpeg: Jpeg | None = None


KINDS: dict[str, type] = {
    "time_of_day": TimeOfDay,
    "moving_shadow": MovingShadow,
    "specular": Specular,
    "lens_distortion": LensDistortion,
    "rolling_shutter": RollingShutter,
    "motion_blur": MotionBlur,
    "defocus": Defocus,
    "vignetting": Vignetting,
    "exposure_drift": ExposureDrift,
    "white_balance": WhiteBalance,
    "iso_noise": IsoNoise,
    "jpeg": Jpeg,
}
