"""Plug and play: masking, density control and regulariser of one method in another.

`3dgs@mask=refinesplat` is 3DGS under RefineSplat's masks, `refinesplat@mask=truth` RefineSplat under exact
ones. What a place takes:

mask         the keep map (`MaskPolicy.keep`, `predict`), and what it learns
density      the density control and its config
regulariser  the donor policy's loss on the render (`MaskPolicy.cotangent`), under the host's keep map

Everything else - schedule, how the keep map enters SSIM, which photos - stays the host's. Imports no torch:
names are checked before anything heavy is loaded.
"""

from __future__ import annotations

import dataclasses
import hashlib
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from ambiguous_wild.core.errors import AwError, unknown
from ambiguous_wild.methods.references import is_reference
from ambiguous_wild.methods.registry import MethodEntry, NoOptions, all_methods, get_method, resolve

if TYPE_CHECKING:
    from ambiguous_wild.splat.parts import Parts

PLACES = ("mask", "density", "regulariser")
ALIASES = {"none": "3dgs", "truth": "3dgs+truth"}  # of donors


def graft_name(host: str, donors: Mapping[str, str | None]) -> str:
    """`3dgs@mask=refinesplat,density=refinesplat`; the host's own name where no place is taken.

    Donors of places that the host's name already fills are replaced.
    """
    base, rest = split_graft(host)
    filled = dict(_pairs(host)) if rest else {}
    filled |= {place: donor for place, donor in donors.items() if donor}
    text = ",".join(f"{place}={filled[place]}" for place in PLACES if place in filled)
    return f"{base}@{text}" if text else base


def split_graft(name: str) -> tuple[str, str]:
    """(host, what stands after its @); a host may be a reference, whose path may hold an @ too.

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


def grafted(name: str) -> MethodEntry:
    """The method that `graft_name` names.

    Raises:
        AwError: unknown host, place or donor, or a place filled twice.
    """
    pairs = _pairs(name)
    host = get_method(split_graft(name)[0])
    donors = {place: _donor(place, donor) for place, donor in pairs}
    entries = {"host": host} | donors
    fields = [
        (place, _options_class(entry), dataclasses.field(default_factory=entry.options))
        for place, entry in entries.items()
    ]
    hashes = [entry.source_hash for entry in entries.values()]
    return MethodEntry(
        # in the order of the places, so that one graft has one name
        name=graft_name(host.name, dict(pairs)),
        summary=f"{host.name} with " + ", ".join(f"the {place} of {e.name}" for place, e in donors.items()),
        recipe=lambda options: build(entries, options),
        config=dataclasses.make_dataclass("GraftOptions", fields, frozen=True),
        needs="; ".join(dict.fromkeys(e.needs for e in entries.values() if e.needs)),
        source_hash=hashlib.sha256("".join(hashes).encode()).hexdigest() if any(hashes) else "",
        places=tuple((place, entry.name) for place, entry in entries.items())
        + tuple((place, donor) for place, donor in pairs if donor in ALIASES),
        given_as=graft_name(host.given_as, dict(pairs)) if host.given_as else "",
    )


def build(entries: Mapping[str, MethodEntry], options: Any) -> Parts:
    """The host's parts with the donors' in their places.

    A method that fills two places with the same options is built once: its frozen inputs are prepared once,
    and its own mask on itself is the method itself.
    """
    built: list[tuple[str, Any, Parts]] = []

    def parts_of(place: str) -> Parts:
        entry, own = entries[place], getattr(options, place)
        for name, known, parts in built:
            if name == entry.name and known == own:
                return parts
        parts = entry.build(own)
        built.append((entry.name, own, parts))
        return parts

    host = parts_of("host")
    mask = parts_of("mask").mask if "mask" in entries else host.mask
    regulariser = parts_of("regulariser").mask if "regulariser" in entries else host.mask
    changed: dict[str, Any] = {"mask": compose(mask, regulariser)}
    if "density" in entries:
        donor = parts_of("density")
        changed |= {"density": donor.density, "density_config": donor.density_config}
    return dataclasses.replace(host, **changed)


def compose(mask: Any, regulariser: Any) -> Any:
    """One policy of two: keep maps of `mask`, cotangents of `regulariser`."""
    from ambiguous_wild.methods.grafted_policy import GraftedPolicy

    if regulariser is mask:
        return mask
    # Without one that regularises: a loss that the mask's donor may have was not asked for.
    return GraftedPolicy(mask, regulariser if regulariser.regularises() else None)


def idle_regulariser(method: MethodEntry, options: Any) -> str:
    """The donor whose loss was asked for and which adds none under these options; empty where all is well."""
    donor = dict(method.places).get("regulariser", "")
    if ALIASES.get(donor, donor) in ("", "3dgs"):
        return ""
    parts = _donor("regulariser", donor).build(options.regulariser)
    return "" if parts.mask.regularises() else donor


def _pairs(name: str) -> list[tuple[str, str]]:
    """(place, donor) as written after the @."""
    host, rest = split_graft(name)
    pairs: list[tuple[str, str]] = []
    for text in rest.split(",") if host != name else []:
        place, equals, donor = (part.strip() for part in text.partition("="))
        if not equals or not donor:
            raise AwError(f"method {name!r}: write {host}@mask=METHOD; places are {', '.join(PLACES)}")
        if place not in PLACES:
            raise unknown(f"place in {name!r}", place, PLACES)
        if place in dict(pairs):
            raise AwError(f"method {name!r}: the {place} is given twice")
        pairs.append((place, donor))
    return pairs


def _donor(place: str, name: str) -> MethodEntry:
    target = ALIASES.get(name, name)
    if "@" in target or target not in all_methods():
        raise unknown(f"{place} donor", name, [*all_methods(), *ALIASES], "'aw methods' lists them")
    return get_method(target)


def _options_class(entry: MethodEntry) -> type:
    cls = resolve(entry.config) if entry.config else NoOptions
    assert isinstance(cls, type)
    return cls
