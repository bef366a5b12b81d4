"""Tile lists without a wait: their length is that of the camera's last visit, with a margin.

gsplat counts the intersections of splats and tiles, and the host waits for the count to allocate the lists.
Here the lists have a given capacity and torch fills them: row by row of the cumulative counts, sorted by tile
and depth as gsplat sorts. What is left of the capacity goes to a row of tiles below the picture, which no
pixel reads (gsplat's blocks there end at once). If there are more intersections than the capacity the picture
is not whole: the step is called off, and the next visit has the room.

The host learns the counts an epoch later, by a copy that was sent without waiting.
"""

from __future__ import annotations

import math
from collections import OrderedDict
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

TILE = 16  # px
MARGIN = 1.5  # of the last visit's count, times the growth of the model since
STEP = 2**15  # capacities are multiples, so that memory is reused
_REMEMBERED = 8192  # cameras


@dataclass(frozen=True)
class Listed:
    """Tile lists of a fixed length."""

    offsets: Tensor  # [1, rows + 1, columns] int32; the last row is below the picture
    flatten_ids: Tensor  # [capacity] int32
    count: Tensor  # 0-d int64, intersections there are
    over: Tensor  # [1] float32, 1 = more than the capacity


@torch.no_grad()
def list_within(
    means2d: Tensor,  # [N, 2] px
    radii: Tensor,  # [N, 2] int32 px, 0 where culled
    depths: Tensor,  # [N], above 0 where not culled
    width: int,
    height: int,
    capacity: int,
) -> Listed:
    """Tiles and order of N splats, N at least 1; nothing is read on the host."""
    columns, rows = math.ceil(width / TILE), math.ceil(height / TILE)
    device = means2d.device
    centre, reach = means2d / TILE, radii / TILE
    low = torch.stack(
        [(centre - reach)[:, k].floor().clamp(0, most) for k, most in enumerate((columns, rows))], 1
    ).long()
    high = torch.stack(
        [(centre + reach)[:, k].ceil().clamp(0, most) for k, most in enumerate((columns, rows))], 1
    ).long()
    span = torch.where((radii > 0).all(1, keepdim=True), high - low, 0)
    each = span[:, 0] * span[:, 1]
    ends = each.cumsum(0)
    count = ends[-1]
    place = torch.arange(capacity, device=device)
    row = torch.searchsorted(ends, place, right=True).clamp_(max=len(ends) - 1)
    inner = place - (ends - each)[row]
    across = span[row, 0].clamp(min=1)
    tile = (low[row, 1] + inner // across) * columns + low[row, 0] + inner % across
    tile = torch.where(place < count, tile, rows * columns + place % columns)
    # bits of a positive float rise with it
    bits = depths.contiguous().view(torch.int32).long()
    keys, order = torch.sort((tile << 32) | bits[row].clamp(min=0), stable=True)
    borders = torch.arange((rows + 1) * columns, device=device) << 32
    offsets = torch.searchsorted(keys, borders).to(torch.int32)
    return Listed(
        offsets.view(1, rows + 1, columns),
        row[order].to(torch.int32),
        count,
        (count > capacity).to(torch.float32).reshape(1),
    )


@dataclass
class _Visit:
    gaussians: int
    count: Tensor | int  # on the host
    sent: Any  # event after which `count` holds, or None
    camera: Any  # kept, so that its id stays its own


class Visits:
    """How many intersections every camera had when it was last drawn."""

    def __init__(self) -> None:
        self._of: OrderedDict[int, _Visit] = OrderedDict()

    def capacity(self, camera: Any, gaussians: int) -> int | None:
        """For a picture of that many Gaussians; None = not known, the host has to wait."""
        visit = self._of.get(id(_fixed(camera)))
        if visit is None or (visit.sent is not None and not visit.sent.query()):
            return None
        grown = max(gaussians / max(visit.gaussians, 1), 1.0)
        return STEP * math.ceil(max(MARGIN * grown * int(visit.count), 1.0) / STEP)

    def note(self, camera: Any, gaussians: int, count: Tensor | int) -> None:
        """Remember the count of a picture; one that lies on a GPU is copied without a wait."""
        camera, sent = _fixed(camera), None
        if isinstance(count, Tensor):
            if count.device.type == "cuda":
                host = torch.empty((), dtype=count.dtype, pin_memory=True)
                host.copy_(count, non_blocking=True)
                sent = torch.cuda.Event()
                sent.record()
                count = host
            else:
                count = count.clone()
        self._of[id(camera)] = _Visit(gaussians, count, sent, camera)
        self._of.move_to_end(id(camera))
        while len(self._of) > _REMEMBERED:
            self._of.popitem(last=False)


def _fixed(camera: Any) -> Any:
    """The camera that stays the same object: of a refined pose the one that it began with."""
    return getattr(camera, "base", camera)
