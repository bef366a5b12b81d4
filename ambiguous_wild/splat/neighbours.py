"""How far a point's three nearest neighbours are: scipy's tree, or torch where there is none."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from ambiguous_wild.splat import device as devices

BOX = 256  # points that are compared at a time
FIRST = 8  # boxes that are looked at first, the nearest; in space most points need no more


def nearest_three(
    xyz: np.ndarray,  # [M, 3], M of 4 or more
    device: torch.device | str = "cpu",
) -> np.ndarray:  # [M, 3] float64, rising
    """Distances to the three nearest other points.

    Both ways are exact and in float64; they differ in the last bits. On an accelerator, and where scipy is
    not installed, torch looks.
    """
    if not devices.accelerated(device):
        try:
            from scipy.spatial import cKDTree
        except ImportError:
            pass
        else:
            return cKDTree(xyz).query(xyz, k=4)[0][:, 1:]
    points = torch.from_numpy(np.ascontiguousarray(xyz, dtype=np.float64)).to(device)
    return nearest_three_torch(points).cpu().numpy()


def nearest_three_torch(
    points: Tensor,  # [M, 3] float64
) -> Tensor:  # [M, 3] float64, rising
    """The same in torch: points in boxes of `BOX`, each box compared with those that can hold a neighbour."""
    boxes = _boxes(points)
    low = torch.stack([points[rows].amin(0) for rows in boxes])
    high = torch.stack([points[rows].amax(0) for rows in boxes])
    found = torch.empty_like(points)
    for box, rows in enumerate(boxes):
        # No point of a box is nearer to any of these than the two boxes are to each other.
        gaps = torch.maximum(low - high[box], low[box] - high).clamp_(min=0).norm(dim=1)
        gaps[box] = -1.0  # itself is first, also among boxes that touch it
        gaps, order = gaps.sort()
        first = torch.cat([boxes[k] for k in order[:FIRST].tolist()])
        nearest = _nearest(points, rows, first)
        if len(order) > FIRST:
            far = nearest[:, 2] > gaps[FIRST]
            if bool(far.any()):
                within = int((gaps <= nearest[far, 2].max()).sum())
                every = torch.cat([boxes[k] for k in order[:within].tolist()])
                nearest[far] = _nearest(points, rows[far], every)
        found[rows] = nearest
    return found


def _boxes(points: Tensor) -> list[Tensor]:
    """Rows in groups of `BOX` or fewer: halved along their longest side until they are."""
    waiting, done = [torch.arange(len(points), device=points.device)], []
    while waiting:
        rows = waiting.pop()
        if len(rows) <= BOX:
            done.append(rows)
            continue
        inside = points[rows]
        rows = rows[inside[:, int((inside.amax(0) - inside.amin(0)).argmax())].argsort()]
        waiting += [rows[: len(rows) // 2], rows[len(rows) // 2 :]]
    return done


def _nearest(points: Tensor, rows: Tensor, others: Tensor) -> Tensor:
    """[len(rows), 3] distances to the nearest of the others, itself left out."""
    squares = torch.zeros(len(rows), len(others), dtype=points.dtype, device=points.device)
    for axis in range(3):
        # Differences, not a product of matrices: that would cancel where points are close.
        squares += (points[rows, None, axis] - points[None, others, axis]).square_()
    squares[rows[:, None] == others[None]] = torch.inf
    return squares.topk(3, dim=1, largest=False, sorted=True).values.sqrt()
