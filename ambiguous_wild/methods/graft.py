"""Plug and play: masking, density control, regulariser and effects of one method in another.

`3dgs@mask=refinesplat` is 3DGS with RefineSplat's masks, `refinesplat@mask=truth` RefineSplat with exact
ones. What a place takes:

mask         the keep map (`MaskPolicy.keep`, `predict`), and what it learns
density      the density control and its config
regulariser  the donor policy's loss on the render (`MaskPolicy.cotangent`), under the host's keep map
effects      the donor's own effects (`Parts.effects`) instead of the host's

Everything else - schedule, how the keep map enters SSIM, which photos - stays the host's. A warning names
a donor's effects that the graft does not take. Imports no torch: names are checked before anything
heavy is loaded.
"""

from __future__ import annotations

import dataclasses
import hashlib
import warnings
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from ambiguous_wild.core.errors import AwError, unknown
from ambiguous_wild.methods.entry import MethodEntry, NoOptions, resolve
from ambiguous_wild.methods.references import is_reference
from ambiguous_wild.methods.second_pass import trained_once

if TYPE_CHECKING:
    from ambiguous_wild.splat.parts import Parts

PLACES = ("mask", "density", "regulariser", "effects")
ALIASES = {"none": "3dgs", "truth": "3dgs+truth"}  # of donors


def graft_name(host: str, donors: Mapping[str, str | None]) -> str:
    """`3dgs@mask=refinesplat,density=refinesplat`; the host's own name if no place is filled.

    Donors replace those that the host's name already has.
    """
    base, rest = split_graft(host)
    filled = dict(_pairs(host)) if rest else {}
    filled |= {place: donor for place, donor in donors.items() if donor}
    text = ",".join(f"{place}={filled[place]}" for place in PLACES if place in filled)
    return f"{base}@{text}" if text else base


def split_graft(name: str) -> tuple[str, str]:
    """(host, the text after its @); a host may be a reference, whose path may contain an @ too.

    Raises:
        AwError: nothing after the @, or two of them.
    """
    if is_reference(name) or "@" not in name:
        return name, ""
    host, _, rest = name.rpartition("@")
    if not rest or ("@" in host and not is_reference(host)):
        first = host.partition("@")[0]
        raise AwError(f"method {name!r}: write {first}@mask=METHOD,density=METHOD, with one @")
    return host, rest


def knows_truth(name: str) -> bool:
    """Whether a method of this name uses exact masks or clean photos, which no real capture has.

    Such a row is an upper bound; tables do not rank it. A graft has its host's photos and, unless a donor
    replaces them, its host's masks. Any other name, such as an ablation variant's, is accepted too.
    """
    name = trained_once(name)
    host, _, rest = name.rpartition("@") if "@" in name else (name, "", "")
    masks = [ALIASES.get(donor, donor) for place, donor in _written(rest) if place == "mask"] or [host]
    return host == "3dgs-clean" or masks[-1] == "3dgs+truth"


def members(name: str) -> list[str]:
    """The host and the donors in a method's name; of an ablation's variant, its method."""
    host, _, rest = name.rpartition("@") if "@" in name else (name, "", "")
    return list(dict.fromkeys([host, *(ALIASES.get(donor, donor) for _, donor in _written(rest) if donor)]))


def grafted(name: str, host: MethodEntry, methods: Mapping[str, MethodEntry]) -> MethodEntry:
    """The method that `graft_name` names.

    Args:
        name: of the graft, as it was typed.
        host: the method before its @.
        methods: those that may be donors, by name.

    Raises:
        AwError: unknown place or donor, or a place filled twice.
    """
    if host.passes > 1:
        raise AwError(f"{name}: the end of the name says that it trains twice: {host.base}@...+2passes")
    pairs = _pairs(name)
    donors = {place: _donor(place, donor, methods) for place, donor in pairs}
    entries = {"host": host} | donors
    fields = [
        (place, _options_class(entry), dataclasses.field(default_factory=entry.options))
        for place, entry in entries.items()
    ]
    hashes = [entry.source_hash for entry in entries.values()]
    ordered = graft_name(host.name, dict(pairs))  # in the order of the places, so that one graft has one name
    return MethodEntry(
        name=ordered,
        summary=f"{host.name} with " + ", ".join(f"the {place} of {e.name}" for place, e in donors.items()),
        recipe=Graft(ordered, entries),
        config=dataclasses.make_dataclass("GraftOptions", fields, frozen=True),
        needs="; ".join(dict.fromkeys(e.needs for e in entries.values() if e.needs)),
        source_hash=hashlib.sha256("".join(hashes).encode()).hexdigest() if any(hashes) else "",
        places=tuple((place, entry.name) for place, entry in entries.items())
        + tuple((place, donor) for place, donor in pairs if donor in ALIASES),
        given_as=graft_name(host.given_as, dict(pairs)) if host.given_as else "",
    )


