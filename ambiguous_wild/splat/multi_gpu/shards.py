"""Checkpoints of a shared run: a shard a rank, all of one iteration; the whole model at the end."""

from __future__ import annotations

import json
import os
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from safetensors import SafetensorError, safe_open

from ambiguous_wild.core import AwError
from ambiguous_wild.splat import checkpoint
from ambiguous_wild.splat.clock import clock_for
from ambiguous_wild.splat.density_log import DensityLog, Places, Round
from ambiguous_wild.splat.gaussians import Gaussians

WHOLE = "whole.safetensors"
_ANEW = "start anew with --overwrite always"


def shard_path(folder: Path, rank: int, size: int, which: str = "last") -> Path:
    """`checkpoint/last-rank1of4.safetensors` of rank 0; "next" is one that not all have yet."""
    return folder / "checkpoint" / f"{which}-rank{rank + 1}of{size}.safetensors"


def save(trainer: Any) -> None:
    """Write the shard of every rank.

    It becomes the last one when all ranks have written theirs: whenever the run is killed, there is an
    iteration of which every rank has a shard.
    """
    rank, size = trainer.ranks.rank, trainer.ranks.size
    coming = shard_path(trainer.folder, rank, size, "next")
    checkpoint.save(coming, trainer.state())
    trainer.ranks.wait()
    os.replace(coming, shard_path(trainer.folder, rank, size))


def restore(trainer: Any) -> bool:
    """Go on from the newest iteration of which all ranks have a shard; False if no rank has any.

    Raises:
        AwError: there is none, or the shards are of another number of GPUs; the same on all ranks.
    """
    rank, size = trainer.ranks.rank, trainer.ranks.size
    refuse_other_number(trainer.folder, size)
    last, coming = (shard_path(trainer.folder, rank, size, which) for which in ("last", "next"))
    mine = {_iteration(path): path for path in (coming, last) if path.exists()}
    iteration = newest_common(trainer.ranks.everyone(sorted(mine)), trainer.folder)
    if iteration is None:
        return False
    path = mine[iteration]
    trainer.load_state(checkpoint.load(path))
    if path == coming:
        os.replace(coming, last)
    coming.unlink(missing_ok=True)  # of a moment that others do not have
    return True


def newest_common(iterations: Sequence[Sequence[int]], folder: Path) -> int | None:
    """The last iteration of which every rank has a shard; None where no rank has any.

    Args:
        iterations: of the shards that each rank found.
        folder: of the run, for the message.

    Raises:
        AwError: ranks have shards, but not of one iteration.
    """
    if not any(iterations):
        return None
    common = set(iterations[0]).intersection(*iterations[1:])
    if not common:
        found = "; ".join(
            f"rank {rank + 1}: {', '.join(map(str, own)) or 'none'}" for rank, own in enumerate(iterations)
        )
        raise AwError(f"the checkpoints in {folder} are not of one iteration ({found}): {_ANEW}")
    return max(common)


def refuse_other_number(folder: Path, size: int) -> None:
    """Raise AwError if the folder holds a checkpoint of another number of GPUs."""
    others = set()
    for path in (folder / "checkpoint").glob("*.safetensors"):
        match = re.fullmatch(r"(?:last|next)-rank\d+of(\d+)\.safetensors", path.name)
        if match or path.name == "last.safetensors":
            others.add(int(match[1]) if match else 1)
    others.discard(size)
    if others:
        was = "1 GPU" if others == {1} else f"{max(others)} GPUs"
        how = "without --gpus" if others == {1} else f"with --gpus {max(others)}"
        raise AwError(f"{folder} holds a run on {was}, not on {size}: go on with it {how}, or {_ANEW}")


def _iteration(path: Path) -> int:
    try:
        with safe_open(str(path), framework="pt", device="cpu") as file:
            return int(json.loads((file.metadata() or {})["plain"])["iteration"])
    except (SafetensorError, OSError, KeyError, ValueError) as error:
        raise AwError(f"cannot read checkpoint {path}: {error}; {_ANEW}") from None


def write_whole(trainer: Any, facts: dict[str, Any]) -> None:
    """Rank 0 writes the whole model, and the state that a trainer on one GPU has at the end of a run.

    Args:
        trainer: of this rank; all ranks call this at once.
        facts: of this rank, plain values; `take_over` gives back those of all.
    """
    whole = trainer.gather("cpu")
    told = trainer.ranks.everyone((facts, sorted(trainer.skipped), trainer.density.log.state_dict()))
    if whole is None:
        return
    state = {
        "iteration": trainer.iteration,
        "elapsed_s": trainer.clock.now(),
        "setup_s": trainer.setup_s,
        "parts_s": trainer.clock.parts_s,
        "gaussians": dict(whole.items()),
        **({"extra": dict(whole.extra)} if whole.extra else {}),
        "timeline": trainer.timeline.rows,
        "skipped": sorted({view for _, views, _ in told for view in views}),
        "log": merged_log([log for _, _, log in told]).state_dict(),
        "facts": [own for own, _, _ in told],
    }
    checkpoint.save(trainer.folder / "checkpoint" / WHOLE, state)


def take_over(trainer: Any, folder: Path) -> list[dict[str, Any]]:
    """Make a trainer on one GPU what it would be had it trained the whole model; returns each rank's facts.

    For what follows training: pictures, measures, masks. It cannot train on: the moments stay in the shards.
    """
    state = checkpoint.load(folder / "checkpoint" / WHOLE)
    whole = Gaussians(**state["gaussians"], extra=state.get("extra", {}))
    trainer.gaussians = whole.to(trainer.data.device)
    trainer.iteration, trainer.setup_s = state["iteration"], state["setup_s"]
    trainer.clock = clock_for(trainer.data.device, state["elapsed_s"], dict(state["parts_s"]))
    trainer.timeline.rows = list(state["timeline"])
    trainer.density.log.load_state_dict(state["log"])
    trainer._skipped = set(state["skipped"])
    return list(state["facts"])


def merged_log(logs: Sequence[dict[str, Any]]) -> DensityLog:
    """Rounds added up, places of all ranks; rounds are the same on all, so they match one by one."""
    whole = DensityLog()
    for rounds in zip(*(log["rounds"] for log in logs), strict=True):
        whole.rounds.append(Round(rounds[0][0], *map(sum, zip(*(row[1:] for row in rounds), strict=True))))
    for name in ("added", "merged"):
        places: Places = getattr(whole, name)
        for log in logs:
            places.add(log[name]["xyz"])
    return whole
