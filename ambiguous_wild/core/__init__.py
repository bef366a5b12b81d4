"""The vocabulary everything else speaks: cameras, scenes, errors, configs. numpy only."""

from ambiguous_wild.core.camera import Camera
from ambiguous_wild.core.errors import AwError
from ambiguous_wild.core.scene import Points, Scene, View

__all__ = ["AwError", "Camera", "Points", "Scene", "View"]
