"""What one run is: a method, its options, a scene, a seed, a length; and what became of it."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

from ambiguous_wild import __version__
from ambiguous_wild.core import Scene
from ambiguous_wild.core.config import to_plain
from ambiguous_wild.harness.choosing import Chosen
from ambiguous_wild.harness.identity import config_identity
from ambiguous_wild.methods.registry import MethodEntry
from ambiguous_wild.splat.pace import TrainConfig

Overwrite = Literal["never", "missing", "always"]
Protocol = Literal["full", "half"]
Outcome = Literal["trained", "kept", "skipped", "failed"]


@dataclass(frozen=True)
class Cell:
    """What one run is: two cells with the same hash give the same result on the same machine."""

    method: MethodEntry
    options: Any  # the method's frozen dataclass
    scene: Scene
    scene_id: str  # sha256 of what the scene was built from, see `scene_identity`
    train: TrainConfig
    device: str = "cpu"
    chosen: Chosen = field(default_factory=Chosen)  # optional effects, and why
    protocol: Protocol = "full"  # "half": measured on the right half, colour effects fitted on the left
    gpus: int = 1  # that share the model; iterations count photos, on any number
    group: str = ""  # folder below the output, where one output takes several lengths or effects

    @property
    def config(self) -> dict[str, Any]:
        """The resolved configuration, as written to config.yaml."""
        train = to_plain(self.train)
        # keys that say nothing are left out: runs from before they existed keep their identity
        more: dict[str, Any] = {"effects": list(self.chosen.effects)} if self.chosen.effects else {}
        if self.protocol != "full":
            more["protocol"] = self.protocol
        if self.gpus != 1:
            more["gpus"] = self.gpus
        return more | {
            "method": self.method.name,
            "source": self.method.source_hash,
            "options": to_plain(self.options),
            "train": train,
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
        """Hash of what decides the result: not how often it is saved, nor where the scene lies.

        What is done about values that are not finite is left out too: where there are none it does nothing,
        and where there are the result's facts say so.
        """
        return config_identity(self.config)


@dataclass
class CellReport:
    """What became of a cell."""

    folder: Path
    outcome: Outcome
    error: str = ""
    result: dict[str, Any] = field(default_factory=dict)
