"""How the harness runs an external program: the scene that it gets, the interface, and its processes.

A command runs without a shell, with a log and a time limit; at its end all of its processes are ended. The
program gets a copy of the scene made of links, because programs of the 3DGS family write into the scene
(``sparse/0/points3D.ply``) and need the split in files of their own. Photos are links, folders are real;
``truth/`` is left out, as no method may read it.
"""

from __future__ import annotations

import glob
import json
import os
import platform
import shlex
import shutil
import signal
import subprocess
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path, PurePosixPath
from typing import Any, Literal, NoReturn, Protocol

from ambiguous_wild.core import UNMOVED, AwError, Scene, View
from ambiguous_wild.core.config import Facts
from ambiguous_wild.core.processes import last_lines
from ambiguous_wild.io.colmap_model import write_views
from ambiguous_wild.io.files import write_json
from ambiguous_wild.io.images import image_size

Photos = Literal["all", "train", "nerf-w"]

_LEFT_OUT = {"truth", "scene.json"}
WORK, LOGS = "external", "logs"  # folders of a run for the program's output and for its logs
DONE = "done.json"  # in WORK: the finished commands, and their seconds
GRACE_S = 10.0  # seconds between SIGTERM and SIGKILL
_RECORD = ".running.json"  # record of a running command, beside its log
_TAIL_LINES = 4


def stage_scene(scene: Scene, folder: Path, files: Mapping[str, str], *, photos: Photos = "all") -> Path:
    """Make the copy of the scene that a program gets.

    Args:
        scene: the scene.
        folder: the copy; it is replaced if it exists.
        files: texts by path relative to the folder; they replace links of the same name.
        photos: "all" links the scene as it is; "train" its train photos alone, at the size at which the
            scene is loaded, as images/ with a binary model; "nerf-w" all photos at full size, as dense/ with
            a binary model and NeRF-W's table of the split, for programs that shrink them by {factor}.

    Raises:
        AwError: a path leaves the folder, or photos at full size are missing.
    """
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    if photos == "train":
        _link_views(scene.train, {v.name: v.image_path for v in scene.train}, folder, scene)
    elif photos == "nerf-w":
        _stage_nerfw(scene, folder)
    elif scene.transform != UNMOVED:
        write_views(folder / "sparse" / "0", scene.views, scene.points)
    for path in () if photos != "all" else sorted(scene.root.resolve().iterdir()):
        if path.name in _LEFT_OUT or path.name.startswith(".") or (folder / path.name).exists():
            continue
        if path.is_dir() and path.name != "sparse":
            os.symlink(path, folder / path.name, target_is_directory=True)
        else:
            _link_files(path, folder / path.name)
    for name, text in files.items():
        pure = PurePosixPath(name)
        target = folder / pure
        if pure.is_absolute() or ".." in pure.parts or target.parent.resolve() != target.parent.absolute():
            raise AwError(f"scene_files: {name!r} lies outside the copy, or among the scene's own photos")
        target.parent.mkdir(parents=True, exist_ok=True)
        target.unlink(missing_ok=True)
        target.write_text(text, encoding="utf-8")
    return folder


def _link_views(
    views: Sequence[View], photos: Mapping[str, Path], folder: Path, scene: Scene, model: str = "sparse/0"
) -> None:
    for view in views:
        target = folder / "images" / view.name
        target.parent.mkdir(parents=True, exist_ok=True)
        os.symlink(photos[view.name].resolve(), target)
    write_views(folder / model, views, scene.points)


def _stage_nerfw(scene: Scene, folder: Path) -> None:
    factor = int(scene.info.get("loaded_factor") or 1)
    if factor < 2:
        raise AwError(
            f"{scene.name} is loaded at full size, and loaders of the NeRF-W family fail there: "
            "give --factor 2 or more"
        )
    views = sorted(scene.views, key=lambda view: view.name)
    photos = {view.name: _full_size(scene, view.name, factor) for view in views}
    sizes = {name: image_size(path) for name, path in photos.items()}
    full = [replace(view, camera=view.camera.resized(*sizes[view.name])) for view in views]
    _link_views(full, photos, folder / "dense", scene, model="sparse")
    rows = [f"{view.name}\t{number}\t{view.split}\t{scene.name}\n" for number, view in enumerate(views)]
    (folder / f"{scene.name}.tsv").write_text(
        "filename\tid\tsplit\tdataset\n" + "".join(rows), encoding="utf-8"
    )


def _full_size(scene: Scene, name: str, factor: int) -> Path:
    stem = (scene.root / "images" / name).with_suffix("")
    paths = sorted(p for p in stem.parent.glob(f"{glob.escape(stem.name)}.*") if p.is_file())
    if len(paths) != 1:
        raise AwError(f"{scene.root} has no images/{name} at full size, of which images_{factor} was made")
    return paths[0]


def _link_files(path: Path, target: Path) -> None:
    if path.is_dir():
        target.mkdir()
        for child in sorted(path.iterdir()):
            _link_files(child, target / child.name)
    else:
        os.symlink(path, target)


def split_lists(scene: Scene) -> dict[str, str]:
    """Return the names of the photos of each side, one a line: values for placeholders in `files`."""
    sides = {"train": scene.train, "test": scene.test}
    out = {f"{side}_names": "".join(f"{v.name}\n" for v in views) for side, views in sides.items()}
    stems = {side: [PurePosixPath(v.name).with_suffix("") for v in views] for side, views in sides.items()}
    return out | {f"{side}_stems": "".join(f"{s}\n" for s in names) for side, names in stems.items()}


