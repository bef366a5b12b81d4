"""Finds methods by name. Listing them imports neither torch nor any method's code.

A user's method is found in four ways: `register(...)`, the entry-point group
`ambiguous_wild.methods`, a file given as `--plugin my_method.py`, or a reference to a recipe in a file,
`--method my_method.py:my_recipe` (see docs/extend.md).
"""

from __future__ import annotations

import dataclasses
import importlib.metadata
from functools import cache
from pathlib import Path

from ambiguous_wild.core.errors import AwError, unknown
from ambiguous_wild.core.names import check_name
from ambiguous_wild.methods.builtin import BUILTIN
from ambiguous_wild.methods.entry import MethodEntry, second_pass, trained_once
from ambiguous_wild.methods.graft import (
    graft_name,
    graft_pairs,
    grafted,
    knows_truth,
    refuse_parts_of_program,
    split_graft,
)
from ambiguous_wild.methods.references import (
    hash_of_package,
    import_file,
    is_reference,
    read_reference,
    reference_file,
    without_recipe,
)

__all__ = [
    "BUILTIN",
    "MethodEntry",
    "all_methods",
    "get_method",
    "knows_truth",
    "load_plugin",
    "load_reference",
    "register",
]

ENTRY_POINTS = "ambiguous_wild.methods"

registered: dict[str, MethodEntry] = {}  # in this process, by name


def register(entry: MethodEntry) -> MethodEntry:
    """Add a method; a later one of the same name replaces the earlier, unless that is built in.

    Raises:
        AwError: `check_name` refuses the name, or it is that of a built-in method.
    """
    entry = dataclasses.replace(entry, name=check_name("method name", entry.name))
    if entry.name.casefold() in {known.name.casefold() for known in BUILTIN}:
        raise AwError(f"the method {entry.name!r} is built in: register yours under another name")
    registered[entry.name] = entry
    return entry


def all_methods() -> dict[str, MethodEntry]:
    """Every method by name: built in, installed as entry points, registered."""
    return _installed() | {entry.name: entry for entry in BUILTIN} | registered


@cache
def _installed() -> dict[str, MethodEntry]:
    """Load the entry points, and hash their modules, once a process."""
    return {
        point.name: dataclasses.replace(point.load(), source_hash=hash_of_package(point))
        for point in importlib.metadata.entry_points(group=ENTRY_POINTS)
    }


def get_method(name: str) -> MethodEntry:
    """Return the method of this name, in any case of letters.

    "host@mask=donor" is a graft, see graft.py. "recipe.py:my_recipe", "external:FILE" and
    "nerfbaselines:METHOD" are references, see references.py. "NAME+2passes" trains twice, see entry.py.

    Raises:
        AwError: the name is unknown; the message suggests the nearest.
    """
    once = trained_once(name)
    if once != name:
        return second_pass(get_method(once))
    refuse_parts_of_program(name)
    if is_reference(name):
        return load_reference(name)
    methods = all_methods()
    if name not in methods and "@" in name:
        host_name, _ = split_graft(name)
        host, donors = get_method(host_name), dict(graft_pairs(name))
        donors |= {slot: load_reference(donor).name for slot, donor in donors.items() if is_reference(donor)}
        return grafted(graft_name(host_name, donors), host, all_methods())
    if name not in methods and name.endswith(".py"):
        raise without_recipe(Path(name))
    module, _, recipe = name.partition(":")
    if recipe:
        raise AwError(
            f"unknown method {name!r}: for one in a file write FILE.py:RECIPE, as {module}.py:{recipe}"
        )
    in_any_case = [known for known in methods if known.casefold() == name.casefold()]
    if name not in methods and len(in_any_case) != 1:
        raise unknown("method", name, methods, "'aw methods' lists them; of a file: FILE.py:RECIPE")
    return methods[name if name in methods else in_any_case[0]]


def load_reference(name: str, *, given_as: str = "") -> MethodEntry:
    """Return the method of a reference, and register it, so that its name alone finds it from now on.

    Args:
        name: the reference.
        given_as: the reference that was typed, if `name` refers to a copy of that file.

    Raises:
        AwError: no such file, no recipe in it, or another method has its name.
    """
    entry = read_reference(name, given_as=given_as)
    other = all_methods().get(entry.name)
    if other is not None and other.source_hash != entry.source_hash and other.given_as != entry.given_as:
        raise AwError(f"{name} is called {entry.name!r}, and so is another method: give it another name")
    return register(entry)


def load_plugin(path: Path | str) -> list[str]:
    """Import a Python file that calls `register`, or FILE.py:RECIPE; returns the names it added.

    Raises:
        AwError: no such file, it registers nothing or has no such recipe, or another method has its name.
    """
    if reference_file(str(path)) is not None:
        return [load_reference(str(path)).name]
    path, before = Path(path), dict(registered)
    _, digest = import_file(path)
    added = [key for key, entry in registered.items() if before.get(key) is not entry]
    if not added:
        raise AwError(
            f"plugin {path} registers no method: write {path}:RECIPE, or call register(MethodEntry(...))"
        )
    for key in added:
        registered[key] = dataclasses.replace(registered[key], source_hash=digest)
    return added
