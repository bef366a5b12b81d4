"""Presets by name, from `presets.yaml`."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from ambiguous_wild.core.errors import AwError, unknown
from ambiguous_wild.io import plain_yaml
from ambiguous_wild.simulate.spec import CaptureSpec
from ambiguous_wild.simulate.spec_file import check_spec, spec_of

PRESETS = {
    spec.name: spec
    for spec in map(spec_of, plain_yaml.parse(plain_yaml.read_text(Path(__file__).with_suffix(".yaml"))))
}


def preset(name: str) -> CaptureSpec:
    """Return the preset of a name.

    Raises:
        AwError: unknown name; the message gives the nearest one.
    """
    if name not in PRESETS:
        raise unknown("capture", name, PRESETS, "'aw simulate' lists them")
    return PRESETS[name]


def resized(spec: CaptureSpec, views: int | None = None, width: int | None = None) -> CaptureSpec:
    """Return the spec with another number of train photos, or another width with the same aspect ratio.

    Raises:
        AwError: fewer than 3 photos, or a width outside 64 to 4096 px.
    """
    if views is not None:
        if not 3 <= views <= 2000:
            raise AwError(f"--views {views}: a capture has 3 to 2000 train photos")
        test = max(2, round(views * spec.test_views / spec.train_views))
        spec = replace(spec, train_views=views, test_views=test)
    if width is not None:
        if not 64 <= width <= 4096:
            raise AwError(f"--width {width}: a photo is 64 to 4096 px wide")
        detail = min(spec.detail_px_per_m * max(width / spec.width, 0.3), 220.0)
        height = max(2, 2 * round(width * spec.height / spec.width / 2))
        spec = replace(spec, width=width, height=height, detail_px_per_m=detail)
    return check_spec(spec)