@dataclass(frozen=True)
class Task:
    """One run of a program."""

    scene: Scene
    options: Any  # options of the method, a frozen dataclass
    seed: int
    iterations: int
    budget_s: float | None  # training time, if the run has one instead of a length
    device: str  # "cpu" or "cuda"
    folder: Path  # the run folder
    work: Path  # folder for the program's output; kept when a run is resumed
    logs: Path  # folder for its logs


@dataclass(frozen=True)
class Produced:
    """The output of a program, and its known cost."""

    renders: Mapping[str, Path]  # test view -> 8-bit PNG at the size of its photo
    masks: Mapping[str, Path] = field(default_factory=dict)  # train view -> PNG, white = kept
    ply: Path | None = None  # splats, as 3DGS writes them
    drawn_by_us: bool = False  # there are no renders: the harness draws the test views from `ply`
    cost: Mapping[str, float] = field(default_factory=dict)  # train_s, render_s and other known costs
    facts: Facts = field(default_factory=dict)


class Program(Protocol):
    """An external program: it trains, renders the test views, and returns the paths of its output."""

    def missing(self, options: Any) -> str:
        """Return the command that this machine lacks; empty if it has all.

        Args:
            options: options of the method.
        """
        ...

    def run(self, task: Task) -> Produced:
        """Run, or resume a stopped run.

        Raises:
            AwError: the program fails, takes too long, or writes no complete output.
        """
        ...


def no_parts(options: Any) -> NoReturn:
    """Raise AwError: the recipe of an external method, which has no parts."""
    raise AwError("an external method is a program of its own: it has no parts that fit into another method")


def run_logged(
    what: str,
    command: Sequence[str],
    *,
    log: Path,
    cwd: Path,
    environment: Mapping[str, str],
    timeout_s: float | None,
) -> float:
    """Run a command to its end; its output is appended to `log`.

    Args:
        what: name of the command for errors, e.g. ``"train of gsplat-mcmc"``.
        command: program and arguments, which no shell reads.
        log: file for stdout and stderr.
        cwd: working folder.
        environment: variables in addition to those of this process.
        timeout_s: seconds after which it is ended; None = never.

    Returns:
        Wall seconds.

    Raises:
        AwError: no such program, a non-zero exit code (with the last lines of the log), or a timeout.
    """
    log.parent.mkdir(parents=True, exist_ok=True)
    record = log.with_suffix(_RECORD)
    begin = time.perf_counter()
    with open(log, "ab") as out:
        out.write(f"$ {shlex.join(command)}\n".encode())
        out.flush()
        try:
            # A new session, so that all processes of the program can be ended together.
            process = subprocess.Popen(
                list(command), cwd=cwd, env={**os.environ, **environment}, stdin=subprocess.DEVNULL,
                stdout=out, stderr=subprocess.STDOUT, start_new_session=True,
            )  # fmt: skip
        except OSError as error:
            raise AwError(
                f"{what} cannot start {command[0]!r} in {cwd}: {error.strerror or error}; "
                "check cwd, prefix and the command"
            ) from None
        try:
            write_json(record, {"group": process.pid, "host": platform.node(), "start": _start(process.pid)})
            code = process.wait(timeout=timeout_s)
        except subprocess.TimeoutExpired:
            raise AwError(f"{what} took longer than {timeout_s:.0f} s and was ended; {_tail(log)}") from None
        finally:
            _end_group(process.pid, process)
            record.unlink(missing_ok=True)
    if code != 0:
        reason = f"was killed by signal {-code}" if code < 0 else f"ended with exit code {code}"
        raise AwError(f"{what} {reason}; {_tail(log)}")
    return time.perf_counter() - begin


def _tail(log: Path) -> str:
    """Return "last lines of LOG: ..." as one line."""
    return f"last lines of {log}: " + (" | ".join(last_lines(log)[-_TAIL_LINES:]) or "(it wrote nothing)")


def _end_group(group: int, process: subprocess.Popen[bytes] | None = None) -> None:
    """End every process of the group: SIGTERM first, then SIGKILL."""
    for sign, patience in ((signal.SIGTERM, GRACE_S), (signal.SIGKILL, GRACE_S)):
        try:
            os.killpg(group, sign)
        except (ProcessLookupError, PermissionError):
            break
        deadline = time.monotonic() + patience
        while time.monotonic() < deadline:
            if process is not None:
                process.poll()
            if not _alive(group):
                break
            time.sleep(0.05)
    if process is not None:
        process.wait()


def _alive(group: int) -> bool:
    try:
        os.killpg(group, 0)
    except (ProcessLookupError, PermissionError):
        return False
    # A leader that has ended, but was not waited for (a zombie), is not alive.
    stat = _stat(group)
    return stat is None or stat[0] != "Z"


def end_left_over(logs: Path) -> None:
    """End processes that a killed run left behind: they would write to the same files as a new run."""
    for record in sorted(logs.glob(f"*{_RECORD}")):
        _end_recorded(record)


def _end_recorded(record: Path) -> None:
    try:
        entry = json.loads(record.read_text(encoding="utf-8"))
        group, host, start = int(entry["group"]), entry["host"], entry["start"]
    except (OSError, ValueError, KeyError, TypeError, RecursionError):
        return
    # Process ids are reused: the start time tells whether it is still the same process.
    if host == platform.node() and start is not None and start == _start(group):
        _end_group(group)
    record.unlink(missing_ok=True)


def _start(pid: int) -> str | None:
    """Return the start time of the process in the kernel's units; None if unknown."""
    stat = _stat(pid)
    return None if stat is None else stat[19]


def _stat(pid: int) -> list[str] | None:
    """Return the fields of /proc/PID/stat from the state on; None without such a process or system."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    except OSError:
        return None
