"""Plug and play: masking, density control, regulariser and effects of one method in another.

`3dgs@mask=refinesplat` is 3DGS with RefineSplat's masks, `refinesplat@mask=truth` RefineSplat with exact
ones. The slots, and what a donor fills them with:

mask         the keep map (`MaskPolicy.keep`, `predict`), and what it learns
density      the density control and its config
regulariser  the donor policy's loss on the render (`MaskPolicy.loss`), under the host's keep map
effects      the donor's own effects (`MethodHooks.effects`) instead of the host's

Everything else stays the host's: schedule, how the keep map enters SSIM, which photos. Grafts that cannot
work are refused, see graft_checks.py. Imports no torch: names are checked before anything heavy is loaded.
"""

from __future__ import annotations

import dataclasses
import hashlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ambiguous_wild.core.errors import AwError, unknown
from ambiguous_wild.methods.entry import MethodEntry, trained_once
from ambiguous_wild.methods.references import is_program, is_reference, reference_file, replace_reference_file

if TYPE_CHECKING:
    from ambiguous_wild.methods.graft_checks import Member
    from ambiguous_wild.splat.method_hooks import MethodHooks

SLOTS = ("mask", "density", "regulariser", "effects")
ALIASES = {"none": "3dgs", "motion": "3dgs+motion", "truth": "3dgs+truth"}  # short names of donors


def graft_name(host: str, donors: Mapping[str, str | None]) -> str:
    """Return a name such as `3dgs@mask=refinesplat,density=refinesplat`; the host's if no slot is filled.

    Donors replace those in the host's name.
    """
    base, rest = split_graft(host)
    filled = dict(graft_pairs(host)) if rest else {}
    filled |= {slot: donor for slot, donor in donors.items() if donor}
    text = ",".join(f"{slot}={filled[slot]}" for slot in SLOTS if slot in filled)
    return f"{base}@{text}" if text else base


def split_graft(name: str) -> tuple[str, str]:
    """Split a name into the host and the text after its @; the path of a reference may contain an @ too.

    Raises:
        AwError: nothing follows the @, or there are two.
    """
    if is_reference(name) or "@" not in name:
        return name, ""
    host, _, rest = name.rpartition("@")
    if not rest or ("@" in host and not is_reference(host)):
        first = host.partition("@")[0]
        raise AwError(f"method {name!r}: write {first}@mask=METHOD,density=METHOD, with one @")
    return host, rest


def replace_reference_files(name: str, moved: Callable[[Path], Path]) -> str:
    """Return the name of a method with other paths of the files that it, or its donors, are recipes in."""
    once = trained_once(name)
    if is_reference(once):
        file = reference_file(once)
        return name if file is None else replace_reference_file(once, moved(file)) + name.removeprefix(once)
    host, rest = split_graft(once)
    if not rest:
        return name
    donors = {slot: replace_reference_files(donor, moved) for slot, donor in graft_pairs(once)}
    return graft_name(replace_reference_files(host, moved), donors) + name.removeprefix(once)


def refuse_parts_of_program(name: str) -> None:
    """Raise AwError for a name such as `external:opensplat@density=uad`: a program takes no parts."""
    host, _, rest = name.rpartition("@")
    if not is_program(host) or not all(slot in SLOTS for slot, _ in _written(rest)):
        return
    path = reference_file(name)
    if path is None or not path.exists():
        raise _program_takes_no_parts(host, rest)


def _program_takes_no_parts(host: str, rest: str) -> AwError:
    return AwError(
        f"{host} is trained by another program, which takes no parts of other methods: leave {rest} out"
    )


def knows_truth(name: str) -> bool:
    """Whether a method of this name uses exact masks or clean photos, which no real capture has.

    Such a row is an upper bound; tables do not rank it. A graft has its host's photos and, unless a donor
    replaces them, its host's masks. Any other name, such as an ablation variant's, is accepted too.
    """
    name = trained_once(name)
    host, _, rest = name.rpartition("@") if "@" in name else (name, "", "")
    masks = [ALIASES.get(donor, donor) for slot, donor in _written(rest) if slot == "mask"] or [host]
    return host == "3dgs-clean" or masks[-1] == "3dgs+truth"


