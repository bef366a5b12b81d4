"""Suites: scenes of published tables, and simulated ones; their folders, and how they are measured."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any, Literal

from ambiguous_wild.core.errors import AwError, shortlist, unknown
from ambiguous_wild.datasets.foreign import plain
from ambiguous_wild.io.plain_yaml import read_mapping

FILE = Path(__file__).with_name("suites.yaml")
MEASURED = Path(__file__).with_name("aw_sim.yaml")  # ambiguity of the captures of aw-sim
SLACK = 0.1  # undistorting crops a photo by less than this


@dataclass(frozen=True)
class Simulated:
    """How `aw simulate` makes the captures of a suite; a scene's name is that of its preset."""

    width: int  # px, of a photo
    seed: int  # of worlds, walks and distractors


@dataclass(frozen=True)
class Suite:
    """The scenes of one dataset, and how its tables measure them."""

    name: str
    dataset: str  # its name in result tables
    tables: dict[str, list[str]]  # table -> scenes
    aliases: dict[str, list[str]]  # scene -> other spellings
    factor: int  # 0 = as published, by scene
    iterations: int
    protocol: Literal["full", "half"]
    license: str
    width: int = 0  # px, longer side of the photos; 0 = not stated
    height: int = 0
    simulated: Simulated | None = None  # None: the photos are real

    @property
    def scenes(self) -> list[str]:
        """All scenes, in the order of the tables."""
        return list(dict.fromkeys(scene for names in self.tables.values() for scene in names))

    def spellings(self, scene: str) -> set[str]:
        """Return all names that a scene's folder may have, in plain spelling."""
        return {plain(scene), *(plain(other) for other in self.aliases.get(scene, ()))}


def scene_id(scene: str) -> str:
    """Return the scene's name in runs: "Patio-High" -> "patio-high"."""
    return "-".join(scene.casefold().replace("-", " ").split())


@cache
def suites() -> dict[str, Suite]:
    """Read all suites, by name."""
    rows: dict[str, dict[str, Any]] = {}
    for row in read_mapping(FILE)["suites"]:
        rows[row["name"]] = {**(rows[row.pop("like")] if "like" in row else {}), **row}
    return {name: _suite(row) for name, row in rows.items()}


def _suite(row: Mapping[str, Any]) -> Suite:
    made = row.get("simulated")
    return Suite(**{**row, "simulated": Simulated(**made) if made else None})


def simulated_suites() -> dict[str, Suite]:
    """Return the suites whose captures are simulated, by name."""
    return {name: suite for name, suite in suites().items() if suite.simulated is not None}


@cache
def measured_ambiguity() -> dict[str, dict[str, Any]]:
    """Read what is measured of aw-sim: scene -> shares occlusion, colour and lookalike, and class."""
    return read_mapping(MEASURED)


def get_suite(name: str) -> Suite:
    """Return the suite of a name.

    Raises:
        AwError: there is none.
    """
    if name not in suites():
        raise unknown("suite", name, suites())
    return suites()[name]


def find_scenes(suite: Suite, root: Path) -> tuple[dict[str, Path], list[str]]:
    """Find the folders of the suite's scenes in `root` or one folder deeper, and name the absent scenes.

    Raises:
        AwError: no folder, no scene of the suite, or two folders of one scene.
    """
    if not root.is_dir():
        raise AwError(f"--scene {root} is no folder")
    inner = [p for p in sorted(root.iterdir()) if p.is_dir() and not p.name.startswith(".")]
    folders = inner + [q for p in inner for q in sorted(p.iterdir()) if q.is_dir()]
    found: dict[str, Path] = {}
    for scene in suite.scenes:
        spellings = suite.spellings(scene)
        for level in (inner, folders):
            fits = [p for p in level if plain(p.name) in spellings and _is_scene(p)]
            if len(fits) > 1:
                raise AwError(
                    f"{root} has {len(fits)} folders of the scene {scene}: "
                    f"{shortlist(map(str, fits))}; keep one"
                )
            if fits:
                found[scene] = fits[0]
                break
    absent = [scene for scene in suite.scenes if scene not in found]
    if not found:
        raise AwError(
            f"{root} has no scene of {suite.name}: a folder a scene is needed, called "
            f"{shortlist(suite.scenes)}"
        )
    return found, absent


def _is_scene(folder: Path) -> bool:
    """Tell a scene from a folder of photos: images/ of a scene called "train" is no scene."""
    names = (
        "scene.json",
        "sparse",
        "dense",
        "transforms.json",
        "transforms_train.json",
        "nb-info.json",
        "colmap",
    )
    return any((folder / name).exists() for name in names)


def suite_of(dataset: str, folder: Path) -> Suite | None:
    """Return the suite of a dataset's name, or of the folder that the scene's folder lies in."""
    for suite in suites().values():
        own = plain(suite.dataset)
        if plain(dataset) == own or (not dataset and plain(folder.parent.name) == own):
            return suite
    return None


def differences(suite: Suite, scene: str, sizes: Sequence[tuple[int, int]], factor: int) -> list[str]:
    """List how a copy of a scene differs from what the suite states.

    Args:
        suite: the suite.
        scene: the folder's name.
        sizes: (width, height) of the cameras, px, at full size.
        factor: downsampling of the copy.
    """
    notes = []
    if not any(plain(scene) in suite.spellings(name) for name in suite.scenes):
        notes.append(f"{suite.dataset} has no scene {scene!r}; it has {shortlist(suite.scenes, 20)}")
    if suite.factor and factor != suite.factor:
        notes.append(f"factor {factor}; {suite.dataset} is measured at {suite.factor}")
    if suite.width:
        longer, shorter = max(suite.width, suite.height), min(suite.width, suite.height)
        odd = [
            f"{w}x{h}"
            for w, h in sizes
            if not (1 - SLACK) * longer <= max(w, h) <= longer
            or not (1 - SLACK) * shorter <= min(w, h) <= shorter
        ]
        if odd:
            names = shortlist(dict.fromkeys(odd), 3)
            notes.append(f"photos of {names} px; {suite.dataset} has {suite.width}x{suite.height}")
    return notes


def simulated_dataset(capture: Mapping[str, Any], factor: object) -> str | None:
    """Return the dataset of a simulated suite that a scene belongs to; None where it is of none.

    Args:
        capture: truth/capture.json.
        factor: downsampling of the scene.
    """
    spec = capture.get("spec")
    width = spec.get("width") if isinstance(spec, dict) else None
    for suite in suites().values():
        made, known = suite.simulated, capture.get("preset") in suite.scenes
        if made and known and (made.width, made.seed, suite.factor) == (width, capture.get("seed"), factor):
            return suite.dataset
    return None
