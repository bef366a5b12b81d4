"""Methods named by their location: a recipe in a file, a program's description, NerfBaselines.

recipe.py:my_recipe     a function, or a MethodEntry, in a Python file, which is loaded as a module
external:my.yaml        a program with commands of its own, see external.py; external:NAME: of the package
nerfbaselines:METHOD    a method of NerfBaselines in its own environment, see nerfbaselines_methods.py
masks:FOLDER            masks in files, see folder_masks.py
"""

from __future__ import annotations

import ast
import dataclasses
import functools
import importlib.metadata
import importlib.util
import inspect
import os
import re
import sys
import traceback
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING

from ambiguous_wild.core.config import config_hash
from ambiguous_wild.core.errors import AwError, unknown
from ambiguous_wild.core.names import check_name
from ambiguous_wild.io.files import sha256_file
from ambiguous_wild.io.mask_files import SPELLINGS, mask_files
from ambiguous_wild.methods.entry import MethodEntry, required

if TYPE_CHECKING:
    from ambiguous_wild.splat.method_hooks import MethodHooks

_loaded: set[str] = set()  # paths of loaded files, as in tracebacks
_helpers: dict[str, Path] = {}  # files of modules that loaded files imported from beside them, by name
_NO_HELPERS = (Path(os.__file__).resolve().parent, Path(__file__).resolve().parents[1])  # Python's and ours
EXTERNAL, NERFBASELINES, MASKS = "external:", "nerfbaselines:", "masks:"
_GRAFTED = re.compile(r"@(?:mask|density|regulariser|effects)=[^@]*$")
_RECIPE = re.compile(r"(?P<path>.+\.py):(?P<name>[A-Za-z_]\w*)")


def hash_of_package(point: importlib.metadata.EntryPoint) -> str:
    """Return the identity of what an installed package offers: of its version and its module's file."""
    spec = importlib.util.find_spec(point.module)
    code = sha256_file(spec.origin) if spec is not None and spec.origin else ""
    return config_hash([point.dist.version if point.dist is not None else "", code])


def import_file(path: Path) -> tuple[ModuleType, str]:
    """Run a Python file; returns its module and its hash.

    The hash is the sha256 of the file, or one of it and of the modules below its folder that it imported.

    Raises:
        AwError: no such file, no Python file, or it fails when it is loaded; the message names the line.
    """
    if not path.is_file():
        raise AwError(f"no plugin file {path}: give the path of a .py file")
    name = f"aw_plugin_{path.stem}"
    loaded = getattr(sys.modules.get(name), "__file__", None)
    if loaded is not None and Path(loaded).resolve() != path.resolve():
        name += f"_{config_hash(str(path.resolve()))[:8]}"
    spec = importlib.util.spec_from_file_location(name, path)
    if spec is None or spec.loader is None:
        raise AwError(f"plugin {path} is no Python file: its name must end in .py")
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module
    _loaded.add(str(spec.origin))
    folder = path.resolve().parent
    # helpers are imported anew: they may have been edited, another file's may have the same name, and the
    # hash needs those of this file
    for helper in [n for n, file in _helpers.items() if file.is_relative_to(folder) or _has(folder, n)]:
        del _helpers[helper]
        sys.modules.pop(helper, None)
    before = set(sys.modules)
    # first, as Python does for a script; afterwards last, for imports in functions, where it hides nothing
    sys.path.insert(0, str(folder))
    # nothing is left beside the file, and one that was edited within a second is not taken from a cache
    writes, sys.dont_write_bytecode = sys.dont_write_bytecode, True
    try:
        spec.loader.exec_module(module)
    except AwError as error:
        raise AwError(f"plugin {path}: {error}") from error
    except SyntaxError as error:
        raise AwError(f"plugin {path}, line {error.lineno}: {error.msg}") from None
    except (Exception, SystemExit) as error:
        why = f"{type(error).__name__}: {error}{error_location(error)}"
        if "splat.parts" in why:
            why += "; Parts is MethodHooks of ambiguous_wild.splat.method_hooks now"
        raise AwError(f"plugin {path} fails when it is loaded: {why}") from error
    finally:
        sys.dont_write_bytecode = writes
        sys.path.remove(str(folder))
        if str(folder) not in sys.path:
            sys.path.append(str(folder))
        files = {new: _file_of(new) for new in sys.modules.keys() - before}
        own = {new: file for new, file in files.items() if file and file.is_relative_to(folder)}
        _helpers.update(own)
    own |= {str(file): file for file in _imported_later(path.resolve(), folder)}
    each = {file.relative_to(folder).as_posix(): sha256_file(file) for file in own.values()}
    digest = sha256_file(path)
    return module, config_hash({**each, "": digest}) if each else digest


