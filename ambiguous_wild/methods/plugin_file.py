"""A Python file of the user's, loaded as a module: plugins and recipes in files."""

from __future__ import annotations

import importlib.util
import sys
import traceback
from pathlib import Path
from types import ModuleType

from ambiguous_wild.core.errors import AwError


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
