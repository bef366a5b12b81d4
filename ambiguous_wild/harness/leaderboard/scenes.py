"""The scene of a run, where it is at hand, and the dataset it belongs to."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from ambiguous_wild.core import AwError, Scene
from ambiguous_wild.harness.leaderboard.entry import Entry
from ambiguous_wild.harness.running.cell import scene_identity
from ambiguous_wild.io.scene_folder import load_scene

SIMULATED = "simulated"


class Scenes:
    """Finds scenes, each opened once."""

    def __init__(
        self, folder: Path | None = None, dataset: str | None = None, board: Iterable[Entry] = ()
    ) -> None:
        """Args:
        folder: of scenes, or one scene; instead of where the runs say they lie.
        dataset: of every scene, whatever it says itself.
        board: what is known of scenes that are not at hand.
        """
        self._folder, self._dataset = folder, dataset
        self._known = {e.scene_hash: e.dataset for e in board}
        self._opened: dict[tuple[Path, int | None], tuple[Scene, str]] = {}

    def find(self, run: Path, config: Mapping[str, Any]) -> Scene | None:
        """The scene of a run; None where it is not on this machine.

        Raises:
            AwError: what lies there is another scene, or damaged.
        """
        asked = config["scene"]
        path = self._path(asked)
        if path is None:
            return None
        factor = asked.get("factor")
        key = (path, factor if isinstance(factor, int) else None)
        if key not in self._opened:
            scene = load_scene(path, factor=key[1], verify=True)
            self._opened[key] = scene, scene_identity(scene)
        scene, identity = self._opened[key]
        if identity != asked.get("sha256"):
            raise AwError(
                f"{run} is of another scene than {path}: the run's has hash {str(asked.get('sha256'))[:12]}, "
                f"this one {identity[:12]}; name the right one with --scenes, or run again on this one"
            )
        return scene

    def _path(self, asked: Mapping[str, Any]) -> Path | None:
        name = str(asked.get("name"))
        if self._folder is not None:
            if (self._folder / "sparse").is_dir():
                return self._folder
            # The name is a stranger's: it must not lead elsewhere.
            inside = Path(name).name == name and (self._folder / name).is_dir()
            return self._folder / name if inside else None
        path = asked.get("path")
        return Path(path) if isinstance(path, str) and path and Path(path).is_dir() else None

    def dataset(self, run: Path, scene: Scene | None, scene_hash: str) -> str:
        """The dataset: as asked for, as scene.json says, "simulated", or as the board knows it.

        Raises:
            AwError: nothing says it.
        """
        if self._dataset is not None:
            return self._dataset
        if scene is not None:
            said = scene.info.get("dataset")
            if isinstance(said, str) and said.strip():
                return said
            if _simulated(scene.root):
                return SIMULATED
        if scene_hash in self._known:
            return self._known[scene_hash]
        why = "its scene is not on this machine" if scene is None else f"{scene.root} names none"
        raise AwError(f"{run}: no dataset known, {why}; say it with --dataset NAME")


def _simulated(root: Path) -> bool:
    """Whether `aw simulate` made the photos."""
    try:
        facts = json.loads((root / "truth" / "capture.json").read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError):
        return False
    return isinstance(facts, dict) and isinstance(facts.get("preset"), str)
