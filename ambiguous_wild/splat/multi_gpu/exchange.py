"""Rows of tensors between ranks, and their gradients back."""

from __future__ import annotations

from typing import Any

import torch
import torch.distributed as dist
from torch import Tensor

from ambiguous_wild.splat.gaussians import Gaussians
from ambiguous_wild.splat.multi_gpu.ranks import Ranks


class _Exchange(torch.autograd.Function):
    """Backwards the rows go where they came from."""

    @staticmethod
    def forward(ctx: Any, rows: Tensor, sends: list[int], receives: list[int]) -> Tensor:
        ctx.sends, ctx.receives = sends, receives
        return _all_to_all(rows, sends, receives)

    @staticmethod
    def backward(ctx: Any, d_rows: Tensor) -> tuple[Tensor, None, None]:
        return _all_to_all(d_rows, ctx.receives, ctx.sends), None, None


def exchange(
    rows: Tensor,  # [sum(sends), ...], those for rank 0 first
    sends: list[int],  # rows for each rank
    receives: list[int],  # rows from each rank
) -> Tensor:  # [sum(receives), ...], those from rank 0 first
    """Called by all ranks at once; differentiable, and then the backward pass is called by all at once too.

    The numbers of rows are known beforehand, so with NCCL no host waits.
    """
    return _Exchange.apply(rows, sends, receives)


def gather(
    gaussians: Gaussians,
    ranks: Ranks,
    counts: list[int],  # Gaussians of each rank
    device: torch.device | str | None = None,
) -> Gaussians | None:
    """All Gaussians on rank 0, by rank; None on the others.

    Args:
        gaussians: this rank's.
        ranks: that call this at once.
        counts: Gaussians of each rank.
        device: where they lie there, tensor after tensor; None = on its GPU.
    """
    first = ranks.rank == 0
    sends = [len(gaussians), *[0] * (ranks.size - 1)]
    receives = counts if first else [0] * ranks.size
    found: dict[str, Any] = {}
    for name, tensor in gaussians.rows():
        whole = _all_to_all(tensor.detach(), sends, receives)
        found[name] = whole if device is None else whole.to(device)
    if not first:
        return None
    extra = {name: found.pop(name) for name in gaussians.extra}
    return Gaussians(**found, extra=extra)


def _all_to_all(rows: Tensor, sends: list[int], receives: list[int]) -> Tensor:
    found = rows.new_empty((sum(receives), *rows.shape[1:]))
    dist.all_to_all_single(found, rows.contiguous(), receives, sends)
    return found
