"""Cameras, scenes, errors and configs, which all packages use. numpy only."""

from ambiguous_wild.core.camera import Camera
from ambiguous_wild.core.errors import AwError
from ambiguous_wild.core.scene import UNMOVED, Place, Points, Scene, View

__all__ = ["UNMOVED", "AwError", "Camera", "Place", "Points", "Scene", "View"]
