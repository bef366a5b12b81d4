"""The questions of a study: pairs of renders of a test view, and photos with distractors."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np

from ambiguous_wild.core import AwError, Scene
from ambiguous_wild.core.errors import shortlist, unknown
from ambiguous_wild.harness.running.store import read_config, read_runs
from ambiguous_wild.io.images import read_gray
from ambiguous_wild.io.scene_folder import load_scene


@dataclass(frozen=True)
class PhotoQuestion:
    """How hard is it to tell the distractor from the scene?"""

    scene: str
    view: str
    photo: Path
    mask: Path | None  # PNG, white = distractor; raters can show its outline

    @property
    def group(self) -> str:
        """Questions are chosen evenly over the groups."""
        return self.scene


@dataclass(frozen=True)
class PairQuestion:
    """Which of two renders is better?"""

    scene: str
    view: str
    methods: tuple[str, str]
    renders: tuple[Path, Path]
    truth: Path | None  # the test photo, shown next to the renders

    @property
    def group(self) -> str:
        return f"{self.scene}\n{self.methods[0]}\n{self.methods[1]}"


Question = PhotoQuestion | PairQuestion


def scene_photos(folder: Path, *, outline: bool = True) -> list[PhotoQuestion]:
    """All training photos of a scene, except those without distractors in the ground truth.

    Raises:
        AwError: no scene, or no photo with distractors.
    """
    scene = load_scene(folder, verify="quick")
    found = []
    for view in scene.train:
        mask = scene.root / "truth" / "distractor" / f"{_stem(view.name)}.png"
        known = mask.is_file()
        if known and not (read_gray(mask) >= 128).any():
            continue
        shown = mask if known and outline else None
        found.append(PhotoQuestion(scene.name, view.name, view.image_path, shown))
    if not found:
        raise AwError(
            f"no training photo of {folder} has a distractor in the ground truth: there is nothing to ask; "
            "give a scene with distractors"
        )
    return found


def render_pairs(
    folder: Path, *, methods: Sequence[str] = (), scenes: Sequence[str] = (), truth: bool = True
) -> list[PairQuestion]:
    """All pairs of methods on all test views that both rendered; of several seeds the first is used.

    Args:
        folder: output of `aw bench -o`.
        methods: only these; empty = all.
        scenes: only these; empty = all.
        truth: show the test photo next to the renders.

    Raises:
        AwError: no runs, an unknown name, fewer than two methods on a scene, renders or photos missing.
    """
    frame = read_runs(folder).runs
    frame = frame[frame["status"] == "ok"]
    for kind, asked in (("method", methods), ("scene", scenes)):
        known = sorted(set(frame[kind]))
        for name in asked:
            if name not in known:
                raise unknown(kind, name, known)
    if methods:
        frame = frame[frame["method"].isin(methods)]
    if scenes:
        frame = frame[frame["scene"].isin(scenes)]
    pairs: list[PairQuestion] = []
    for scene, rows in frame.groupby("scene", sort=True):
        first = rows.sort_values("seed").drop_duplicates("method").sort_values("method")
        folders = {str(r["method"]): Path(str(r["folder"])) for r in first.to_dict("records")}
        pairs += _pairs_of_scene(str(scene), folders, truth)
    if not pairs:
        raise AwError(
            f"{folder} has no scene with finished runs of two methods: there is nothing to compare; "
            "run a second method with 'aw bench'"
        )
    return pairs


def _pairs_of_scene(scene: str, folders: dict[str, Path], truth: bool) -> list[PairQuestion]:
    if len(folders) < 2:
        return []
    renders = {m: {p.stem: p for p in sorted((f / "renders/test").glob("*.png"))} for m, f in folders.items()}
    common = set.intersection(*(set(r) for r in renders.values()))
    if not common:
        without = [m for m, r in renders.items() if not r]
        which = f"{shortlist(without)} lacks renders/test" if without else "they share no test view"
        raise AwError(f"the runs on {scene} cannot be compared: {which}; make them again with 'aw bench'")
    photos = _test_photos(scene, next(iter(folders.values()))) if truth else {}
    missing = sorted(common - set(photos)) if truth else []
    if missing:
        raise AwError(
            f"{scene} has no test photo for {shortlist(missing)}: restore the scene, or give --no-truth"
        )
    return [
        PairQuestion(scene, stem, (a, b), (renders[a][stem], renders[b][stem]), photos.get(stem))
        for a, b in combinations(sorted(folders), 2)
        for stem in sorted(common)
    ]


def _test_photos(name: str, run: Path) -> dict[str, Path]:
    settings: Any = read_config(run).get("scene")
    where = settings.get("path") if isinstance(settings, dict) else None
    if not isinstance(where, str) or not Path(where).is_dir():
        raise AwError(
            f"the runs on {name} were made from {where or 'an unknown folder'}, which does not exist: "
            "move the scene back, or leave the photo out (--no-truth)"
        )
    scene: Scene = load_scene(where, factor=settings.get("factor"), verify=False)
    return {_stem(v.name): v.image_path for v in scene.test}


def sample_questions(questions: Sequence[Question], limit: int, rng: np.random.Generator) -> list[Question]:
    """At most `limit` questions, spread evenly over their groups, in random order."""
    groups: dict[str, list[Question]] = {}
    for question in questions:
        groups.setdefault(question.group, []).append(question)
    for members in groups.values():
        rng.shuffle(members)
    names = sorted(groups)
    rng.shuffle(names)
    chosen: list[Question] = []
    while len(chosen) < limit and any(groups.values()):
        chosen += [groups[n].pop() for n in names if groups[n]][: limit - len(chosen)]
    return [chosen[i] for i in rng.permutation(len(chosen))]


def _stem(name: str) -> str:
    return str(PurePosixPath(name).with_suffix(""))
