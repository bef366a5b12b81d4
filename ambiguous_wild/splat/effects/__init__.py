"""What --effects switches: effects, initialisations and the SH degree, by name, built only where requested.

This module imports no torch: names are checked before anything heavy is loaded.
"""

from __future__ import annotations

import dataclasses
import importlib
from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING

from ambiguous_wild.core.errors import AwError, unknown

if TYPE_CHECKING:
    from ambiguous_wild.splat.effects.base import Effect
    from ambiguous_wild.splat.method_hooks import MethodHooks

# name -> (module, class), in the order in which they act on a render
EFFECTS = {
    "exposure": ("colour", "AffineExposure"),  # an affine change of colour per photo
    "appearance": ("colour", "AppearanceEmbedding"),  # light that changes by photo and place
    "antialias": ("smoothing", "SmoothingFilter"),  # Mip-Splatting's filters, for photos from near and far
    "poses": ("poses", "PoseRefinement"),  # a small correction of every camera's pose
}
ALL = tuple(EFFECTS)
# the same of what changes no picture: first Gaussians, and where there are none
INITIALISATIONS = {
    "skybox": ("skybox", "Skybox"),  # on a far sphere too, for what lies behind the scene
    "dense": ("dense", "DenseStart"),  # on dense points too, for few photos
    "near": ("near_space", "NearSpace"),  # none close in front of a camera
}
SH_DEGREES = {"sh0": 0, "sh1": 1, "sh2": 2}  # highest degree of the harmonics; 0: equal in all directions
NAMES = (*EFFECTS, *INITIALISATIONS, *SH_DEGREES)  # all that --effects takes


def check_effects(names: Iterable[str]) -> tuple[str, ...]:
    """Return the effects in the order in which they act, each once.

    Raises:
        AwError: a name is unknown, or two SH degrees are named.
    """
    wanted = list(names)
    for name in wanted:
        if name not in NAMES:
            raise unknown("effect", name, NAMES)
    degrees = sorted(set(wanted) & SH_DEGREES.keys())
    if len(degrees) > 1:
        raise AwError(f"effects {' and '.join(degrees)} exclude each other: name one degree")
    return tuple(name for name in NAMES if name in wanted)


def with_effects(hooks: MethodHooks, names: Sequence[str]) -> MethodHooks:
    """Add what is named to a method's hooks; without names returns the same object."""
    if not names:
        return hooks
    built: list[Effect] = []
    present = {effect.name for effect in hooks.effects}  # effects of the method are not added twice
    for name in check_effects(names):
        if name in present:
            continue
        if name in SH_DEGREES:
            hooks = dataclasses.replace(hooks, sh_degree=min(hooks.sh_degree, SH_DEGREES[name]))
            continue
        module, cls = (EFFECTS | INITIALISATIONS)[name]
        effect = getattr(importlib.import_module(f"{__name__}.{module}"), cls)()
        hooks = hooks.with_effect(effect)
        built.append(effect)
    return dataclasses.replace(hooks, effects=(*hooks.effects, *built))
