"""Options that had another name in the version before: the old name works once more, and prints a line."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import click

POSITIONAL, GONE = "", None  # instead of a name: the value alone; neither name nor value
_OUT = {"--out": "--output"}
_JOBS = {"--jobs": "--threads"}
_SCENE = {"--scene": "--only", "--scene-folder": "--scene"}

# Command -> its options' old names -> names of today.
RENAMED: dict[str, dict[str, str | None]] = {
    "simulate": {**_OUT, "--sheet": "--pictures", "--no-sheet": "--no-pictures"},
    "plan": {**_OUT},
    "ambiguity-report": {**_OUT, "--masks": "--distractor-masks", "--masks-white": GONE},
    "capture": {**_JOBS},
    "screen": {**_JOBS},
    "build-scene": {**_JOBS, "--masks": "--keep-masks"},
    "import": {**_JOBS},
    "package": {**_JOBS},
    "table": {"--scene": "--only"},
    "cost": {"--scene": "--only"},
    "view": {**_SCENE},
    "video": {**_SCENE},
    "export": {"--scene-folder": "--scene"},
    "leaderboard add": {"--scenes": "--scene", "--replace": "--overwrite"},
    "leaderboard remove": {"--scene": "--only"},
    "leaderboard publish": {**_OUT},
    "study make": {**_OUT, "--runs": POSITIONAL, "--only-scene": "--only", "--force": "--overwrite"},
    "study score": {**_OUT},
    "weights get": {"--again": "--overwrite"},
}
_NAMES_OR_FOLDERS = {"view", "video"}  # --scene was the name of a scene, and is a folder now


def with_new_names(args: Sequence[str]) -> list[str]:
    """The words after `aw` with today's names of options; each old one is told once on stderr."""
    length = next((n for n in (2, 1) if " ".join(args[:n]) in RENAMED), 0)
    command = " ".join(args[:length])
    names, words = dict(RENAMED.get(command, {})), list(args)
    if command == "ambiguity-report" and {"keep", "--masks-white=keep"} & {*words}:
        names["--masks"] = "--keep-masks"
    found, told = words[:length], dict[str, str]()
    words = words[length:]
    while words and words[0] != "--":
        old, equals, value = words.pop(0).partition("=")
        following = value or "".join(words[:1])
        folder = "/" in following or Path(following).is_dir()
        if old not in names or (command in _NAMES_OR_FOLDERS and old == "--scene" and folder):
            found.append(old + equals + value)
            continue
        new = names[old]
        told[old] = "not needed any more" if new is GONE else new or "given without a name"
        if new:
            found.append(new + equals + value)
        elif new == POSITIONAL and equals:
            found.append(value)
        elif new is GONE and not equals:
            del words[:1]
    for old, new_name in told.items():
        click.echo(f"{old} is now {new_name}; the old name works in this version only", err=True)
    return found + words
