"""Ablations as data: a method lists the settings to vary, `aw ablate` trains and tabulates them.

This module imports nothing heavy, so that `aw ablate` lists them without torch. At its end is the paper's
plug-in table: RefineSplat's masks, with three thresholds, in methods with appearance.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from ambiguous_wild.core.config import with_options
from ambiguous_wild.core.errors import AwError, unknown

_NAME = re.compile(r"[a-z0-9][a-z0-9._-]*")  # names become folders
DEFAULT = "default"


@dataclass(frozen=True)
class Variant:
    """One row of an ablation: a name, and the settings that differ from the defaults."""

    name: str
    settings: tuple[str, ...] = ()  # "key=value", as `--set METHOD.KEY=VALUE` takes them
    text: str = ""  # one line of explanation, if the name needs one
    # a back end of features that it needs, see vision/backends.py; without its weights the row is missing
    features: str = ""
    # another method, if the paper compares with one; `settings` are then options of the study's method as the
    # donor of that graft, or of the graft if the study's method is its host
    method: str = ""


@dataclass(frozen=True)
class Group:
    """One table of an ablation study; its first row is always the default."""

    name: str
    title: str
    variants: tuple[Variant, ...]
    source: str = ""  # table of the paper


def values(name: str, key: str, *chosen: object) -> tuple[Variant, ...]:
    """Return a variant NAME-VALUE for each value of an option."""
    return tuple(Variant(f"{name}-{value}", (f"{key}={value}",)) for value in chosen)


def folder_name(method: str, group: Group, variant: Variant) -> str:
    """Return the name of a variant's runs, such as refinesplat@masks-local."""
    return f"{method}@{group.name}-{variant.name}"


def check_groups(method: str, groups: Sequence[Group]) -> None:
    """Raise AwError if two groups or variants share a name, or a name cannot be a folder name."""
    for kind, names in [("groups", [g.name for g in groups])] + [
        (f"variants of {g.name}", [v.name for v in g.variants]) for g in groups
    ]:
        wrong = [n for n in names if not _NAME.fullmatch(n) or n == DEFAULT]
        repeated = sorted({n for n in names if names.count(n) > 1})
        if wrong or repeated:
            fault = f"cannot be called {wrong[0]!r}" if wrong else f"are called {repeated[0]!r} twice"
            raise AwError(f"ablations of {method}: {kind} {fault}; use small letters, digits, '.', '_', '-'")


def sweep_groups(options: Any, sweeps: Sequence[str]) -> tuple[Group, ...]:
    """Return a group for each "KEY=V1,V2,..." with a variant for each value; AwError for a wrong value."""
    groups = []
    for key, values in ((k, v.split(",")) for k, _, v in (text.partition("=") for text in sweeps)):
        for value in values:
            if not value:
                raise AwError(f"--sweep {key!r}: write KEY=V1,V2, e.g. {key}=0.5,0.9")
            with_options(options, {key: value}, "option of --sweep")
        names = (re.sub(r"[^a-z0-9._-]+", "_", re.sub("^-", "minus", v.lower())) for v in values)
        variants = (Variant(name, (f"{key}={value}",)) for name, value in zip(names, values))
        groups.append(Group(re.sub("[^a-z0-9._]+", "_", key.lower()), f"values of {key}", tuple(variants)))
    return tuple(groups)


def choose_groups(method: str, groups: Sequence[Group], names: Sequence[str]) -> tuple[Group, ...]:
    """Return the groups of these names, in the order of the study; all if none is named.

    Raises:
        AwError: the method has no ablations, or no group of a name.
    """
    if not groups:
        raise AwError(f"{method} declares no ablations: --sweep KEY=V1,V2 varies an option of any method")
    check_groups(method, groups)
    known = [group.name for group in groups]
    for name in names:
        if name not in known:
            hint = f"'aw ablate --method {method}' shows them"
            raise unknown(f"group of {method}'s ablations", name, known, hint)
    return tuple(group for group in groups if not names or group.name in names)


def plug_in(host: str) -> tuple[Group, ...]:
    """Return the plug-in group of a host; its default row has the host's own masks, if any."""
    grafted = f"{host}@mask=refinesplat"
    return (
        Group(
            "plug-in",
            f"Entropy-aware masks in {host}",
            (
                Variant("m-final", method=grafted, text="masks as RefineSplat makes them here"),
                Variant("t-hard", ("mask.mask.threshold=hard",), "a fixed threshold", method=grafted),
                Variant(
                    "t-statistics", ("mask.mask.threshold=statistics",), "mean and deviation", method=grafted
                ),
                Variant("t-ent", ("mask.mask.threshold=kapur",), "by entropy", method=grafted),
            ),
            "Tab. ablation of the threshold with existing methods",
        ),
    )


GSW = plug_in("gs-w")
WILDGAUSSIANS = plug_in("wildgaussians")
