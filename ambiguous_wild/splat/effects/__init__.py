"""Optional effects of the trainer, by name. Effects that are not requested are not imported or built.

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

# name -> (module, class, what it is for), in the order in which they act on a render
EFFECTS: dict[str, tuple[str, str, str]] = {
    "exposure": ("colour", "AffineExposure", "an affine change of colour per photo"),
    "appearance": ("colour", "AppearanceEmbedding", "light that changes by photo and place"),
    "antialias": ("smoothing", "SmoothingFilter", "Mip-Splatting's filters, for photos from near and far"),
    "poses": ("poses", "PoseRefinement", "a small correction of every camera's pose"),
    "skybox": ("skybox", "Skybox", "first Gaussians on a far sphere too, for what lies behind the scene"),
    "dense": ("dense", "DenseStart", "first Gaussians on dense points too, for few photos"),
    "near": ("skybox", "NearSpace", "no Gaussians close in front of a camera"),
    "sh0": ("", "", "colours that do not depend on the direction"),
    "sh1": ("", "", "spherical harmonics up to degree 1"),
    "sh2": ("", "", "spherical harmonics up to degree 2"),
}  # fmt: skip
ALL = ("exposure", "appearance", "antialias", "poses")
DEGREES = {"sh0": 0, "sh1": 1, "sh2": 2}


def check_effects(names: Iterable[str]) -> tuple[str, ...]:
    """Return the effects in the order in which they act, each once.

    Raises:
        AwError: a name is unknown, or two SH degrees are named.
    """
    wanted = list(names)
    for name in wanted:
        if name not in EFFECTS:
            raise unknown("effect", name, EFFECTS)
    degrees = sorted(set(wanted) & DEGREES.keys())
    if len(degrees) > 1:
        raise AwError(f"effects {' and '.join(degrees)} exclude each other: name one degree")
    return tuple(name for name in EFFECTS if name in wanted)


def with_effects(hooks: MethodHooks, names: Sequence[str]) -> MethodHooks:
    """Add effects to a method's hooks; without effects returns the same object."""
    if not names:
        return hooks
    built: list[Effect] = []
    present = {effect.name for effect in hooks.effects}  # effects of the method are not added twice
    for name in check_effects(names):
        if name in present:
            continue
        if name in DEGREES:
            hooks = dataclasses.replace(hooks, sh_degree=min(hooks.sh_degree, DEGREES[name]))
            continue
        module, cls, _ = EFFECTS[name]
        effect = getattr(importlib.import_module(f"{__name__}.{module}"), cls)()
        hooks = hooks.suited_to(effect)
        built.append(effect)
    return dataclasses.replace(hooks, effects=(*hooks.effects, *built))