def members(name: str) -> list[str]:
    """Return the host and the donors in a method's name; for a variant of an ablation its method."""
    host, _, rest = name.rpartition("@") if "@" in name else (name, "", "")
    return list(dict.fromkeys([host, *(ALIASES.get(donor, donor) for _, donor in _written(rest) if donor)]))


def grafted(name: str, host: MethodEntry, methods: Mapping[str, MethodEntry]) -> MethodEntry:
    """Return the method that a graft's name stands for.

    Args:
        name: name of the graft, as it was typed.
        host: the method before its @.
        methods: possible donors by name.

    Raises:
        AwError: a slot or donor is unknown, or a slot is filled twice.
    """
    if host.passes > 1:
        raise AwError(f"{name}: the end of the name says that it trains twice: {host.base}@...+2passes")
    pairs = graft_pairs(name)
    if host.program is not None:
        raise _program_takes_no_parts(host.name, split_graft(name)[1])
    donors = {slot: _donor(slot, donor, methods) for slot, donor in pairs}
    entries = {"host": host} | donors
    fields = [
        (slot, entry.options_class(), dataclasses.field(default_factory=entry.options))
        for slot, entry in entries.items()
    ]
    hashes = [entry.source_hash for entry in entries.values()]
    in_files = any(entry.given_as for entry in entries.values())
    typed = {slot: donors[slot].given_as or donor for slot, donor in pairs}
    ordered = graft_name(host.name, dict(pairs))  # in the order of the slots, so that one graft has one name
    return MethodEntry(
        name=ordered,
        summary=f"{host.name} with " + ", ".join(f"the {slot} of {e.name}" for slot, e in donors.items()),
        recipe=Graft(ordered, entries),
        config=dataclasses.make_dataclass("GraftOptions", fields, frozen=True),
        needs="; ".join(dict.fromkeys(e.needs for e in entries.values() if e.needs)),
        source_hash=hashlib.sha256("".join(hashes).encode()).hexdigest() if any(hashes) else "",
        slots=tuple((slot, entry.name) for slot, entry in entries.items())
        + tuple((slot, donor) for slot, donor in pairs if donor in ALIASES),
        given_as=graft_name(host.given_as or host.name, typed) if in_files else "",
    )


@dataclass(frozen=True, eq=False)
class Graft:
    """The recipe of a graft."""

    name: str
    entries: Mapping[str, MethodEntry]  # "host", and the donor of every slot that is filled

    def __call__(self, options: Any) -> MethodHooks:
        return build(self.name, self.entries, options)


def build(name: str, entries: Mapping[str, MethodEntry], options: Any) -> MethodHooks:
    """Return the host's hooks with those of the donors in their slots.

    A method that fills two slots with the same options is built once, so its frozen inputs are prepared
    once, and a method grafted onto itself is unchanged.

    Args:
        name: name of the graft, for warnings.
        entries: "host", and the donor of every slot that is filled.
        options: their options, by slot.
    """
    from ambiguous_wild.methods.graft_checks import check_members

    host_member, donors = _members(name, entries, options)
    check_members(host_member, donors)
    host = host_member.hooks
    mask, regulariser = (donors.get(slot, host_member).hooks.mask for slot in ("mask", "regulariser"))
    host = dataclasses.replace(host, mask=combine_policies(mask, regulariser))
    if "density" in donors:
        density = donors["density"].hooks
        host = dataclasses.replace(
            host,
            density=density.density,
            density_config=density.density_config,
            # MCMC's fixed number of Gaussians needs its own start
            start_opacity=density.start_opacity,
            start_scale=density.start_scale,
            start=host.start if density.start is None else density.start,
        )
    if "effects" not in donors:
        return host
    effects = donors["effects"].hooks.effects
    for effect in effects:
        host = host.with_effect(effect)
    return dataclasses.replace(host, effects=effects)


