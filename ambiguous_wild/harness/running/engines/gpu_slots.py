"""Which GPU each of several processes sees."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence

VISIBLE = "CUDA_VISIBLE_DEVICES"


def visible_gpus(
    count: int,  # GPUs that torch sees in this process
    environment: Mapping[str, str] | None = None,
) -> list[str]:
    """The GPUs of this process by the names that CUDA_VISIBLE_DEVICES of a child needs.

    Where that variable is set here, its own entries: numbers of the machine's GPUs, UUIDs (``GPU-...``) or
    MIG instances. A child that got 0 to `count` - 1 instead would leave what this process was given. Entries
    after an invalid one do not count, as for CUDA; torch's count says how many that leaves.
    """
    given = (os.environ if environment is None else environment).get(VISIBLE)
    names = [str(i) for i in range(count)] if given is None else [name.strip() for name in given.split(",")]
    return names[:count]


def slot_environment(slot: int, gpus: Sequence[str]) -> dict[str, str]:
    """Variables that give the process of a slot its GPU, in turns; empty without GPUs."""
    return {VISIBLE: gpus[slot % len(gpus)]} if gpus else {}


def sharing(jobs: int, gpus: Sequence[str]) -> str:
    """A warning where several processes share one GPU; empty where each has its own."""
    if not gpus or jobs <= len(gpus):
        return ""
    have = "1 GPU" if len(gpus) == 1 else f"{len(gpus)} GPUs"
    return f"{jobs} cells at a time share {have}, memory and time; --jobs {len(gpus)} gives each its own"
