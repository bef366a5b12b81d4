"""Checks of grafts before training: grafts that cannot train or change nothing; effects that are left out."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from ambiguous_wild.core.errors import AwError
from ambiguous_wild.splat.effects.base import Effect
from ambiguous_wild.splat.method_hooks import MaskPolicy, MethodHooks

NOTHING = ("none", "3dgs")  # donors that leave a place empty
# hooks by which an effect changes a picture, or the Gaussians in it
_VISIBLE = ("first_points", "camera", "model", "shade", "image", "pose", "after_step")


@dataclass(frozen=True)
class Member:
    """The host or a donor of a graft."""

    name: str  # as in the name of the graft
    hooks: MethodHooks


def check_members(host: Member, donors: Mapping[str, Member]) -> None:
    """Refuse a graft that could not train, or a donor that has nothing for its place.

    Args:
        host: the method that is trained.
        donors: donors by place.

    Raises:
        AwError: a donor's masks come from its own fields, it has no loss on the render, or its effects change
            no picture; or masks, losses or fields need effects that the graft leaves out.
    """
    if "mask" in donors:
        _check_mask(host, donors["mask"])
    if "regulariser" in donors:
        _check_regulariser(donors["regulariser"])
    if "effects" in donors:
        _check_effects(host, donors)
    _check_required_effects(host, donors)


def omitted_effect_warnings(host: Member, donors: Mapping[str, Member]) -> list[str]:
    """Return warnings about effects of donors of masks or losses that the graft lacks."""
    if "effects" in donors:
        return []
    own, warnings = {name_of(effect) for effect in host.hooks.effects}, {}
    for place in ("mask", "regulariser"):
        donor = donors.get(place)
        if donor is None or (place == "regulariser" and not donor.hooks.mask.regularises()):
            continue
        names = [name for name in map(name_of, donor.hooks.effects) if name not in own]
        if names:
            warnings[donor.name] = (
                f"leaves out {donor.name}'s effects ({', '.join(names)}): add effects={donor.name} to the "
                f"name to take them, or effects={host.name if own else 'none'} to leave them out without "
                "this warning"
            )
    return list(warnings.values())


def has_masks(hooks: MethodHooks) -> bool:
    """Whether another method can take this method's masks."""
    return type(hooks.mask).keep is not MaskPolicy.keep


def masks_of_fields(hooks: MethodHooks) -> bool:
    """Whether the method's masks only show what its own fields have learnt, and weight no loss."""
    shown = type(hooks.mask).predict is not MaskPolicy.predict
    return hooks.fields is not None and shown and not has_masks(hooks)


def name_of(effect: Effect) -> str:
    return effect.name or type(effect).__name__


def _check_mask(host: Member, donor: Member) -> None:
    if donor.hooks is not host.hooks and masks_of_fields(donor.hooks):
        raise AwError(
            f"mask={donor.name} would mask nothing: the masks of {donor.name} come from its own fields, "
            f"which a graft does not take; use {donor.name} as the host, or take the masks of another method"
        )


def _check_regulariser(donor: Member) -> None:
    own = type(donor.hooks.mask)
    names = ("loss", "cotangent", "gradients")
    losses = any(getattr(own, n) is not getattr(MaskPolicy, n) for n in names)
    if donor.name not in NOTHING and (own.learns_by_gradients or not losses):
        raise AwError(
            f"regulariser={donor.name} would add nothing: {donor.name} has no loss of this kind; name a "
            "method with a loss on the render, e.g. t-3dgs, or leave the regulariser out"
        )


def _check_effects(host: Member, donors: Mapping[str, Member]) -> None:
    donor = donors["effects"]
    effects, mask = donor.hooks.effects, donors.get("mask", host).hooks.mask
    if not effects or donor.hooks is host.hooks:
        return
    if not any(effect is mask.required_effect() or any(map(effect.acts, _VISIBLE)) for effect in effects):
        raise AwError(
            f"effects={donor.name} would change no picture: the effects of {donor.name} serve its own "
            f"fields, which a graft does not take; use {donor.name} as the host, or write effects=none"
        )


def _check_required_effects(host: Member, donors: Mapping[str, Member]) -> None:
    taken = donors.get("effects", host).hooks.effects

    def lacks(effect: Effect | None) -> bool:
        return effect is not None and not any(effect is other for other in taken)

    if host.hooks.fields is not None and lacks(host.hooks.fields.required_effect()):
        raise AwError(
            f"the fields of {host.name} need its effects, which effects={donors['effects'].name} replaces: "
            f"leave effects={donors['effects'].name} out"
        )
    unfit = {}  # place -> method whose masks or losses need effects that the graft lacks
    masking, losing = donors.get("mask", host), donors.get("regulariser", host)
    if lacks(masking.hooks.mask.required_effect()):
        unfit["mask"] = masking
    if losing.hooks.mask.regularises() and lacks(losing.hooks.mask.loss_effect()):
        unfit["regulariser"] = losing
    for place, owner in unfit.items():
        what = "masks" if place == "mask" else "losses"
        if owner is host:
            places = [p for p, member in unfit.items() if member is host]
            raise AwError(_host_lacks_effects(what, host, donors["effects"], places))
        how = f"add effects={owner.name} to the name"
        if "effects" in donors:
            how = f"write effects={owner.name} instead of effects={donors['effects'].name}"
        raise AwError(f"the {what} of {owner.name} need its effects: {how}")


def _host_lacks_effects(what: str, host: Member, effects: Member, places: list[str]) -> str:
    """Return the message for a host whose masks or losses need the effects that a donor replaces."""
    empty = ",".join(f"{place}=none" for place in places)
    ways = [empty]
    if places[0] == "mask" and has_masks(effects.hooks):
        ways.insert(0, empty.replace("mask=none", f"mask={effects.name}"))
    return (
        f"the {what} of {host.name} need its own effects, which effects={effects.name} replaces: "
        f"add {' or '.join(ways)} to the name, or leave effects={effects.name} out"
    )
