"""Which methods there are. Listing them imports neither torch nor any method's code.

A method of one's own is found in four ways: `register(...)`, the entry-point group
`ambiguous_wild.methods`, a file given as `--plugin my_method.py`, or a reference to a recipe in a file,
`--method my_method.py:my_recipe` (see docs/add-a-method.md).
"""

from __future__ import annotations

import dataclasses
import hashlib
import importlib
import importlib.metadata
import importlib.util
import sys
import traceback
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING, Any

from ambiguous_wild.core.errors import AwError, unknown
from ambiguous_wild.methods.ablation import Group

if TYPE_CHECKING:
    from ambiguous_wild.methods.external.program import Program
    from ambiguous_wild.splat.parts import Parts

ENTRY_POINTS = "ambiguous_wild.methods"


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
    places: tuple[tuple[str, str], ...] = ()  # of a graft: which field of its options is whose, see graft.py
    # effects that `aw bench` may switch on by itself where a scene calls for them; a baseline has none, it
    # stays what its paper defines
    auto_effects: tuple[str, ...] = ()
    # somebody else's program, run as it is instead of parts on our trainer, see methods/external/
    program: Program | None = None
    # how --method names it, where that says where it lies: with the absolute path, see references.py
    given_as: str = ""

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

    def option_keys(self, method: str, key: str) -> list[str]:
        """Where a setting METHOD.KEY goes in this method's options; nowhere if METHOD has no part in it."""
        if method == self.name:
            return [key]
        return [f"{place}.{key}" for place, name in self.places if name == method]

    def ablation_groups(self) -> tuple[Group, ...]:
        """The ablations the method declares; empty where there are none."""
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
            raise AwError(f"{self.name} returned {what}, it must return Parts (see docs/add-a-method.md)")
        return made


@dataclass(frozen=True)
class NoOptions:
    """A method without options of its own."""


BUILTIN = (
    MethodEntry(
        name="3dgs",
        summary="plain 3D Gaussian Splatting: no masks, every photo believed",
        recipe="ambiguous_wild.methods.threedgs:build",
        paper="Kerbl et al., SIGGRAPH 2023",
    ),
    MethodEntry(
        name="refinesplat",
        summary="entropy-aware masks, density control and merging for ambiguous distractors",
        recipe="ambiguous_wild.methods.refinesplat.recipe:build",
        config="ambiguous_wild.methods.refinesplat.recipe:Config",
        paper="Rectifying Mask via Entropy for Distractor-Free 3DGS in Ambiguous Scenarios",
        ablations="ambiguous_wild.methods.refinesplat.ablations:ABLATIONS",
        auto_effects=("exposure", "appearance", "antialias", "poses"),
    ),
    MethodEntry(
        name="robustsplat",
        summary="growth delayed until masks stand; a net on frozen features, taught coarse to fine",
        recipe="ambiguous_wild.methods.robustsplat.recipe:build",
        config="ambiguous_wild.methods.robustsplat.recipe:Config",
        paper="Fu et al., ICCV 2025 (arXiv 2506.02751)",
    ),
    MethodEntry(
        name="dronesplat",
        summary="masks instances whose residual stands out in their photo",
        recipe="ambiguous_wild.methods.dronesplat:build",
        config="ambiguous_wild.methods.dronesplat:DroneSplatConfig",
        paper="Tang et al., CVPR 2025 (arXiv 2503.16964)",
    ),
    MethodEntry(
        name="3dgs+truth",
        summary="reference: 3dgs under the capture's exact masks",
        recipe="ambiguous_wild.methods.truth:build_masked",
        config="ambiguous_wild.methods.truth:TruthConfig",
        needs="a capture with exact truth",
    ),
    MethodEntry(
        name="3dgs-clean",
        summary="reference: 3dgs on the capture's photos with nobody there",
        recipe="ambiguous_wild.methods.truth:build_clean",
        needs="a capture with exact truth",
    ),
)

_registered: dict[str, MethodEntry] = {}


