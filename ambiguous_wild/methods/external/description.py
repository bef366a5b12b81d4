"""`external:my.yaml`: a program with commands to train and render, described in a YAML or TOML file."""

from __future__ import annotations

import dataclasses
import os
import re
import shlex
import tomllib
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

from ambiguous_wild.core import AwError
from ambiguous_wild.core.config import config_hash, from_plain, to_plain
from ambiguous_wild.core.errors import unknown
from ambiguous_wild.core.names import check_name
from ambiguous_wild.io import plain_yaml
from ambiguous_wild.methods.entry import MethodEntry, NoOptions
from ambiguous_wild.methods.external import templates
from ambiguous_wild.methods.external.commands import CommandProgram
from ambiguous_wild.methods.external.program import no_parts
from ambiguous_wild.methods.external.staging import Photos

RUN = ("scene", "source", "images", "output", "seed", "iterations", "budget_s", "factor", "device")
VIEW = ("stem", "name", "index")
_NO_MATTER = ("summary", "paper", "needs", "timeout_h")
_LATER = {"photos": "all", "drawn_by": "program"}
LISTS = ("train_names", "test_names", "train_stems", "test_stems")


@dataclass(frozen=True)
class Description:
    """The keys of the file. Commands are lists, or text split as a shell splits it; no shell runs them."""

    name: str = ""  # how tables call it
    summary: str = ""
    paper: str = ""
    needs: str = ""
    train: str | tuple[str, ...] = ()
    render: str | tuple[str, ...] = ()  # left out if training renders
    resume: str | tuple[str, ...] = ()  # instead of train, if a stopped run left files in {output}
    renders: str = ""  # path of a test photo's render; may contain wildcards
    masks: str = ""  # path of a train photo's keep map, white = kept
    ply: str = ""  # splats, for counting and size
    cwd: str = ""  # relative to the file; empty = the file's folder
    prefix: str | tuple[str, ...] = ()  # before every command, e.g. conda run --no-capture-output -n theirs
    environment: dict[str, Any] = field(default_factory=dict)
    options: dict[str, Any] = field(default_factory=dict)  # placeholders of your own; --set NAME.KEY=VALUE
    scene_files: dict[str, Any] = field(default_factory=dict)  # text files that the program wants in {scene}
    photos: Photos = "all"  # what {scene} holds, see staging.py: "all", "train" alone, or as "nerf-w"
    drawn_by: Literal["program", "us"] = "program"  # "us": our renderer draws the test views from `ply`
    timeout_h: float = 0.0  # of each command; 0 = none


PACKAGED = Path(__file__).parent / "descriptions"


def packaged(name: str) -> Path:
    """The file of a description that comes with the package: external:opensplat.

    Raises:
        AwError: there is none of that name.
    """
    known = sorted(file.stem for file in PACKAGED.glob("*.yaml"))
    if name not in known:
        raise unknown("description", name, known, "or write external:PATH.yaml")
    return PACKAGED / f"{name}.yaml"


def load_description(path: Path) -> MethodEntry:
    """The method that a description makes.

    Raises:
        AwError: no such file, no YAML or TOML, an unknown key or placeholder, or a missing key.
    """
    if len(path.parts) == 1 and not path.suffix and not path.exists():
        path = packaged(path.name)
    try:
        content = path.read_bytes()
    except OSError as error:
        raise AwError(f"no description {path}: {error.strerror}; write external:PATH.yaml") from None
    description = from_plain(Description, _parse(path, content), str(path))
    options = _options_class(description.options, path)
    program = CommandProgram(
        name=check_name(f"name in {path}", description.name),
        train=_command(description.train),
        render=_command(description.render),
        resume=_command(description.resume),
        renders=description.renders,
        masks=description.masks,
        ply=description.ply,
        cwd=_folder(description.cwd, path),
        prefix=_command(description.prefix),
        environment=tuple((str(k), str(v)) for k, v in description.environment.items()),
        scene_files=tuple((str(k), str(v)) for k, v in description.scene_files.items()),
        timeout_s=description.timeout_h * 3600.0 or None,
        photos=description.photos,
        drawn_by_us=description.drawn_by == "us",
    )
    _check(program, set(description.options), path)
    return MethodEntry(
        name=program.name,
        summary=description.summary or f"external program of {path.name}",
        recipe=no_parts,
        config=options,
        paper=description.paper,
        needs=description.needs or "its own environment",
        # keys without influence on the result may change without a new training
        source_hash=config_hash(_decisive(description)),
        program=program,
    )