def _has(folder: Path, module: str) -> bool:
    place = folder.joinpath(*module.split("."))
    return place.with_suffix(".py").is_file() or (place / "__init__.py").is_file()


def _imported_later(path: Path, folder: Path) -> set[Path]:
    """Return the files below a folder that a file, or one of these, names in an import, also in functions."""
    imported: set[Path] = set()
    waiting = [path]
    while waiting:
        try:
            tree = ast.parse(waiting.pop().read_bytes())
        except (SyntaxError, ValueError):
            continue
        names = {
            alias.name for node in ast.walk(tree) if isinstance(node, ast.Import) for alias in node.names
        }
        froms = [node for node in ast.walk(tree) if isinstance(node, ast.ImportFrom) and node.module]
        names |= {str(node.module) for node in froms}
        names |= {f"{node.module}.{alias.name}" for node in froms for alias in node.names}
        for place in (folder.joinpath(*name.split(".")) for name in names):
            for file in (place.with_suffix(".py"), place / "__init__.py"):
                if file.is_file() and file != path and file not in imported:
                    imported.add(file)
                    waiting.append(file)
    return imported


def _file_of(name: str) -> Path | None:
    """Return the file of an imported module; None if it has none, or is Python's, ours or installed."""
    text = str(getattr(sys.modules.get(name), "__file__", None) or "")
    if name.startswith("aw_plugin_") or "site-packages" in text or "dist-packages" in text:
        return None
    file = Path(text).resolve()
    foreign = any(file.is_relative_to(folder) for folder in _NO_HELPERS)
    return file if file.is_file() and not foreign else None


def error_location(error: BaseException) -> str:
    """Return the last place of an error in a loaded file, such as " (my_method.py, line 7)"; else ""."""
    frames = [f for f in traceback.extract_tb(error.__traceback__) if f.filename in _loaded]
    return f" ({Path(frames[-1].filename).name}, line {frames[-1].lineno})" if frames else ""


def is_reference(name: str) -> bool:
    """Whether the name is a reference."""
    return is_program(name) or name.startswith(MASKS) or _recipe_match(name) is not None


def _recipe_match(name: str) -> re.Match[str] | None:
    """Match FILE.py:RECIPE, but not a graft whose last donor is one: 3dgs@mask=FILE.py:RECIPE."""
    return None if _GRAFTED.search(name) else _RECIPE.fullmatch(name)


def is_program(name: str) -> bool:
    """Whether the name is a reference to another program."""
    return name.startswith((EXTERNAL, NERFBASELINES))


def reference_file(name: str) -> Path | None:
    """Return the file that a reference names; None if it names none, or a description of the package."""
    if name.startswith(EXTERNAL):
        path = Path(name.removeprefix(EXTERNAL))
        # a program that lies here may be called like a description of the package: ./NAME is a file
        ours = (Path(__file__).parent / "descriptions" / f"{path}.yaml").is_file()
        return path if "/" in name or path.suffix or (path.is_file() and not ours) else None
    match = None if name.startswith((NERFBASELINES, MASKS)) else _recipe_match(name)
    return Path(match["path"]) if match else None


def replace_reference_file(name: str, path: Path) -> str:
    """Return the reference with another path of its file."""
    if name.startswith(EXTERNAL):
        return f"{EXTERNAL}{path}"
    return f"{path}:{name.rpartition(':')[2]}"


def absolute_reference(name: str) -> str:
    """Return the reference with an absolute path."""
    if name.startswith(MASKS):
        return f"{MASKS}{Path(name.removeprefix(MASKS)).resolve()}"
    path = reference_file(name)
    return name if path is None else replace_reference_file(name, path.resolve())


