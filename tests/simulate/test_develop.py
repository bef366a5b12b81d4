"""What a spec does not name is not computed; what it names leaves the truth exact."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from ambiguous_wild.simulate import capture_writer
from ambiguous_wild.simulate import image_effects as fx
from ambiguous_wild.simulate.image_effects import PhotoRandom
from ambiguous_wild.simulate.photo_render import (
    PlannedPhoto,
    RenderedPhoto,
    finish_photo,
    prepare_photo,
    trace_photo,
)
from ambiguous_wild.simulate.presets import PRESETS, preset, resized
from ambiguous_wild.simulate.spec import CaptureSpec, Defocus, Effects
from ambiguous_wild.simulate.spec_file import KINDS
from ambiguous_wild.simulate.world import World

EXACT = ("specular", "lens_distortion")  # of the place and the lens: test photos have them, too
ALL = Effects(
    **{
        name: Defocus(share=1.0, radius=(0.01, 0.02)) if name == "defocus" else kind()
        for name, kind in KINDS.items()
    }
)


def small(**effects: object) -> CaptureSpec:
    spec = replace(resized(preset("courtyard"), views=4, width=96), detail_px_per_m=8.0)
    return replace(spec, effects=Effects(**effects))  # type: ignore[arg-type]


@cache
def planned() -> tuple[World, list[PlannedPhoto]]:
    return capture_writer.plan_capture(small(), 3)


def taken(spec: CaptureSpec, k: int, seed: int = 3) -> RenderedPhoto:
    world, shots = planned()
    random = PhotoRandom(seed, k, k / 3)
    prepared = prepare_photo(spec, world, shots[k], random)
    return finish_photo(shots[k], random, prepared, trace_photo(world, prepared))


@pytest.mark.parametrize("name", [*KINDS, "none", "all"])
def test_what_is_named_is_computed_and_nothing_else(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    wanted = {"none": [], "all": list(KINDS)}.get(name, [name])
    of_hand = ("motion_blur", "rolling_shutter")
    called = set()

    def watch(function: str) -> None:
        original = getattr(fx, function)

        def watched(*words: object) -> object:
            called.add(function)
            return original(*words)

        monkeypatch.setattr(fx, function, watched)

    for function in [*(kind for kind in KINDS if kind not in of_hand), "camera_rotations"]:
        watch(function)
    made = taken(small(**{kind: getattr(ALL, kind) for kind in wanted}), 1)
    assert set(made.effects) == set(wanted)
    assert called == {"camera_rotations" if kind in of_hand else kind for kind in wanted}


@pytest.mark.parametrize("name", KINDS)
def test_an_effect_changes_train_photos_and_test_photos_only_where_stated(name: str) -> None:
    spec = small(**{name: getattr(ALL, name)})
    assert not np.array_equal(taken(spec, 1).photo, taken(small(), 1).photo)
    plain, test = taken(small(), 4), taken(spec, 4)
    assert np.array_equal(test.photo, plain.photo) == (name not in EXACT)
    assert np.array_equal(test.photo, test.clean)


@pytest.mark.parametrize("effects", [Effects(), replace(ALL, jpeg=None)], ids=["none", "all"])
def test_photo_and_clean_differ_nowhere_but_in_mask_and_shadow(effects: Effects) -> None:
    made = taken(replace(small(), effects=effects), 1)
    touched = made.owner > 0
    if made.shadow is not None:
        assert 0.01 < made.shadow.mean() < 0.9
        touched |= made.shadow
    gap = np.abs(made.photo.astype(int) - made.clean).max(-1)
    assert not gap[~touched].any() and gap[made.owner > 0].mean() > 10
    assert 0.03 < (made.owner > 0).mean() < 0.5


def test_a_moved_mask_holds_every_pixel_that_its_distractor_reaches() -> None:
    """Blur and lens widen it by little: everything in it differs, but for a rim of tiny shares."""
    spec = small(motion_blur=ALL.motion_blur, lens_distortion=ALL.lens_distortion)
    made, still = taken(spec, 1), taken(small(), 1)
    share, before = (made.owner > 0).mean(), (still.owner > 0).mean()
    assert 0.7 * before < share < 1.8 * before
    assert set(np.unique(made.owner)) == set(np.unique(still.owner))


def test_a_shadow_darkens_and_is_not_in_the_clean_photo() -> None:
    made, plain = taken(small(moving_shadow=ALL.moving_shadow), 1), taken(small(), 1)
    assert np.array_equal(made.clean, plain.clean) and made.shadow is not None
    only = made.shadow & (made.owner == 0)
    assert (made.photo[only].astype(int) <= plain.photo[only]).all()
    assert (plain.photo[only].astype(int) - made.photo[only]).mean() > 5


def test_a_highlight_brightens_the_polished_and_leaves_the_rest() -> None:
    made, plain = taken(small(specular=ALL.specular), 4), taken(small(), 4)
    gap = made.photo.astype(int) - plain.photo
    assert (gap >= 0).all() and gap.max() > 20 and (gap.max(-1) == 0).mean() > 0.5


def test_the_same_seed_gives_the_same_bits_and_another_does_not() -> None:
    spec = replace(small(), effects=ALL)
    assert np.array_equal(taken(spec, 1).photo, taken(spec, 1).photo)
    assert not np.array_equal(taken(spec, 1).photo, taken(spec, 1, seed=4).photo)


def test_labels_agree_with_what_the_spec_holds() -> None:
    appearance = ("exposure_drift", "white_balance", "time_of_day")
    for spec in PRESETS.values():
        label = spec.designed
        named = {name for name in KINDS if getattr(spec.effects, name) is not None}
        someone = bool(spec.distractors) or "moving_shadow" in named or spec.fixed is not None
        assert ("masks" in label.effects) == someone, spec.name
        assert ("appearance" in label.effects) == bool(named & set(appearance)), spec.name
        assert ("sh" in label.effects) == ("specular" in named), spec.name
        assert ("antialiasing" in label.effects) == (spec.zoom != (1.0, 1.0)), spec.name
        # a shaking hand is in COLMAP's poses: refining them cost 1.8 dB
        assert "pose" not in label.effects, spec.name
        assert label.ambiguity != "unstated" and (spec.distractors or label.ambiguity == "neither"), spec.name