@dataclass(frozen=True, eq=False)
class Graft:
    """The recipe of a graft."""

    name: str
    entries: Mapping[str, MethodEntry]  # "host", and the donor of every place that is filled

    def __call__(self, options: Any) -> Parts:
        return build(self.name, self.entries, options)


def build(name: str, entries: Mapping[str, MethodEntry], options: Any) -> Parts:
    """The host's parts with the donors' in their places.

    A method that fills two places with the same options is built once, so its frozen inputs are prepared
    once, and a method grafted onto itself is unchanged.

    Args:
        name: of the graft, for warnings.
        entries: "host", and the donor of every place that is filled.
        options: of each of them, by place.
    """
    built: list[tuple[str, Any, Parts]] = []

    def parts_of(place: str) -> Parts:
        entry, own = entries[place], getattr(options, place)
        for donor, known, parts in built:
            if donor == entry.name and known == own:
                return parts
        parts = entry.build(own)
        built.append((entry.name, own, parts))
        return parts

    host = parts_of("host")
    mask = parts_of("mask").mask if "mask" in entries else host.mask
    regulariser = parts_of("regulariser").mask if "regulariser" in entries else host.mask
    changed: dict[str, Any] = {"mask": compose(mask, regulariser)}
    if "density" in entries:
        density = parts_of("density")
        changed |= {"density": density.density, "density_config": density.density_config}
        # MCMC's fixed number starts from Gaussians of its own
        changed |= {"start_opacity": density.start_opacity, "start_scale": density.start_scale}
        if density.start is not None:
            changed["start"] = density.start
    if "effects" not in entries:
        _warn_of_effects(name, host, [(donor, parts) for donor, _, parts in built])
        return dataclasses.replace(host, **changed)
    effects = parts_of("effects").effects
    for effect in effects:
        host = effect.change_parts(host)
    return dataclasses.replace(host, **changed, effects=effects)


def _warn_of_effects(name: str, host: Parts, donors: Iterable[tuple[str, Parts]]) -> None:
    """Warn if a donor's recipe brings effects that the host does not have."""
    own = set(_effect_names(host))
    for donor, parts in donors:
        left_out = [effect for effect in _effect_names(parts) if effect not in own]
        if left_out:
            warnings.warn(
                f"{name} leaves out {donor}'s effects ({', '.join(left_out)}): add effects={donor} to the "
                "name to take them, or effects=none to leave them out without this warning",
                stacklevel=2,
            )


def _effect_names(parts: Parts) -> list[str]:
    return [effect.name or type(effect).__name__ for effect in parts.effects]


def compose(mask: Any, regulariser: Any) -> Any:
    """One policy of two: keep maps of `mask`, cotangents of `regulariser`."""
    from ambiguous_wild.methods.grafted_policy import GraftedPolicy

    if regulariser is mask:
        return mask
    # the loss of the mask's donor was not asked for
    return GraftedPolicy(mask, regulariser if regulariser.regularises() else None)


def idle_regulariser(method: MethodEntry, options: Any) -> str:
    """The regulariser's donor if it adds no loss with these options; else empty."""
    donor = dict(method.places).get("regulariser", "")
    if not isinstance(method.recipe, Graft) or ALIASES.get(donor, donor) in ("", "3dgs"):
        return ""
    parts = method.recipe.entries["regulariser"].build(options.regulariser)
    return "" if parts.mask.regularises() else donor


def _pairs(name: str) -> list[tuple[str, str]]:
    """(place, donor) of every place that the name of a graft fills.

    Raises:
        AwError: an unknown place, no donor, or a place filled twice.
    """
    host, rest = split_graft(name)
    pairs = _written(rest) if rest else []
    for number, (place, donor) in enumerate(pairs):
        if not donor:
            raise AwError(f"method {name!r}: write {host}@mask=METHOD; places are {', '.join(PLACES)}")
        if place not in PLACES:
            raise unknown(f"place in {name!r}", place, PLACES)
        if place in dict(pairs[:number]):
            raise AwError(f"method {name!r}: the {place} is given twice")
    return pairs


def _written(rest: str) -> list[tuple[str, str]]:
    """(place, donor) of `mask=refinesplat,density=truth`, unchecked; an empty donor if there is no `=`."""
    parts = [text.partition("=") for text in rest.split(",")]
    return [(place.strip(), donor.strip()) for place, _, donor in parts]


def _donor(place: str, name: str, methods: Mapping[str, MethodEntry]) -> MethodEntry:
    target = ALIASES.get(name, name)
    if "@" in target or target not in methods:
        raise unknown(f"{place} donor", name, [*methods, *ALIASES], "'aw methods' lists them")
    return methods[target]


def _options_class(entry: MethodEntry) -> type:
    cls = resolve(entry.config) if entry.config else NoOptions
    assert isinstance(cls, type)
    return cls