def read_reference(name: str, *, given_as: str = "") -> MethodEntry:
    """Return the method of a reference; `registry.load_reference` also registers it.

    Args:
        name: the reference.
        given_as: the reference that was typed, if `name` refers to a copy of that file.

    Raises:
        AwError: no such file, or no recipe in it.
    """
    if name.startswith(EXTERNAL):
        from ambiguous_wild.methods.external import load_description, packaged

        entry = load_description(reference_file(name) or packaged(name.removeprefix(EXTERNAL)))
    elif name.startswith(NERFBASELINES):
        from ambiguous_wild.methods.nerfbaselines_methods import nerfbaselines_entry

        entry = nerfbaselines_entry(name.removeprefix(NERFBASELINES))
    elif name.startswith(MASKS):
        entry = _folder(Path(name.removeprefix(MASKS)))
    else:
        entry = _recipe(name)
    return dataclasses.replace(entry, given_as=absolute_reference(given_as or name))


def _folder(folder: Path) -> MethodEntry:
    """Return 3DGS with the masks in a folder, under the folder's name; changed masks are another method."""
    if not folder.is_dir():
        raise AwError(f"no folder of masks {folder}: give one with a mask for each train photo")
    if bad := [sign for sign in ",=@" if sign in str(folder.resolve())]:
        raise AwError(f"the path of the masks {folder.resolve()} holds {bad[0]!r}: rename that folder")
    files = sorted(mask_files(folder))
    if not files:
        raise AwError(f"{folder} holds no masks: {SPELLINGS}")
    digest = config_hash([[path.relative_to(folder).as_posix(), sha256_file(path)] for path in files])
    name = check_name("name of a folder of masks", folder.resolve().name)
    recipe = functools.partial(_build_folder, folder.resolve())
    return MethodEntry(name, f"3dgs with the masks in {folder.name}/", recipe, source_hash=digest)


def _build_folder(folder: Path) -> MethodHooks:
    from ambiguous_wild.methods.folder_masks import build

    return build(folder)


def _recipe(name: str) -> MethodEntry:
    """Return a MethodEntry of the file, or make one of a function that returns `MethodHooks`."""
    path_text, _, attribute = name.rpartition(":")
    path = Path(path_text)
    module, digest = import_file(path)
    target = getattr(module, attribute, None)
    if target is None:
        raise unknown(f"recipe in {path}", attribute, _recipes(module))
    if isinstance(target, MethodEntry):
        return dataclasses.replace(target, source_hash=digest)
    if not inspect.isfunction(target):
        raise AwError(
            f"{name} is a {type(target).__name__}: it must be a function that returns MethodHooks, or a "
            "MethodEntry"
        )
    summary = (inspect.getdoc(target) or f"{attribute} of {path.name}").splitlines()[0]
    entry = MethodEntry(check_name("method name", attribute), summary, target, source_hash=digest)
    if required(target) and entry.config is None:
        raise AwError(f"{name} must take nothing, or one argument whose type is a dataclass of options")
    return entry


def without_recipe(path: Path) -> AwError:
    """Return the error for a file without the name of a recipe; its message lists the names."""
    if not path.is_file():
        return AwError(f"no file {path}: write FILE.py:RECIPE, or a name of 'aw methods'")
    names = _recipes(import_file(path)[0])
    if not names:
        return AwError(f"{path} has no recipe: write a function that returns MethodHooks (docs/extend.md)")
    return AwError(
        f"{path} is a file: add the name of a recipe in it: {', '.join(f'{path}:{n}' for n in names)}"
    )


def _recipes(module: ModuleType) -> list[str]:
    """Return the names of entries and functions that the file defines; some may be helpers."""
    own = {
        key: value
        for key, value in vars(module).items()
        if isinstance(value, MethodEntry)
        or (inspect.isfunction(value) and value.__module__ == module.__name__ and not key.startswith("_"))
    }
    sure = [
        key
        for key, value in own.items()
        if "MethodHooks" in str(getattr(value, "__annotations__", {}).get("return"))
    ]
    return sure or list(own)
