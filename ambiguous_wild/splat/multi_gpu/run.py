"""One rank of a shared run from start to end; called in every process."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from ambiguous_wild.core import Camera
from ambiguous_wild.splat.multi_gpu import shards
from ambiguous_wild.splat.multi_gpu.launch import Tell
from ambiguous_wild.splat.multi_gpu.ranks import Ranks
from ambiguous_wild.splat.multi_gpu.trainer import SharedTrainer
from ambiguous_wild.splat.pace import TrainConfig
from ambiguous_wild.splat.parts import Parts
from ambiguous_wild.splat.step import TrainData
from ambiguous_wild.splat.trainer import Trainer

TOLD_EVERY_S = 0.5


@dataclass(frozen=True)
class Progress:
    """Progress of a shared run, sent by rank 0."""

    iteration: int  # photos
    gaussians: int  # of all ranks
    ms_per_iteration: float
    done: bool


def train_rank(
    ranks: Ranks,
    tell: Tell,
    data: TrainData,
    parts: Parts,
    config: TrainConfig,
    folder: Path,
    probe: Callable[[Callable[[Camera], Tensor]], float] | None = None,
) -> None:
    """Train this rank's share, or go on from the last shards; rank 0 writes the whole model for `take_over`.

    Args:
        ranks: that share the model; each calls this with the same arguments.
        tell: gets a `Progress` from rank 0 now and then.
        data, parts, config, folder, probe: as of `SharedTrainer`.

    Raises:
        AwError: something cannot be shared, or is not finite.
    """
    before = time.perf_counter()
    trainer = SharedTrainer(data, parts, config, folder=folder, ranks=ranks, probe=probe)
    trainer.setup_s = time.perf_counter() - before
    trainer.resume()
    trainer.train(tick=_Teller(tell) if ranks.rank == 0 else None)
    shards.write_whole(trainer, _facts(trainer))


def _facts(trainer: SharedTrainer) -> dict[str, Any]:
    """Of this rank: its Gaussians, and the peak memory of its GPU."""
    facts: dict[str, Any] = {"gaussians": len(trainer.gaussians)}
    if trainer.ranks.device.type == "cuda":
        facts["peak_cuda_mb"] = torch.cuda.max_memory_allocated(trainer.ranks.device) / 1e6
    return facts


class _Teller:
    """Sends progress now and then, not in every step."""

    def __init__(self, tell: Tell) -> None:
        self.tell, self.told = tell, 0.0

    def __call__(self, trainer: Trainer) -> None:
        assert isinstance(trainer, SharedTrainer)
        if trainer.done or time.monotonic() - self.told > TOLD_EVERY_S:
            self.told = time.monotonic()
            total = sum(trainer.counts)
            self.tell(Progress(trainer.iteration, total, trainer.ms_per_iteration, trainer.done))
