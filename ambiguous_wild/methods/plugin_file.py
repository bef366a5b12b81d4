"""A Python file of the user's, loaded as a module: plugins and recipes in files."""

from __future__ import annotations

import importlib.util
import sys
import traceback
from pathlib import Path
from types import ModuleType

from ambiguous_wild.core.errors import AwError

_loaded: set[str] = set()  # paths as tracebacks have them


def import_file(path: Path) -> ModuleType:
    """The module of a Python file, run anew.

    Raises:
        AwError: no such file, no Python file, or it fails when it is loaded; names the line.
    """
    if not path.is_file():
        raise AwError(f"no plugin file {path}: give the path of a .py file")
    name = f"aw_plugin_{path.stem}"
    spec = importlib.util.spec_from_file_location(name, path)
    if spec is None or spec.loader is None:
        raise AwError(f"plugin {path} is no Python file: its name must end in .py")
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module
    _loaded.add(str(spec.origin))
    try:
        spec.loader.exec_module(module)
    except AwError:
        raise
    except SyntaxError as error:
        raise AwError(f"plugin {path}, line {error.lineno}: {error.msg}") from None
    except (Exception, SystemExit) as error:
        why = f"{type(error).__name__}: {error}{place_of(error)}"
        raise AwError(f"plugin {path} fails when it is loaded: {why}") from error
    return module


def place_of(error: BaseException) -> str:
    """Such as " (my_method.py, line 7)": where the error last was in a loaded file; empty if in none."""
    frames = [f for f in traceback.extract_tb(error.__traceback__) if f.filename in _loaded]
    return f" ({Path(frames[-1].filename).name}, line {frames[-1].lineno})" if frames else ""
