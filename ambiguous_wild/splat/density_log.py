"""What density control did and where: counts of every round, and a sample of positions for pictures."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import torch
from torch import Tensor

MOST = 20_000  # positions kept of a kind; more would tell a picture nothing and weigh on every checkpoint


@dataclass
class Places:
    """Positions [n, 3] in the world, evenly thinned to `MOST` at most; draws no random numbers."""

    xyz: Tensor = field(default_factory=lambda: torch.zeros(0, 3))
    stride: int = 1  # every so many-th position is kept
    passed: int = 0  # positions shown so far

    def add(self, xyz: Tensor) -> None:
        """Take in positions [n, 3] in their order."""
        first = -self.passed % self.stride
        self.passed += len(xyz)
        self.xyz = torch.cat([self.xyz, xyz.detach()[first :: self.stride].cpu()])
        while len(self.xyz) > MOST:
            self.xyz = self.xyz[::2].clone()
            self.stride *= 2


@dataclass
class Round:
    """One round of growth, in Gaussians."""

    iteration: int
    cloned: int = 0
    split: int = 0
    pruned: int = 0
    merged: int = 0  # that merging removed
    count: int = 0  # afterwards


@dataclass
class DensityLog:
    """Rounds in order, and where Gaussians came to be."""

    rounds: list[Round] = field(default_factory=list)
    added: Places = field(default_factory=Places)  # by cloning and splitting
    merged: Places = field(default_factory=Places)  # what merging put in the place of several

    def begin(self, iteration: int) -> None:
        """A round starts."""
        self.rounds.append(Round(iteration))

    @property
    def now(self) -> Round:
        """The round under way; one before the first where density is driven by hand."""
        if not self.rounds:
            self.begin(0)
        return self.rounds[-1]

    def grew(self, cloned: int, split: int, xyz: Tensor) -> None:
        """Growth made Gaussians at `xyz` [n, 3]."""
        self.now.cloned, self.now.split = cloned, split
        self.added.add(xyz)

    def merge(self, removed: int, xyz: Tensor) -> None:
        """Merging removed so many and left one at each of `xyz` [n, 3]."""
        self.now.merged += removed
        self.merged.add(xyz)

    def state_dict(self) -> dict[str, Any]:
        return {
            "rounds": [[r.iteration, r.cloned, r.split, r.pruned, r.merged, r.count] for r in self.rounds],
            **{
                name: {"xyz": places.xyz, "stride": places.stride, "passed": places.passed}
                for name, places in (("added", self.added), ("merged", self.merged))
            },
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        self.rounds = [Round(*row) for row in state["rounds"]]
        self.added, self.merged = Places(**state["added"]), Places(**state["merged"])
