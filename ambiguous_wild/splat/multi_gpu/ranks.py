"""The processes that share one model: the rank of this one, and the small values that they exchange."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
import torch.distributed as dist
from torch import Tensor


@dataclass(frozen=True)
class Ranks:
    """This process among those of torch's default group. Every method is called by all of them at once."""

    rank: int  # from 0
    size: int
    device: torch.device

    def counts(self, own: int) -> list[int]:
        """The number that each has. The host waits."""
        mine = torch.tensor([own], dtype=torch.int64, device=self.device)
        found = [torch.empty_like(mine) for _ in range(self.size)]
        dist.all_gather(found, mine)
        return torch.cat(found).tolist()

    def sum(self, values: Tensor) -> Tensor:
        """Over all of them; in place."""
        dist.all_reduce(values)
        return values

    def largest(self, values: Tensor) -> Tensor:
        """Of all of them, element by element; in place."""
        dist.all_reduce(values, op=dist.ReduceOp.MAX)
        return values

    def first_says(self, answer: bool) -> bool:
        """The answer of rank 0; those of the others are ignored. The host waits."""
        said = torch.tensor([float(answer)], device=self.device)
        dist.broadcast(said, src=0)
        return bool(said.item())

    def everyone(self, value: Any) -> list[Any]:
        """The value of each, by rank: plain values. The host waits."""
        found: list[Any] = [None] * self.size
        dist.all_gather_object(found, value)
        return found

    def wait(self) -> None:
        """Until all are here."""
        dist.barrier()
