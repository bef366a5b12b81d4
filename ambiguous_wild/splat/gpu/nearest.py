"""Exact nearest neighbours of many points on a device, without a tree on the host."""

from __future__ import annotations

import torch
from torch import Tensor

BOX = 128  # points a box
FIRST = 8  # boxes that are looked at first, the nearest ones
_AT_A_TIME = 2**25  # distances in memory


@torch.no_grad()
def nearest(points: Tensor, count: int) -> Tensor:
    """Rows of the nearest points of every point, itself among them, the nearest first.

    Points are halved along their longest side into boxes of `BOX`; each box is compared with the boxes
    nearest to it, and with more of them as long as another could hold a nearer point. Ties are in no order.

    Args:
        points: [M, 3] float, finite.
        count: neighbours, at most M.

    Returns:
        [M, count] int64.
    """
    rows = _boxes(points)  # [S, L], M = none
    ends = torch.cat([points, points.new_full((1, 3), torch.inf)])
    inside = ends[rows]
    there = rows < len(points)
    low = inside.amin(1)
    high = torch.where(there[..., None], inside, -torch.inf).amax(1)
    found = rows.new_empty((len(points) + 1, count))
    todo, looked = torch.arange(len(rows), device=points.device), min(FIRST, len(rows))
    while len(todo):
        again = []
        for part in todo.split(max(_AT_A_TIME // (looked * rows.shape[1] ** 2), 1)):
            gaps = torch.maximum(low[None] - high[part, None], low[part, None] - high[None])
            gaps = gaps.clamp(min=0).square().sum(2)
            gaps[torch.arange(len(part), device=part.device), part] = -1.0  # itself is first
            more = min(looked + 1, len(rows))
            distance, order = gaps.topk(more, dim=1, largest=False)
            others = rows[order[:, :looked]].flatten(1)  # [P, looked * L]
            squares = _squares(inside[part], ends[others])
            near = squares.topk(min(count, squares.shape[2]), dim=2, largest=False)
            chosen = others[:, None].expand(-1, rows.shape[1], -1).gather(2, near.indices)
            short = near.values[..., -1]
            enough = chosen.shape[2] == count
            if more == looked:
                far = torch.zeros(len(part), dtype=torch.bool, device=part.device)
            elif not enough:
                far = torch.ones(len(part), dtype=torch.bool, device=part.device)
            else:
                far = (there[part] & ~(short <= distance[:, looked, None])).any(1)
            if enough:
                found[rows[part].flatten()] = chosen.flatten(0, 1)
            again.append(part[far])
        todo, looked = torch.cat(again), min(2 * looked, len(rows))
    return found[: len(points)]


def _squares(points: Tensor, others: Tensor) -> Tensor:
    """[P, L, K] squared distances; by differences: a product of matrices cancels where points are close."""
    squares = points.new_zeros(*points.shape[:2], others.shape[1])
    for axis in range(3):
        squares += (points[:, :, None, axis] - others[:, None, :, axis]).square_()
    return squares


def _boxes(points: Tensor) -> Tensor:
    """[S, L] rows of the points in boxes, S a power of 2; M where there is none."""
    boxes = 1
    while boxes * BOX < len(points):
        boxes *= 2
    size = -(-len(points) // boxes)
    rows = torch.arange(boxes * size, device=points.device).clamp_(max=len(points))[None]
    ends = torch.cat([points, points.new_full((1, 3), torch.inf)])
    while len(rows) < boxes:
        inside = ends[rows]  # [s, l, 3]
        extent = torch.where(inside.isinf(), -torch.inf, inside).amax(1) - inside.amin(1)
        axis = extent.nan_to_num(nan=-torch.inf).argmax(1)
        along = inside.gather(2, axis[:, None, None].expand(-1, rows.shape[1], 1))[..., 0]
        rows = rows.gather(1, along.argsort(1)).view(2 * len(rows), -1)
    return rows