def _folder(text: str, path: Path) -> Path:
    """`cwd`, in which $NAME is a variable of the environment."""
    for name in re.findall(r"\$(\w+)", text):
        if not os.environ.get(name):
            raise AwError(f"{path.stem} needs {name}: export {name}=FOLDER, the folder of its repository")
    return (path.resolve().parent / Path(os.path.expandvars(text)).expanduser()).resolve()


def _decisive(description: Description) -> dict[str, Any]:
    """What decides the result. Later keys count where they differ from their default: runs from before them
    keep their identity."""
    plain = {k: v for k, v in to_plain(description).items() if k not in _NO_MATTER}
    return {k: v for k, v in plain.items() if k not in _LATER or v != _LATER[k]}


def _parse(path: Path, content: bytes) -> Mapping[str, Any]:
    try:
        text = content.decode()
        data = tomllib.loads(text) if path.suffix == ".toml" else plain_yaml.parse(text)
    except (AwError, ValueError, RecursionError) as error:
        raise AwError(f"{path} cannot be read: {' '.join(str(error).split())}") from None
    if not isinstance(data, dict):
        raise AwError(f"{path} holds no keys: see docs/external-methods.md for name, train and renders")
    return data


def _command(text: str | tuple[str, ...]) -> tuple[str, ...]:
    try:
        return tuple(shlex.split(text)) if isinstance(text, str) else text
    except ValueError as error:
        raise AwError(f"command {text!r}: {error}") from None


def _options_class(options: Mapping[str, Any], path: Path) -> type:
    """A frozen dataclass with the file's values as defaults: `--set` checks types by it."""
    if not options:
        return NoOptions
    for key, value in options.items():
        if not str(key).isidentifier() or key in (*RUN, *VIEW, *LISTS):
            raise AwError(f"{path}: option {key!r} must be a name, and none of {', '.join(RUN)}")
        if not isinstance(value, (str, int, float, bool)):
            raise AwError(f"{path}: option {key!r} needs a text, a number or a truth value as its default")
    fields = [(key, type(value), field(default=value)) for key, value in options.items()]
    return dataclasses.make_dataclass("ProgramOptions", fields, frozen=True)


def _check(program: CommandProgram, options: set[str], path: Path) -> None:
    needed = ("train", "ply" if program.drawn_by_us else "renders")
    missing = [key for key in needed if not getattr(program, key)]
    if missing:
        raise AwError(f"{path} does not say {' and '.join(missing)}; see docs/external-methods.md")
    run = {*RUN, *options}
    for key in ("train", "render", "resume"):
        for argument in getattr(program, key):
            templates.check(argument, run, f"{path}, {key}")
    for name, value in program.environment:
        templates.check(value, run, f"{path}, environment {name}")
    for name, value in program.scene_files:
        templates.check(value, LISTS, f"{path}, scene_files {name}")
    for key, known in (("renders", run | {*VIEW}), ("masks", run | {*VIEW}), ("ply", run)):
        templates.check(getattr(program, key), known, f"{path}, {key}")
    if program.renders and not {*VIEW} & templates.placeholders(program.renders, "renders"):
        raise AwError(f"{path}: renders must hold {{stem}}, {{name}} or {{index}}: one file a test photo")
    if not program.cwd.is_dir():
        raise AwError(f"{path}: cwd {program.cwd} is no folder")
