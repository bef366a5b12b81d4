"""What a spec does not name is not computed; what it names leaves the truth exact."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from ambiguous_wild.simulate import capture
from ambiguous_wild.simulate.image_effects import PhotoRandom
from ambiguous_wild.simulate.presets import preset, resized
from ambiguous_wild.simulate.render import PlannedPhoto, RenderedPhoto, render_photo
from ambiguous_wild.simulate.spec import KINDS, CaptureSpec, Defocus, Effects
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
    return capture.plan(small(), 3)


def taken(spec: CaptureSpec, k: int, seed: int = 3) -> RenderedPhoto:
    world, shots = planned()
    return render_photo(spec, world, shots[k], PhotoRandom(seed, k, k / 3))


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