def _members(name: str, entries: Mapping[str, MethodEntry], options: Any) -> tuple[Member, dict[str, Member]]:
    """Build the host and the donors by slot; a method with equal options is built once."""
    from ambiguous_wild.methods.graft_checks import Member

    typed, members = dict(graft_pairs(name)), {}
    built: list[tuple[str, Any, MethodHooks]] = []  # method, options, hooks
    for slot, entry in entries.items():
        own = getattr(options, slot)
        hooks = next((hooks for method, set_, hooks in built if method == entry.name and set_ == own), None)
        if hooks is None:
            hooks = entry.build(own)
            built.append((entry.name, own, hooks))
        members[slot] = Member(typed.get(slot, entry.name), hooks)
    return members.pop("host"), members


def combine_policies(mask: Any, regulariser: Any) -> Any:
    """Join two policies to one: keep maps of `mask`, losses of `regulariser`."""
    from ambiguous_wild.methods.mask_policies import GraftedMaskPolicy

    if regulariser is mask:
        return mask
    # a donor of masks does not add its own loss
    return GraftedMaskPolicy(mask, regulariser if regulariser.regularises() else None)


def check_graft(method: MethodEntry, options: Any) -> list[str]:
    """Return warnings about a graft: losses that are switched off, and effects that it leaves out.

    There are none for other methods, or if a recipe fails: building it will tell why.

    Raises:
        AwError: the graft cannot train, or would change nothing.
    """
    from ambiguous_wild.methods.graft_checks import NOTHING, check_members, omitted_effect_warnings

    recipe = method.recipe
    if not isinstance(recipe, Graft):
        return []
    try:
        host, donors = _members(recipe.name, recipe.entries, options)
    except Exception:
        return []
    check_members(host, donors)
    warnings, losses = omitted_effect_warnings(host, donors), donors.get("regulariser")
    if losses is not None and losses.name not in NOTHING and not losses.hooks.mask.regularises():
        warnings.append(
            f"{losses.name} adds no loss on the render with these options; "
            f"switch it on with --set {losses.name}.KEY=VALUE, or leave the regulariser out"
        )
    return warnings


def graft_pairs(name: str) -> list[tuple[str, str]]:
    """Return (slot, donor) for every slot that the name of a graft fills.

    Raises:
        AwError: a slot is unknown, has no donor, or is filled twice.
    """
    host, rest = split_graft(name)
    pairs = _written(rest) if rest else []
    for number, (slot, donor) in enumerate(pairs):
        if not donor:
            raise AwError(f"method {name!r}: write {host}@mask=METHOD; slots are {', '.join(SLOTS)}")
        if slot not in SLOTS:
            raise unknown(f"slot in {name!r}", slot, SLOTS)
        if slot in dict(pairs[:number]):
            raise AwError(f"method {name!r}: the {slot} is given twice")
    return pairs


def _written(rest: str) -> list[tuple[str, str]]:
    """Split `mask=refinesplat,density=truth` into (slot, donor); the donor is empty without a `=`."""
    parts = [text.partition("=") for text in rest.split(",")]
    return [(slot.strip(), donor.strip()) for slot, _, donor in parts]


def _donor(slot: str, name: str, methods: Mapping[str, MethodEntry]) -> MethodEntry:
    target = ALIASES.get(name, name)
    if is_program(name) or (target in methods and methods[target].program is not None):
        raise AwError(
            f"{slot}={name}: {name} is trained by another program, which has no parts for other methods; "
            "name a method of 'aw methods'"
        )
    if "@" in target or target not in methods:
        raise unknown(f"{slot} donor", name, [*methods, *ALIASES], "'aw methods' lists them")
    return methods[target]
