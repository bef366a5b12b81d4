"""A method as the registry knows it: its name, recipe and options. Imports neither torch nor any method.

"NAME+2passes" trains twice, the second time from the start with the final masks of the first, as T-3DGS and
DualSplat do. The second pass has fixed masks instead of the mask policy, whose losses belong to the first
pass; density control, effects, fields and schedule stay.
"""

from __future__ import annotations

import dataclasses
import importlib
import inspect
import typing
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from string import Formatter
from types import FunctionType
from typing import TYPE_CHECKING, Any

from ambiguous_wild.core.errors import AwError
from ambiguous_wild.methods.ablation_groups import Group

if TYPE_CHECKING:
    from ambiguous_wild.methods.external_process import Program
    from ambiguous_wild.splat.method_hooks import MethodHooks

SUFFIX = "+2passes"


@dataclass(frozen=True)
class MethodEntry:
    """A method: its line in `aw methods`, and where its recipe and options are.

    `recipe` is "module:function" or a function; it takes the options and returns `MethodHooks`. `config` is
    "module:Class" or a frozen dataclass: the options of the method, all with defaults. It need not be given
    if it is the type of the function's argument.
    """

    name: str
    summary: str
    recipe: str | Callable[[Any], MethodHooks]
    config: str | type | None = None
    paper: str = ""
    cite: str = ""  # key of the paper in a .bib file, as Google Scholar makes it
    needs: str = ""  # required extras, weights or hardware; empty = none
    ablations: (
        str | tuple[Group, ...]
    ) = ()  # "module:ABLATIONS" or the groups, see methods/ablation_groups.py
    source_hash: str = ""  # hash of a plugin's file: a changed plugin is another configuration
    # for a graft the method behind each field of its options, see graft.py
    slots: tuple[tuple[str, str], ...] = ()
    # an external program, which runs instead of parts on our trainer, see external.py
    program: Program | None = None
    base: str = ""  # for a method that trains twice its name without "+2passes", by which options are set
    passes: int = 1  # number of trainings; the second uses the final masks of the first
    # for a method named by its file the value of --method, with the absolute path, see references.py
    given_as: str = ""
    # a line below every table of its runs; {features} stands for the option of that name
    note: str = ""

    def __post_init__(self) -> None:
        if self.config is None and inspect.isfunction(self.recipe):
            object.__setattr__(self, "config", config_of(self.recipe))

    def options(self) -> Any:
        """Return the method's options with their defaults (a frozen dataclass instance).

        Raises:
            AwError: an option has no default.
        """
        cls = self.options_class()
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

    def options_class(self) -> type:
        """Return the dataclass of the options; that of a method without options is empty."""
        config: Any = self.config
        if config is None and isinstance(self.recipe, str):
            config = config_of(resolve(self.recipe))
        return resolve(config) or NoOptions

    def by_machine(self) -> frozenset[str]:
        """Return the options whose defaults depend on the machine's weights, see vision/backends.py."""
        options = self.options()
        fields = dataclasses.fields(options) if dataclasses.is_dataclass(options) else ()
        return frozenset(f.name for f in fields if f.metadata.get("by_machine"))

    def about(self, options: Iterable[Mapping[str, object]]) -> str:
        """Return `note` with the values of the options that it names in braces.

        Args:
            options: flat options of each run that the note is about.
        """
        runs = list(options)
        keys = [key for _, key, _, _ in Formatter().parse(self.note) if key]
        values = {
            key: "/".join(dict.fromkeys(str(o[key]) for o in runs if key in o)) or "not recorded"
            for key in keys
        }
        return self.note.format_map(values)

    def option_keys(self, method: str, key: str) -> list[str]:
        """Return the keys of this method's options that a setting METHOD.KEY sets; may be empty."""
        if method in (self.name, self.base):
            return [key]
        return [f"{slot}.{key}" for slot, name in self.slots if name == method]

    def ablation_groups(self) -> tuple[Group, ...]:
        """Return the ablations that the method declares; may be empty."""
        return tuple(resolve(self.ablations))

    def build(self, options: Any) -> MethodHooks:
        """Call the recipe; returns the hooks that fill the training loop.

        Raises:
            AwError: the recipe returned something else, or takes more than the options.
        """
        from ambiguous_wild.splat.method_hooks import MethodHooks

        recipe = resolve(self.recipe)
        needed = required(recipe)
        if len(needed) > 1:
            raise AwError(
                f"the recipe of {self.name} takes {', '.join(p.name for p in needed)}: it must take nothing, "
                "or one argument whose type is a dataclass of options"
            )
        hooks = recipe(options) if needed or self.config else recipe()
        if not isinstance(hooks, MethodHooks):
            what = "None" if hooks is None else type(hooks).__name__
            raise AwError(f"{self.name} returned {what}, it must return MethodHooks (see docs/extend.md)")
        return hooks


@dataclass(frozen=True)
class NoOptions:
    """The options of a method that has none."""


def required(recipe: Callable[..., object]) -> list[inspect.Parameter]:
    """Return the arguments without a default."""
    every = inspect.signature(recipe).parameters.values()
    return [p for p in every if p.default is p.empty and p.kind not in (p.VAR_POSITIONAL, p.VAR_KEYWORD)]


def config_of(recipe: FunctionType) -> type | None:
    """Return the dataclass that annotates the function's one argument; None if there is none.

    Raises:
        AwError: a type is not defined.
    """
    needed = required(recipe)
    try:
        config = typing.get_type_hints(recipe).get(needed[0].name) if len(needed) == 1 else None
    except NameError as error:
        raise AwError(f"recipe {recipe.__name__}: {error} in the types of its arguments") from None
    return config if isinstance(config, type) and dataclasses.is_dataclass(config) else None


def resolve(target: Any) -> Any:
    """Return the object that "module:attribute" names, or any other object unchanged."""
    if not isinstance(target, str):
        return target
    module, _, attribute = target.partition(":")
    return getattr(importlib.import_module(module), attribute)


def second_pass_name(name: str, passes: int) -> str:
    """Return the name of a method that trains this many times, once or twice.

    Raises:
        AwError: another number of passes.
    """
    if passes not in (1, 2):
        raise AwError(f"passes={passes}: a method trains once or twice")
    return name if passes == 1 or name.endswith(SUFFIX) else name + SUFFIX


def trained_once(name: str) -> str:
    """Return the name without `SUFFIX`."""
    return name.removesuffix(SUFFIX)


def second_pass(entry: MethodEntry) -> MethodEntry:
    """Return the method that trains twice.

    Raises:
        AwError: an external program trains it.
    """
    if entry.program is not None:
        raise AwError(f"{entry.name} is trained by another program, which cannot be given masks: no +2passes")
    return dataclasses.replace(
        entry,
        name=entry.name + SUFFIX,
        summary=f"{entry.summary}; then again from the start with the final masks",
        base=entry.name,
        passes=2,
        given_as=entry.given_as and entry.given_as + SUFFIX,
        ablations=(),
    )
