"""Presets: those of the courtyard, and all of them by name."""

from __future__ import annotations

from dataclasses import replace

from ambiguous_wild.core.errors import AwError, unknown
from ambiguous_wild.simulate.preset_distractors import (
    BLUE,
    CRIMSON,
    GRAVEL,
    LEAVES,
    PARCEL,
    RED,
    TWIN,
    VISITOR,
    designed,
    far,
    near,
    thin,
)
from ambiguous_wild.simulate.preset_gallery import GALLERY
from ambiguous_wild.simulate.preset_places import PLACES
from ambiguous_wild.simulate.spec import CaptureSpec
from ambiguous_wild.simulate.spec_check import check_spec

_THIN = (
    thin("wooden pole", "pole", "timber"),
    thin("pole of brick", "pole", "brick"),
    thin("rope barrier", "barrier", "stone"),
    thin("banner in brick", "banner", "brick"),
    thin("pebble", "ball", "gravel", size=0.22, lift_m=1.9),
    thin("clod of leaves", "ball", "foliage", size=0.26, lift_m=1.9),
    replace(thin("red ball", "ball", "cloth", size=0.2, lift_m=1.9, tint=CRIMSON), ambiguity="none"),
)


PRESETS = {
    spec.name: spec
    for spec in (
        CaptureSpec(
            "courtyard",
            "a visitor dressed like the wall, a second statue, a bright parcel",
            (VISITOR, TWIN, PARCEL),
            designed=designed("both"),
        ),
        CaptureSpec(
            "courtyard-colour",
            "three distractors that wear the background's own texture",
            (VISITOR, LEAVES, GRAVEL),
            designed=designed("colour"),
        ),
        CaptureSpec(
            "courtyard-twin",
            "two copies of the static statue",
            (TWIN, replace(TWIN, name="third statue")),
            designed=designed("both"),
        ),
        CaptureSpec(
            "courtyard-plain",
            "a visitor, a ball and a parcel in colours that nothing else has: the easy case",
            (RED, BLUE, PARCEL),
            occlusion=(0.14, 0.26),
            designed=designed("neither"),
        ),
        CaptureSpec(
            "courtyard-thin",
            "poles, a rope, a banner and small balls, most in the background's colours",
            _THIN,
            occlusion=(0.03, 0.09),
            designed=designed("colour"),
        ),
        CaptureSpec(
            "courtyard-sparse",
            "the courtyard's distractors, fewer and farther: about 5 % of a photo",
            (far(VISITOR), far(TWIN), far(PARCEL)),
            occlusion=(0.02, 0.08),
            designed=designed("both"),
        ),
        CaptureSpec(
            "courtyard-crowd",
            "a crowd of eight of every kind: about 45 % of a photo",
            tuple(
                near(d)
                for d in (VISITOR, LEAVES, RED, replace(VISITOR, name="visitor in wood", texture="timber"))
            )
            + tuple(near(d) for d in (TWIN, GRAVEL, PARCEL, BLUE)),
            occlusion=(0.37, 0.53),
            designed=designed("both"),
        ),
        CaptureSpec(
            "courtyard-clean",
            "no distractors: the upper bound",
            occlusion=(0.0, 0.0),
            designed=designed("neither", distractors=False),
        ),
        CaptureSpec(
            "tiny",
            "the courtyard in small, for tests",
            (VISITOR, TWIN, PARCEL),
            train_views=12,
            test_views=3,
            width=320,
            height=180,
            detail_px_per_m=48.0,
            arc_deg=70.0,
            designed=designed("both"),
        ),
        *GALLERY,
        *PLACES,
    )
}


def preset(name: str) -> CaptureSpec:
    """The preset of that name.

    Raises:
        AwError: unknown name; gives the nearest one.
    """
    if name not in PRESETS:
        raise unknown("capture", name, PRESETS, "'aw simulate --list' lists them")
    return PRESETS[name]


def resized(spec: CaptureSpec, views: int | None = None, width: int | None = None) -> CaptureSpec:
    """The spec with another number of train photos, or another width with the same aspect ratio.

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
