"""Maps of all views, sampled at positions in the frames of other views, and robust statistics over views.

No count is read on the host.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from ambiguous_wild.splat.backend import backend_of

FAR_MORE = 1.5  # ratio of agreeing pixels from which an offset is accepted
WHITE = 255.0  # colours are from 0 to 255


def to_device(array: np.ndarray, device: torch.device | str) -> Tensor:
    """Copy an array to the device as float32."""
    return torch.from_numpy(np.ascontiguousarray(array, dtype=np.float32)).to(device)


class EnlargedMaps:
    """Maps at the size of the photos that the host makes of small ones, each when it is read.

    On a GPU the large ones are kept, because to send one makes the host wait.
    """

    def __init__(
        self, enlarge: Callable[[int], np.ndarray | None], views: int, device: torch.device | str
    ) -> None:
        """
        Args:
            enlarge: makes the map of a view; None if it has none.
            views: number of views.
            device: where maps are read.
        """
        self._enlarge, self._device = enlarge, device
        self._kept: list[Tensor | None] = []
        if not backend_of(device).reads_at_once:
            self._kept = [self._made(view) for view in range(views)]

    def __getitem__(self, view: int) -> Tensor | None:
        return self._kept[view] if self._kept else self._made(view)

    def _made(self, view: int) -> Tensor | None:
        array = self._enlarge(view)
        return None if array is None else torch.from_numpy(array).to(self._device)


class MapStack:
    """Maps [views, channels, h, w], at first 0; smaller ones lie at the upper left, the rest is padding."""

    def __init__(
        self,
        sizes: Sequence[tuple[int, ...]],
        device: torch.device | str,
        *,
        channels: int = 1,
        dtype: torch.dtype = torch.float32,
        pad: str = "zero",
    ) -> None:
        """
        Args:
            sizes: (h, w) of each view's map.
            device: device of the stack.
            channels: channels of a map.
            dtype: type of the values.
            pad: padding of smaller maps: `zero`, or their own `edge`.
        """
        self.edge = pad == "edge"
        self.sizes = list(sizes)
        h, w = (max(size[axis] for size in self.sizes) for axis in (0, 1))
        self.stack = torch.zeros((len(self.sizes), channels, h, w), dtype=dtype, device=device)
        # share of the stack's size that each view's map covers; None: all of it
        self.shares: Tensor | None = None
        if len(set(self.sizes)) > 1:
            shares = np.array([[size[1] / w, size[0] / h] for size in self.sizes])
            self.shares = to_device(shares[:, None, None], device)

    def put(self, view: int, plane: Tensor, channel: int = 0) -> None:
        """Set one channel [h, w] float32 of a view's map."""
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

    def shares_of_views(self) -> np.ndarray:
        """Return the share of the stack's width and height that each map covers, [views, 2] float32."""
        if self.shares is None:
            return np.ones((len(self.sizes), 2), np.float32)
        return self.shares.cpu().numpy().reshape(-1, 2)

    def select(self, views: Tensor, *others: MapStack) -> SelectedMaps:
        """Copy the maps of views [n] int64, float32; channels of other stacks of the same sizes follow."""
        shares = None if self.shares is None else self.shares.index_select(0, views)
        maps = [stack.stack.index_select(0, views) for stack in (self, *others)]
        if not others:
            return SelectedMaps(maps[0], shares)
        n, _, h, w = maps[0].shape
        joined = torch.empty((n, sum(m.shape[1] for m in maps), h, w), device=maps[0].device)
        for part, m in zip(joined.split([m.shape[1] for m in maps], 1), maps):
            part.copy_(m)
        return SelectedMaps(joined, shares)


@dataclass(frozen=True)
class SelectedMaps:
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


def ascending(x: Tensor, dim: int = 0) -> Tensor:
    """Sort values along an axis in ascending order, NaN last."""
    if backend_of(x.device).kernels:
        # numpy's sort is 2 to 20 times as fast as torch's on one thread
        return torch.from_numpy(np.sort(x.numpy(), axis=dim))
    return x.sort(dim).values


