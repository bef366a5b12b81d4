"""Pages of `aw view` behind the runs of a published board: one a scene, with a model for each entry."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from urllib.parse import quote

from ambiguous_wild.core import AwError
from ambiguous_wild.harness.leaderboard.entry import Entry
from ambiguous_wild.harness.leaderboard.sheet import slug
from ambiguous_wild.harness.running.result_file import RESULT
from ambiguous_wild.harness.showing.read import Found, find_models, open_scene
from ambiguous_wild.io.hashing import sha256_file
from ambiguous_wild.viewing.page_file import page_text

FOLDER = "models"
Say = Callable[[str], None]


@dataclass(frozen=True)
class ModelPages:
    """What was written."""

    links: dict[str, str]  # by the result hash of a run: where its entry is shown, relative to index.html
    pages: int


def write_model_pages(entries: Sequence[Entry], runs: Sequence[Path], out: Path, say: Say) -> ModelPages:
    """Write OUT/models/*.html from run folders whose results are on the board.

    Of an entry (a method with its setting) the lowest seed that is at hand is shown.

    Args:
        entries: of the board.
        runs: run folders, or folders of them.
        out: folder of the published page.
        say: told which entries have no model at hand.

    Raises:
        AwError: no run with a model below `runs`, or a scene that is not where its run says.
    """
    found, notes = find_models(runs)
    for note in notes:
        say(note)
    by_hash = {sha256_file(f.run / RESULT): f for f in found}
    scenes: dict[tuple[str, str], dict[str, list[Entry]]] = {}
    for entry in sorted(entries, key=lambda e: e.key):
        label = f"{entry.method} ({entry.setting})" + (f" {entry.options}" if entry.options else "")
        scenes.setdefault((entry.dataset, entry.scene), {}).setdefault(label, []).append(entry)
    links: dict[str, str] = {}
    names: set[str] = set()
    for (dataset, scene), groups in scenes.items():
        shown: list[tuple[str, Found]] = []
        for label, of_group in groups.items():
            at_hand = [e for e in of_group if e.result_hash in by_hash]
            if not at_hand:
                say(f"no model of {label} on {scene}: its run is not below the folders given")
                continue
            chosen = at_hand[0]
            shown.append((label, by_hash[chosen.result_hash]))
        if not shown:
            continue
        if len({f.scene_hash for _, f in shown}) > 1:
            raise AwError(f"runs on scene {scene!r} of {dataset!r} saw different photos: publish them apart")
        name = _page_name(dataset, scene, names)
        models = [replace(f.model, label=label) for label, f in shown]
        text, _, _ = page_text(open_scene(shown[0][1].run), models, title=f"{dataset}: {scene}")
        (out / FOLDER).mkdir(exist_ok=True)
        (out / FOLDER / name).write_text(text, encoding="utf-8")
        for label, _ in shown:
            for entry in groups[label]:
                links[entry.result_hash] = f"{FOLDER}/{name}#left={quote(label, safe='')}"
    return ModelPages(links, len(names))


def _page_name(dataset: str, scene: str, taken: set[str]) -> str:
    """A file name nobody has yet; names of scenes can be anything."""
    stem = f"{slug(dataset)}-{slug(scene)}".strip("-") or "scene"
    name, number = f"{stem}.html", 1
    while name in taken:
        number += 1
        name = f"{stem}-{number}.html"
    taken.add(name)
    return name
