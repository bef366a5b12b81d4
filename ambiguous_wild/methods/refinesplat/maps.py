"""A stack of maps of all views, to sample at positions in the frames of other views."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor


def sized(array: np.ndarray, device: torch.device | str) -> Tensor:
    """Copy an array to the device as float32."""
    return torch.from_numpy(np.ascontiguousarray(array, dtype=np.float32)).to(device)


class MapStack:
    """Maps [views, channels, h, w] float32; smaller maps lie at the upper left, the rest is padding."""

    def __init__(self, maps: Sequence[np.ndarray], device: torch.device | str, pad: str = "zero") -> None:
        """
        Args:
            maps: map of each view, [channels, h, w].
            device: device of the stack.
            pad: padding of smaller maps: `zero`, or their own `edge`.
        """
        self.edge = pad == "edge"
        self.sizes = [m.shape[1:] for m in maps]
        h, w = (max(size[axis] for size in self.sizes) for axis in (0, 1))
        self.stack = torch.zeros((len(maps), maps[0].shape[0], h, w), device=device)
        # share of the stack's size that each view's map covers; None: all of it
        self.shares: Tensor | None = None
        if len(set(self.sizes)) > 1:
            shares = np.array([[size[1] / w, size[0] / h] for size in self.sizes])
            self.shares = sized(shares[:, None, None], device)
        for view, m in enumerate(maps):
            for channel, plane in enumerate(m):
                if plane.any():
                    self.put(view, sized(plane, device), channel)

    def put(self, view: int, plane: Tensor, channel: int = 0) -> None:
        """Set one channel [h, w] of a view's map."""
        h, w = self.sizes[view]
        target = self.stack[view, channel]
        if self.edge and target.shape != plane.shape:
            beyond = (0, target.shape[1] - w, 0, target.shape[0] - h)
            plane = F.pad(plane[None, None], beyond, mode="replicate")[0, 0]
            h, w = target.shape
        target[:h, :w].copy_(plane)

    def of(self, view: int) -> Tensor:
        """Return a view's map [channels, h, w] without padding."""
        h, w = self.sizes[view]
        return self.stack[view, :, :h, :w]

    def select(self, views: Tensor) -> Selected:
        """Copy the maps of views [n] int64."""
        shares = None if self.shares is None else self.shares.index_select(0, views)
        return Selected(self.stack.index_select(0, views), shares)


@dataclass(frozen=True)
class Selected:
    """Maps of n views, to read at places [n, rows, columns, 2], x and y from -1 to 1 (`grid_sample`)."""

    maps: Tensor  # [n, channels, h, w]
    shares: Tensor | None  # [n, 1, 1, 2], see `MapStack`

    def nearest(self, places: Tensor) -> Tensor:
        """Read the nearest pixels [n, channels, rows, columns]; 0 outside (cv2.INTER_NEAREST)."""
        return self._read(places, "nearest", "zeros")

    def linear(self, places: Tensor) -> Tensor:
        """Read bilinearly, with the border replicated (cv2.INTER_LINEAR, cv2.BORDER_REPLICATE)."""
        return self._read(places, "bilinear", "border")

    def _read(self, places: Tensor, mode: str, outside: str) -> Tensor:
        if self.shares is not None:
            places = (places + 1.0) * self.shares - 1.0
        return F.grid_sample(self.maps, places, mode=mode, padding_mode=outside, align_corners=False)
