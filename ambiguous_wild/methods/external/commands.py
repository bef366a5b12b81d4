"""The plain adapter: a train command, a render command, and the paths of the pictures."""

from __future__ import annotations

import dataclasses
import glob
import json
import os
import shutil
import subprocess
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Any

from ambiguous_wild.core import AwError, View
from ambiguous_wild.core.errors import shortlist
from ambiguous_wild.io.atomic import write_json
from ambiguous_wild.methods.external import templates
from ambiguous_wild.methods.external.process import end_left_over, run_logged
from ambiguous_wild.methods.external.program import DONE, Produced, Task
from ambiguous_wild.methods.external.staging import Photos, split_lists, stage

BEGUN = (
    "begun.json"  # in the program's folder: the command that was started, to know whether it may be resumed
)


@dataclass(frozen=True)
class CommandProgram:
    """See `Description` for the fields; commands are split and paths resolved."""

    name: str
    train: tuple[str, ...]
    render: tuple[str, ...]
    resume: tuple[str, ...]
    renders: str
    masks: str
    ply: str
    cwd: Path
    prefix: tuple[str, ...]
    environment: tuple[tuple[str, str], ...]
    scene_files: tuple[tuple[str, str], ...]
    timeout_s: float | None
    photos: Photos = "all"  # what the program sees, see staging.py
    drawn_by_us: bool = False  # it leaves splats, which our renderer draws

    def missing(self, options: Any) -> str:
        """The first word of a command, or of the prefix, that is no program here; empty if all are."""
        values = dataclasses.asdict(options)
        commands = [self.prefix] if self.prefix else [self.train, self.render, self.resume]
        words = [command[0] for command in commands if command]
        path = dict(self.environment).get("PATH")
        for word in dict.fromkeys(words):
            if templates.placeholders(f"{word}{path or ''}", self.name) - values.keys():
                continue  # known when it runs
            program = templates.fill(word, values)
            where = self.cwd / program if os.path.dirname(program) else program
            if shutil.which(where, path=path and templates.fill(path, values)) is None:
                return program
        return ""

    def run(self, task: Task) -> Produced:
        """Train unless that is done, render unless that is done, collect.

        Raises:
            AwError: a command fails or writes no complete output.
        """
        self._check_length(task)
        end_left_over(task.logs)
        lists = split_lists(task.scene)
        files = {name: templates.fill(text, lists) for name, text in self.scene_files}
        staged = stage(task.scene, task.folder / ".scene", files, photos=self.photos)
        try:
            values = self._values(task, staged)
            state = task.work / DONE
            done: dict[str, float] = _read(state)
            output = Path(values["output"])
            if "train_s" not in done:
                again = self._goes_on(task, output)
                if not again:
                    shutil.rmtree(output, ignore_errors=True)
                output.mkdir(parents=True, exist_ok=True)
                command = self.resume if again else self.train
                write_json(task.work / BEGUN, list(self.train))
                done["train_s"] = self._command("train", command, values, task)
                write_json(state, done)
            if self.render and "render_s" not in done:
                done["render_s"] = self._command("render", self.render, values, task)
                write_json(state, done)
            return self._collect(task, values, done)
        finally:
            shutil.rmtree(staged, ignore_errors=True)

    def _goes_on(self, task: Task, output: Path) -> bool:
        """Whether there is output of the same command that `resume` may continue."""
        try:
            begun = json.loads((task.work / BEGUN).read_text(encoding="utf-8"))
        except (OSError, ValueError, RecursionError):
            return False
        same = begun == list(self.train)
        return bool(self.resume) and same and output.is_dir() and any(output.iterdir())

    def _check_length(self, task: Task) -> None:
        if task.budget_s is not None and "budget_s" not in self._used():
            raise AwError(
                f"{self.name} has no {{budget_s}} in its commands, so it cannot keep a --budget: "
                "give --iterations instead"
            )

    def _used(self) -> set[str]:
        texts = (*self.train, *self.render, *(value for _, value in self.environment))
        return set().union(*(templates.placeholders(text, self.name) for text in texts))

    def _values(self, task: Task, staged: Path) -> dict[str, Any]:
        factor = int(task.scene.info.get("loaded_factor") or 1)
        return dataclasses.asdict(task.options) | {
            "scene": str(staged.absolute()),
            "source": str(task.scene.root.resolve()),
            "images": "images" if factor == 1 or self.photos != "all" else f"images_{factor}",
            "output": str((task.work / "output").absolute()),
            "seed": task.seed,
            "iterations": task.iterations,
            "budget_s": task.budget_s,
            "factor": 1 if self.photos == "train" else factor,
            "device": task.device,
        }

    def _command(self, step: str, command: Sequence[str], values: dict[str, Any], task: Task) -> float:
        return run_logged(
            f"{step} of {self.name}",
            [*self.prefix, *(templates.fill(argument, values) for argument in command)],
            log=task.logs / f"{step}.log",
            cwd=self.cwd,
            environment={name: templates.fill(text, values) for name, text in self.environment},
            timeout_s=self.timeout_s,
        )

    def _collect(self, task: Task, values: dict[str, Any], done: dict[str, float]) -> Produced:
        tests, trains = task.scene.test, task.scene.train
        drawn = [] if self.drawn_by_us else list(enumerate(tests))
        renders = {view.name: self._find(self.renders, values, view, i) for i, view in drawn}
        missing = [name for name, found in renders.items() if found is None]
        if missing:
            raise AwError(
                f"{self.name} left no render of {len(missing)} of {len(tests)} test photos "
                f"({shortlist(missing)}): {self._pattern(self.renders, values, tests[0], 0)} is not there"
            )
        masks = {}
        if self.masks:
            masks = {view.name: self._find(self.masks, values, view, i) for i, view in enumerate(trains)}
        ply = self._one(templates.fill_pattern(self.ply, values)) if self.ply else None
        if self.ply and ply is None:
            raise AwError(
                f"{self.name} left no splats: {templates.fill_pattern(self.ply, values)} is not there"
            )
        cost: dict[str, float] = dict(done)
        if task.budget_s is None and "iterations" in self._used():
            cost |= {"iterations": task.iterations}
            cost |= {"ms_per_iteration": 1e3 * done["train_s"] / task.iterations}
        return Produced(
            renders={name: path for name, path in renders.items() if path is not None},
            masks={name: path for name, path in masks.items() if path is not None},
            ply=ply,
            drawn_by_us=self.drawn_by_us,
            cost=cost,
            facts=self._facts(),
        )

    def _facts(self) -> dict[str, Any]:
        """The program's revision, and the settings of the run that it was not given."""
        revision = _revision(self.cwd)
        deaf = sorted({"seed", "iterations"} - self._used())
        return {"revision": revision, "not_told": deaf}

    def _pattern(self, template: str, values: dict[str, Any], view: View, index: int) -> str:
        stem = str(PurePosixPath(view.name).with_suffix(""))
        pattern = templates.fill_pattern(template, values | {"stem": stem, "name": view.name, "index": index})
        return str(self.cwd / pattern)  # an absolute pattern stays as it is

    def _find(self, template: str, values: dict[str, Any], view: View, index: int) -> Path | None:
        return self._one(self._pattern(template, values, view, index))

    def _one(self, pattern: str) -> Path | None:
        found = sorted(glob.glob(str(self.cwd / pattern)))
        if len(found) > 1:
            raise AwError(
                f"{self.name}: {len(found)} files fit {pattern} ({shortlist(found, 2)}): one must; "
                "make the pattern narrower"
            )
        return Path(found[0]) if found else None


def _read(state: Path) -> dict[str, float]:
    try:
        data = json.loads(state.read_text(encoding="utf-8"))
        return {key: float(data[key]) for key in ("train_s", "render_s") if key in data}
    except (OSError, ValueError, TypeError, RecursionError):
        return {}


def _revision(folder: Path) -> str | None:
    """The commit of the program's repository; None if it is in none."""
    try:
        done = subprocess.run(
            ["git", "-C", str(folder), "rev-parse", "HEAD"], capture_output=True, text=True, timeout=10
        )
    except (OSError, subprocess.TimeoutExpired):
        return None
    return done.stdout.strip() if done.returncode == 0 else None
