"""A cell of the grid: one method on one scene with one seed; and the report of its run."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

from ambiguous_wild import __version__
from ambiguous_wild.core import Scene
from ambiguous_wild.core.config import to_plain
from ambiguous_wild.harness.running.choosing import Chosen
from ambiguous_wild.harness.running.identity import config_identity
from ambiguous_wild.harness.running.records import RunConfig, RunResult, UnusualConfig
from ambiguous_wild.methods.registry import MethodEntry
from ambiguous_wild.splat.pace import TrainConfig

Overwrite = Literal["never", "missing", "always"]
Protocol = Literal["full", "half"]
Outcome = Literal["trained", "kept", "skipped", "failed"]


@dataclass(frozen=True)
class Cell:
    """One run to be made. Two cells of the same identity give the same result on the same machine."""

    method: MethodEntry
    options: Any  # the method's frozen dataclass
    scene: Scene
    scene_id: str  # sha256 of what the scene was built from, see `scene_identity`
    train: TrainConfig
    device: str = "cpu"
    chosen: Chosen = field(default_factory=Chosen)  # optional effects, and why
    protocol: Protocol = "full"  # "half": measured on the right half, colour effects fitted on the left
    group: str = ""  # folder below the output, where one output takes several lengths or effects

    @property
    def config(self) -> RunConfig:
        """The resolved configuration, as written to config.yaml."""
        # Keys at their usual value are left out: runs from before these keys existed keep their identity.
        unusual: UnusualConfig = {}
        if self.chosen.effects:
            unusual["effects"] = list(self.chosen.effects)
        if self.protocol != "full":
            unusual["protocol"] = self.protocol
        return {
            **unusual,
            "method": self.method.name,
            "source": self.method.source_hash,
            "options": to_plain(self.options),
            "train": to_plain(self.train),
            "scene": {
                "name": self.scene.name,
                "sha256": self.scene_id,
                "factor": self.scene.info.get("loaded_factor"),
                "path": str(self.scene.root.resolve()),
            },
            "device": self.device,
            "version": __version__,
        }

    @property
    def identity(self) -> str:
        """Hash of all settings that decide the result; how often it is saved and where the scene lies do not.

        `on_nonfinite` is left out too: without such a value it does nothing, and with one the facts of the
        result say so.
        """
        return config_identity(self.config)


@dataclass
class CellReport:
    """What became of a cell's run."""

    folder: Path
    outcome: Outcome
    error: str = ""
    result: RunResult | None = None  # of a run that was trained now