def median(x: Tensor) -> Tensor:
    """Return the median over the last axis, ignoring NaN; NaN if all are NaN.

    Of an even number it is the mean of the middle two, as in numpy; torch returns the lower one.
    """
    last = (~x.isnan()).sum(-1, keepdim=True).sub_(1).clamp_(min=0)
    middle = torch.cat([last // 2, (last + 1) // 2], -1)
    return ascending(x, -1).gather(-1, middle).mean(-1)


def low_quantile(x: Tensor, left_out: Tensor, quantile: float) -> tuple[Tensor, Tensor]:
    """Return a quantile of the pixels of x [H, W] that are not left out, linear between ranks; 0 of none.

    Returns:
        The quantile, 0-d float64, and the number of pixels, 0-d int64.
    """
    ordered = ascending(x.masked_fill(left_out, torch.inf).flatten())
    count = x.numel() - left_out.sum()
    rank = (count.double() - 1.0).clamp_(min=0.0) * quantile
    low = rank.floor()
    below, above = ordered.double().gather(0, torch.stack([low, rank.ceil()]).long())
    # without a pixel both are infinite and their difference is NaN
    return (below + (rank - low) * (above - below)).nan_to_num_(nan=0.0), count


def spread_of(values: Tensor) -> tuple[Tensor, Tensor]:
    """Return the median and 1.4826 MAD of values [n], 0-d; NaN is ignored.

    The spread is at least 5 % of the median, so that equal values do not stand apart.
    """
    middle = median(values)
    deviation = 1.4826 * median((values - middle).abs_())
    return middle, torch.maximum(deviation, 0.05 * middle.abs()).clamp_(min=1e-12)


class ViewQuantile:
    """Quantiles over n views of which any number may be missing."""

    def __init__(self, views: int, quantile: float, device: torch.device | str) -> None:
        last = np.maximum(np.arange(views + 1) - 1, 0)
        low = np.floor(quantile * last)
        share = (quantile * last - low).astype(np.float32)
        pair = np.stack([low, np.minimum(low + 1, last)]).astype(np.int64)
        self.pair = torch.from_numpy(pair).to(device)  # [2, views + 1]
        self.share = torch.from_numpy(share).to(device)  # [views + 1]

    def quantile_of(self, stack: Tensor, present: Tensor) -> Tensor:
        """Return the quantile over the first axis, ignoring NaN, linear between ranks; NaN if all are.

        Args:
            stack: [n, ...] float32, n the number of views.
            present: [...] int64, number of values that are not NaN.

        Returns:
            [...] float32.
        """
        below, above = ascending(stack).gather(0, self.pair[:, present])
        return below + self.share[present] * (above - below)


def colours_agree(difference: Tensor, same: Tensor, most: float, offset: Tensor) -> Tensor:
    """Return where views show the same colour, [n, P] bool.

    Args:
        difference: [n, 3, P], differences of colours of n views, from 0 to 255.
        same: [n, P] bool, where they show the same surface.
        most: difference in [0, 1] up to which two colours are the same.
        offset: [n, 3], from `common_offset`.
    """
    apart = (difference - offset[:, :, None]).abs_().sum(1)
    return (apart < 3.0 * most * WHITE) & same


def common_offset(difference: Tensor, same: Tensor, most: float) -> Tensor:
    """Return the colour offsets between pictures of the same surfaces, [n, 3]; zeros if there is none.

    The median difference is an offset (exposure, weather) only if far more pixels agree once it is
    subtracted; behind a crowd it is chance.

    Args:
        difference: [n, 3, P], differences of their colours, from 0 to 255.
        same: [n, P] bool, where they show the same surface.
        most: difference in [0, 1] up to which two colours are the same.
    """
    some = torch.where(same[:, None], difference, torch.nan)
    common = median(some)
    apart = torch.stack([some, some - common[..., None]]).abs_().sum(2)  # [2, n, P]
    # comparisons with NaN are false: pixels of other surfaces, and views without any, do not agree
    as_they_are, shifted = (apart < 3.0 * most * WHITE).sum(2)
    return common.masked_fill((shifted <= FAR_MORE * as_they_are)[:, None], 0.0)


def agreement_weight(seen: Tensor, agreed: Tensor, enough: float, always: Tensor) -> Tensor:
    """Return the weight of the evidence of n views, in [0, 1].

    Args:
        seen: [P] int64, number of views that see the surface.
        agreed: [P] int64, number of views that see it in the same colour.
        enough: share of the seeing views that must agree for a weight of 1, above 0.
        always: [P] bool, pixels whose weight is 1 in any case.
    """
    share = agreed / seen.clamp(min=1)
    return (share / enough).clamp_(max=1.0).masked_fill_(always, 1.0)
