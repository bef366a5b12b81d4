"""Train photos and their cameras at every resolution that the schedule asks for."""

from __future__ import annotations

from collections.abc import Iterable

from torch import Tensor

from ambiguous_wild.core import Camera
from ambiguous_wild.splat.data import shrink, shrink_camera
from ambiguous_wild.splat.step import TrainData


class Pyramid:
    """Smaller photos are made when they are first asked for."""

    def __init__(self, data: TrainData) -> None:
        self._data = data
        self._photos: dict[tuple[int, int], Tensor] = {}
        self._cameras: dict[tuple[int, int], Camera] = {}
        # where photos do not fit on the device: copies the next one there while a step runs
        self.prefetch = getattr(data.photos, "prefetch", None)

    def sizes(self, divisors: Iterable[int]) -> frozenset[tuple[int, int]]:
        """Heights and widths of all photos at these divisors."""
        full = {(camera.height, camera.width) for camera in self._data.cameras}
        return frozenset((h // d, w // d) for h, w in full for d in divisors)

    def photo(self, view: int, divisor: int) -> Tensor:
        """[H // divisor, W // divisor, 3] of a train photo."""
        if divisor == 1:
            return self._data.photos[view]
        if (
            self.prefetch is not None
        ):  # photos do not fit on the device: neither would smaller ones beside them
            return shrink(self._data.photos[view], divisor)
        if (view, divisor) not in self._photos:
            self._photos[view, divisor] = shrink(self._data.photos[view], divisor)
        return self._photos[view, divisor]

    def camera(self, view: int, divisor: int) -> Camera:
        """Its camera. Made once: what a back end keeps of a camera it finds again by the object."""
        if (view, divisor) not in self._cameras:
            self._cameras[view, divisor] = shrink_camera(self._data.cameras[view], divisor)
        return self._cameras[view, divisor]
