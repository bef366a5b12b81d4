"""A method as the registry knows it: its name, recipe and options. Imports neither torch nor any method."""

from __future__ import annotations

import dataclasses
import importlib
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from string import Formatter
from typing import TYPE_CHECKING, Any

from ambiguous_wild.core.errors import AwError
from ambiguous_wild.methods.ablation import Group

if TYPE_CHECKING:
    from ambiguous_wild.methods.external_process import Program
    from ambiguous_wild.splat.parts import Parts


@dataclass(frozen=True)
class MethodEntry:
    """One line of `aw methods` and the way to the recipe.

    `recipe` is "module:function" or a function; it takes the options and returns `Parts`. `config` is
    "module:Class" or a frozen dataclass: the options of the method, all with defaults.
    """

    name: str
    summary: str
    recipe: str | Callable[[Any], Parts]
    config: str | type | None = None
    paper: str = ""
    needs: str = ""  # extras, weights or hardware; empty = nothing beyond the core
    ablations: str | tuple[Group, ...] = ()  # "module:ABLATIONS" or the groups, see methods/ablation.py
    source_hash: str = ""  # of a plugin's file: a changed plugin is another configuration
    places: tuple[
        tuple[str, str], ...
    ] = ()  # of a graft: the method behind each field of its options, see graft.py
    # an external program, run instead of parts on our trainer, see methods/external/
    program: Program | None = None
    base: str = ""  # of a method that trains twice: its name without that, which options are given by
    passes: int = 1  # trainings, of which the second has the final masks of the first, see second_pass.py
    # of a method named by its file: what --method was given, with the absolute path, see references.py
    given_as: str = ""
    # what every table of its runs says below; {features} stands for the option of that name
    note: str = ""

    def options(self) -> Any:
        """The method's options at their defaults (a frozen dataclass instance).

        Raises:
            AwError: an option without a default.
        """
        cls = resolve(self.config) if self.config else NoOptions
        missing = [
            f.name
            for f in (dataclasses.fields(cls) if dataclasses.is_dataclass(cls) else ())
            if f.default is dataclasses.MISSING and f.default_factory is dataclasses.MISSING
        ]
        if missing:
            raise AwError(
                f"options of {self.name} need a default each, {', '.join(missing)} of "
                f"{getattr(cls, '__name__', 'them')} has none: write {missing[0]}: ... = VALUE"
            )
        return cls()

    def by_machine(self) -> frozenset[str]:
        """Options whose defaults depend on the weights on the machine, see vision/backends.py."""
        options = self.options()
        fields = dataclasses.fields(options) if dataclasses.is_dataclass(options) else ()
        return frozenset(f.name for f in fields if f.metadata.get("by_machine"))

    def about(self, options: Iterable[Mapping[str, Any]]) -> str:
        """`note` with the values of the options that it names in braces.

        Args:
            options: flat, of each run that the note is about.
        """
        every = list(options)
        keys = [key for _, key, _, _ in Formatter().parse(self.note) if key]
        values = {
            key: "/".join(dict.fromkeys(str(o[key]) for o in every if key in o)) or "not recorded"
            for key in keys
        }
        return self.note.format_map(values)

    def option_keys(self, method: str, key: str) -> list[str]:
        """The keys of this method's options that a setting METHOD.KEY sets; may be none."""
        if method in (self.name, self.base):
            return [key]
        return [f"{place}.{key}" for place, name in self.places if name == method]

    def ablation_groups(self) -> tuple[Group, ...]:
        """The ablations that the method declares; may be empty."""
        return tuple(resolve(self.ablations))

    def build(self, options: Any) -> Parts:
        """The parts that fill the training loop.

        Raises:
            AwError: the recipe returned something else.
        """
        from ambiguous_wild.splat.parts import Parts

        made = resolve(self.recipe)(options)
        if not isinstance(made, Parts):
            what = "None" if made is None else type(made).__name__
            raise AwError(f"{self.name} returned {what}, it must return Parts (see docs/extend.md)")
        return made


@dataclass(frozen=True)
class NoOptions:
    """A method without options of its own."""


def resolve(target: Any) -> Any:
    """The object that "module:attribute" names; anything else is returned unchanged."""
    if not isinstance(target, str):
        return target
    module, _, attribute = target.partition(":")
    return getattr(importlib.import_module(module), attribute)