def knows_truth(name: str) -> bool:
    """Whether a method of this name is shown what no capture in the wild has: exact masks, or clean photos.

    Such a row says what is possible; tables do not rank it among the others. Of a graft: its photos and,
    unless another's replace them, its masks are the host's.
    """
    host, _, rest = name.rpartition("@") if "@" in name else (name, "", "")
    masks = [part.partition("=")[2] for part in rest.split(",") if part.partition("=")[0] == "mask"]
    known = [donor in ("truth", "3dgs+truth") for donor in masks] or [host == "3dgs+truth"]
    return host == "3dgs-clean" or known[-1]


def register(entry: MethodEntry) -> MethodEntry:
    """Add a method; a later one of the same name replaces the earlier."""
    if not entry.name or any(c in entry.name for c in "/\\\0") or entry.name.startswith("."):
        raise AwError(f"method name {entry.name!r} cannot name a folder: leave out '/' and a leading '.'")
    _registered[entry.name] = entry
    return entry


def all_methods() -> dict[str, MethodEntry]:
    """Every method by name: built in, installed as entry points, registered."""
    methods = {entry.name: entry for entry in BUILTIN}
    for point in importlib.metadata.entry_points(group=ENTRY_POINTS):
        methods.setdefault(point.name, point.load())
    return methods | _registered


def get_method(name: str) -> MethodEntry:
    """The method of that name; "host@mask=donor" is a graft, see graft.py, and "recipe.py:my_recipe",
    "external:FILE" and "nerfbaselines:METHOD" are references, see references.py.

    Raises:
        AwError: there is none; names the nearest.
    """
    from ambiguous_wild.methods.references import is_reference, load_reference

    if is_reference(name):
        return load_reference(name)
    methods = all_methods()
    if name not in methods and "@" in name:
        from ambiguous_wild.methods.graft import grafted

        return grafted(name)
    if name not in methods:
        raise unknown("method", name, methods, "'aw methods' lists them")
    return methods[name]


def load_plugin(path: Path | str) -> list[str]:
    """Import a Python file that calls `register`; returns the names it added.

    Raises:
        AwError: no such file, or it registers nothing.
    """
    path = Path(path)
    if not path.is_file():
        raise AwError(f"no plugin file {path}: give the path of a .py file that calls register(...)")
    before = dict(_registered)
    import_file(path)
    digest = hashlib.sha256(path.read_bytes()).hexdigest()
    added = [key for key, entry in _registered.items() if before.get(key) is not entry]
    if not added:
        raise AwError(f"plugin {path} registers no method: call register(MethodEntry(...)) in it")
    for key in added:
        _registered[key] = dataclasses.replace(_registered[key], source_hash=digest)
    return added


def import_file(path: Path) -> ModuleType:
    """The module of a Python file, run anew.

    Raises:
        AwError: it is no Python file, or fails when it is loaded; names the line.
    """
    name = f"aw_plugin_{path.stem}"
    spec = importlib.util.spec_from_file_location(name, path)
    if spec is None or spec.loader is None:
        raise AwError(f"plugin {path} is no Python file: its name must end in .py")
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module
    try:
        spec.loader.exec_module(module)
    except AwError:
        raise
    except SyntaxError as error:
        raise AwError(f"plugin {path}, line {error.lineno}: {error.msg}") from None
    except (Exception, SystemExit) as error:
        line = _line_in(error, path)
        raise AwError(
            f"plugin {path}{line} fails when it is loaded: {type(error).__name__}: {error}"
        ) from error
    return module


def _line_in(error: BaseException, path: Path) -> str:
    """ ", line 7" of the file, where the error passed through it."""
    lines = [
        frame.lineno for frame in traceback.extract_tb(error.__traceback__) if frame.filename == str(path)
    ]
    return f", line {lines[-1]}," if lines else ""


def resolve(target: Any) -> Any:
    """What "module:attribute" names; anything else is returned as it is."""
    if not isinstance(target, str):
        return target
    module, _, attribute = target.partition(":")
    return getattr(importlib.import_module(module), attribute)
