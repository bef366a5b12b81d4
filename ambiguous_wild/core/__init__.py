"""Cameras, scenes, errors and configs, which all packages use. numpy only."""

import importlib
from typing import TYPE_CHECKING, Any

# imported when they are asked for: a command that needs an error alone loads no numpy
_MODULES = {"AwError": "errors", "Camera": "camera", "UNMOVED": "scene"}
_MODULES |= dict.fromkeys(("Scene", "SceneTransform", "SparsePoints", "View"), "scene")

if TYPE_CHECKING:
    from ambiguous_wild.core.camera import Camera as Camera
    from ambiguous_wild.core.errors import AwError as AwError
    from ambiguous_wild.core.scene import UNMOVED as UNMOVED
    from ambiguous_wild.core.scene import Scene as Scene
    from ambiguous_wild.core.scene import SceneTransform as SceneTransform
    from ambiguous_wild.core.scene import SparsePoints as SparsePoints
    from ambiguous_wild.core.scene import View as View


def __getattr__(name: str) -> Any:
    if name in _MODULES:
        return getattr(importlib.import_module(f"ambiguous_wild.core.{_MODULES[name]}"), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
