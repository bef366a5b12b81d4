"""The EXIF values that structure from motion and capture checks use."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

# Diagonal of a 36 x 24 mm frame: "35 mm equivalent" focal lengths refer to it (CIPA DCG-001).
_DIAGONAL_35MM = math.hypot(36.0, 24.0)


@dataclass(frozen=True)
class Exif:
    """Camera settings of one photo; None = not recorded."""

    make: str | None = None
    model: str | None = None
    focal_mm: float | None = None
    focal_35mm: float | None = None  # mm, 35 mm equivalent
    exposure_s: float | None = None
    f_number: float | None = None
    iso: float | None = None
    white_balance: int | None = None  # EXIF: 0 automatic, 1 manual
    orientation: int = 1  # EXIF 1..8; 1 = as stored
    latitude_deg: float | None = None
    longitude_deg: float | None = None
    altitude_m: float | None = None
    taken_at: str | None = None  # "YYYY:MM:DD HH:MM:SS", camera's clock

    @property
    def camera(self) -> str | None:
        """Make and model as one name."""
        parts = [p for p in (self.make, self.model) if p]
        return " ".join(parts) or None

    def focal_px(self, width: int, height: int) -> float | None:
        """Focal length in px of a width x height photo from the 35 mm equivalent, or None."""
        if self.focal_35mm is None:
            return None
        return self.focal_35mm * math.hypot(width, height) / _DIAGONAL_35MM


def exif_from_spec(spec: Any) -> Exif:
    """The EXIF part of an OpenImageIO ImageSpec; damaged values count as absent."""
    orientation = _number(spec, "Orientation")
    balance = _number(spec, "Exif:WhiteBalance")
    return Exif(
        make=_text(spec, "Make"),
        model=_text(spec, "Model"),
        focal_mm=_positive(spec, "Exif:FocalLength"),
        focal_35mm=_positive(spec, "Exif:FocalLengthIn35mmFilm"),
        exposure_s=_positive(spec, "ExposureTime"),
        f_number=_positive(spec, "FNumber"),
        iso=_positive(spec, "Exif:PhotographicSensitivity") or _positive(spec, "Exif:ISOSpeedRatings"),
        white_balance=None if balance is None else int(balance),
        orientation=int(orientation) if orientation is not None and orientation in range(1, 9) else 1,
        latitude_deg=_degrees(spec, "Latitude", "S", 90.0),
        longitude_deg=_degrees(spec, "Longitude", "W", 180.0),
        altitude_m=_altitude(spec),
        taken_at=_text(spec, "Exif:DateTimeOriginal") or _text(spec, "DateTime"),
    )


def _text(spec: Any, name: str) -> str | None:
    value = spec.getattribute(name)
    if not isinstance(value, str):
        return None
    return "".join(c for c in value if c.isprintable()).strip() or None


def _number(spec: Any, name: str) -> float | None:
    value = spec.getattribute(name)
    if isinstance(value, (int, float)) and math.isfinite(value):
        return float(value)
    return None


def _positive(spec: Any, name: str) -> float | None:
    value = _number(spec, name)
    return value if value is not None and value > 0 else None


def _degrees(spec: Any, name: str, negative: str, limit: float) -> float | None:
    parts = spec.getattribute(f"GPS:{name}")
    if not isinstance(parts, tuple) or len(parts) != 3 or not all(math.isfinite(v) for v in parts):
        return None
    value = parts[0] + parts[1] / 60 + parts[2] / 3600
    if abs(value) > limit or value == 0.0:  # cameras without a GPS fix write 0, 0, 0
        return None
    return -value if _text(spec, f"GPS:{name}Ref") == negative else value


def _altitude(spec: Any) -> float | None:
    value = _number(spec, "GPS:Altitude")
    if value is None:
        return None
    return -value if _number(spec, "GPS:AltitudeRef") == 1 else value
