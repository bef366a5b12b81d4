"""A method in words: what its recipe says of itself, its options with their comments, its parts."""

from __future__ import annotations

import ast
import dataclasses
import importlib.util
import inspect
import io
import textwrap
import tokenize
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ambiguous_wild.core.config import to_plain
from ambiguous_wild.methods.entry import MethodEntry
from ambiguous_wild.methods.traits import Traits, traits_of

COLUMNS = ("method", "masks", "appearance", "density", "extra state", "back ends", "facts from")
BACK_ENDS = "features", "instances"  # options that name one, see vision/backends.py


@dataclass(frozen=True)
class Option:
    """An option of a method."""

    key: str  # dotted, as after METHOD. in --set
    default: str
    comment: str  # from its definition; "" = none


def recipe_text(entry: MethodEntry) -> str:
    """The docstring of the module that the recipe is in; nothing is imported but its packages."""
    if not isinstance(entry.recipe, str):
        return inspect.getdoc(inspect.getmodule(entry.recipe)) or ""
    spec = importlib.util.find_spec(entry.recipe.partition(":")[0])
    if spec is None or spec.origin is None:
        return ""
    return ast.get_docstring(ast.parse(Path(spec.origin).read_text(encoding="utf-8"))) or ""


def options_of(entry: MethodEntry) -> list[Option]:
    """Every option with its default; those of parts, such as density control, by dotted keys."""
    return _options(entry.options(), "")


def _options(config: Any, prefix: str) -> list[Option]:
    found, said = [], _comments(type(config))
    for f in dataclasses.fields(config):
        value = getattr(config, f.name)
        if dataclasses.is_dataclass(value):
            found += _options(value, f"{prefix}{f.name}.")
        else:
            found.append(Option(prefix + f.name, _short(to_plain(value)), said.get(f.name, "")))
    return found


def _comments(cls: type) -> dict[str, str]:
    found: dict[str, str] = {}
    for base in reversed(cls.__mro__):
        if not dataclasses.is_dataclass(base):
            continue
        try:
            source = textwrap.dedent(inspect.getsource(base))
        except (OSError, TypeError):  # made at run time, as a graft's
            continue
        at = {
            token.start[0]: token.string.lstrip("#").strip()
            for token in tokenize.generate_tokens(io.StringIO(source).readline)
            if token.type == tokenize.COMMENT
        }
        alone = {k for k, line in enumerate(source.splitlines(), 1) if line.lstrip().startswith("#")}
        for node in ast.parse(source).body[0].body:  # type: ignore[attr-defined]
            if isinstance(node, ast.AnnAssign) and isinstance(node.target, ast.Name):
                first = node.lineno
                while first - 1 in alone:
                    first -= 1
                last = node.end_lineno or node.lineno
                said = [at[k] for k in range(first, last + 1) if k in at]
                if said:
                    found[node.target.id] = " ".join(said)
    return found


def _short(value: Any) -> str:
    if isinstance(value, list):
        return ",".join(map(_short, value)) or "()"
    return f"{value:g}" if isinstance(value, float) else str(value)


def table_row(entry: MethodEntry) -> tuple[str, ...]:
    """`COLUMNS` of a method."""
    traits = traits_of(entry.name)
    if entry.program is not None:
        return (entry.name, "", "", "", "", "its own program", "")
    if traits is None:
        return (entry.name, "?", "?", "?", "?", "CPU, GPU?", "?")
    places = "CPU" if traits.cpu_only else "CPU, GPU"
    parts = (traits.masks, traits.appearance, traits.density, traits.state)
    return (entry.name, *(part or "-" for part in parts), places, traits.source or "-")


def details(entry: MethodEntry) -> dict[str, Any]:
    """All that is known of a method, ready for JSON."""
    options = [] if entry.program is not None else options_of(entry)
    traits = traits_of(entry.base or entry.name) or Traits()
    once = dataclasses.replace(entry, name=entry.base or entry.name)
    runs_with = {o.key: o.default for o in options if o.key.rpartition(".")[2] in BACK_ENDS}
    return {
        "name": entry.name,
        "summary": entry.summary,
        "paper": entry.paper,
        "needs": entry.needs,
        "recipe": entry.recipe if isinstance(entry.recipe, str) else "",
        "about": "" if entry.program is not None else recipe_text(entry),
        "parts": dict(zip(COLUMNS[1:], table_row(once)[1:])),
        "published_with": traits.published,
        "runs_with": runs_with,
        "options": [dataclasses.asdict(option) for option in options],
        "ablations": [
            {"name": g.name, "title": g.title, "variants": [v.name for v in g.variants]}
            for g in entry.ablation_groups()
        ],
        "passes": entry.passes,
    }
