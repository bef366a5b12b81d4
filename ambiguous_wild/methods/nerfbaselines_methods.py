"""`nerfbaselines:METHOD`: a method of NerfBaselines, through its command line in its own environment.

NerfBaselines needs numpy below 2, so it cannot share our environment. It trains without its own evaluation,
which would count as training time; its renders are read from the predictions archive and measured like all
others. Source: nerfbaselines 1.2.12, `cli/_train.py`, `cli/_render.py`, `evaluation.py`.
"""

from __future__ import annotations

import hashlib
import json
import os
import shutil
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Any

from ambiguous_wild.core import AwError, Scene
from ambiguous_wild.core.config import Facts
from ambiguous_wild.core.errors import shortlist
from ambiguous_wild.core.names import check_name
from ambiguous_wild.io.archive import Limits, unpack
from ambiguous_wild.io.files import atomic_dir, write_json
from ambiguous_wild.methods.entry import MethodEntry
from ambiguous_wild.methods.external_process import DONE, Produced, Task, end_left_over, no_parts, run_logged

PROGRAM = "AW_NERFBASELINES"  # environment variable with the path of its command
TESTED = "1.2.12"
LIMITS = Limits(bytes=50_000_000_000)  # size of an unpacked predictions archive


@dataclass(frozen=True)
class Options:
    """Options for the command line of NerfBaselines; `--set nerfbaselines-METHOD.KEY=VALUE`."""

    backend: str = ""  # conda, docker, apptainer or python; empty = its own choice
    presets: tuple[str, ...] = ()  # names with commas; none = its own defaults
    overrides: tuple[str, ...] = ()  # KEY=VALUE,KEY=VALUE of the method
    iterations_key: str = ""  # the method's key for its length, set to --iterations; empty = its own length
    seed_key: str = ""  # the method's key for its seed; empty = it gets no seed
    evaluate: bool = False  # run its own metrics too, which need torch in its environment
    timeout_h: float = 0.0  # limit of each command; 0 = none


def nerfbaselines_entry(method: str) -> MethodEntry:
    """Return the entry of a method of NerfBaselines.

    Raises:
        AwError: NerfBaselines is not installed (the message says how), or the name is not allowed.
    """
    program = find_program()
    name = check_name("method of NerfBaselines", method)
    return MethodEntry(
        name=f"nerfbaselines-{name}",
        summary=f"{name} as NerfBaselines runs it",
        recipe=no_parts,
        config="ambiguous_wild.methods.nerfbaselines_methods:Options",
        needs="NerfBaselines in its own environment",
        source_hash=hashlib.sha256(f"nerfbaselines {name}".encode()).hexdigest(),
        program=NerfBaselines(name, program),
    )


def find_program() -> str:
    """Return the path of `nerfbaselines`, from $AW_NERFBASELINES or PATH.

    Raises:
        AwError: it is not installed; the message gives the commands.
    """
    configured = os.environ.get(PROGRAM, "")
    path = shutil.which(configured or "nerfbaselines")
    if path:
        return str(Path(path).absolute())
    where = f"${PROGRAM} is {configured}, which is no program" if configured else "NerfBaselines is not here"
    raise AwError(
        f"{where}; it needs an environment of its own (numpy < 2): python3 -m venv ~/nerfbaselines && "
        f"~/nerfbaselines/bin/pip install nerfbaselines=={TESTED} 'numpy<2' && "
        f"export {PROGRAM}=~/nerfbaselines/bin/nerfbaselines"
    )


@dataclass(frozen=True)
class NerfBaselines:
    """One method of NerfBaselines."""

    method: str
    program: str

    def missing(self, options: Any) -> str:
        """Return the path of its command if that is missing now; empty if it is there."""
        return "" if shutil.which(self.program) else self.program

    def run(self, task: Task) -> Produced:
        """Train, render the test split to an archive, read it.

        Raises:
            AwError: a command fails, the scene cannot be loaded as it is, or a render is missing.
        """
        self._check(task)
        end_left_over(task.logs)
        steps = _Steps(self, task)
        checkpoint = _checkpoint(task.work / "output")
        if checkpoint is None:
            shutil.rmtree(task.work / "output", ignore_errors=True)
            steps.run("train", self._train_command(task))
            checkpoint = _checkpoint(task.work / "output")
            if checkpoint is None:
                raise AwError(f"{self.method} left no checkpoint in {task.work / 'output'}; see {task.logs}")
        archive = task.work / "predictions.tar.gz"
        if "render_s" not in steps.seconds or not archive.is_file():
            archive.unlink(missing_ok=True)
            steps.run("render", self._render_command(task, checkpoint, archive))
        reported = self._own_metrics(task, archive, steps)
        renders = read_predictions(archive, task.work / "predictions", task.scene)
        info = _json(checkpoint / "nb-info.json")
        return Produced(
            renders=renders,
            cost=_cost(info, steps.seconds),
            facts={
                "nerfbaselines": info.get("nb_version"),
                "presets": info.get("applied_presets", []),
                "overrides": info.get("config_overrides", {}),
                "reported": reported,
                "not_told": [
                    what
                    for what, key in (
                        ("iterations", task.options.iterations_key),
                        ("seed", task.options.seed_key),
                    )
                    if not key
                ],
            },
        )

    def _check(self, task: Task) -> None:
        if task.budget_s is not None:
            raise AwError(f"{self.method} of NerfBaselines keeps no --budget: give --iterations instead")
        loaded, wanted = _loaded_factor(task.scene), int(task.scene.info.get("loaded_factor") or 1)
        if loaded != wanted:
            raise AwError(
                f"NerfBaselines loads {task.scene.root} at factor {loaded} (its nb-info.json), not {wanted}: "
                f"run with --factor {loaded}, or build the scene with --factor {wanted}"
            )

    def _train_command(self, task: Task) -> list[str]:
        options = task.options
        pairs = list(options.overrides)
        pairs += [f"{options.iterations_key}={task.iterations}"] if options.iterations_key else []
        pairs += [f"{options.seed_key}={task.seed}"] if options.seed_key else []
        command = ["train", "--method", self.method, "--data", str(task.scene.root.resolve())]
        command += ["--output", str((task.work / "output").absolute()), "--logger", "none"]
        # Index 0 is never reached: nothing is evaluated while it trains.
        command += ["--eval-few-iters", "0", "--eval-all-iters", "0", "--disable-output-artifact"]
        command += ["--presets", ",".join(options.presets)] if options.presets else []
        command += [text for pair in pairs for text in ("--set", pair)]
        return [*command, *_backend(options)]

    def _render_command(self, task: Task, checkpoint: Path, archive: Path) -> list[str]:
        command = ["render", "--checkpoint", str(checkpoint.absolute()), "--split", "test"]
        command += ["--data", str(task.scene.root.resolve()), "--output", str(archive.absolute())]
        return [*command, *_backend(task.options)]

    def _own_metrics(self, task: Task, archive: Path, steps: _Steps) -> Facts | None:
        """Return NerfBaselines' own metrics of the same renders, which are shown beside ours."""
        if not task.options.evaluate:
            return None
        path = task.work / "results.json"
        if not path.is_file():
            steps.run("evaluate", ["evaluate", str(archive.absolute()), "--output", str(path.absolute())])
        metrics = _json(path).get("metrics")
        if not isinstance(metrics, dict):
            raise AwError(f"{path} of NerfBaselines holds no metrics")
        return {str(name): float(value) for name, value in metrics.items()}


class _Steps:
    """Runs the commands of a run, and stores the seconds of those that are done."""

    def __init__(self, method: NerfBaselines, task: Task) -> None:
        self.method, self.task = method, task
        self.state = task.work / DONE
        stored = _json(self.state) if self.state.is_file() else {}
        self.seconds = {key: float(value) for key, value in stored.items() if isinstance(value, (int, float))}

    def run(self, step: str, arguments: list[str]) -> None:
        self.seconds[f"{step}_s"] = run_logged(
            f"nerfbaselines {step} of {self.method.method}",
            [self.method.program, *arguments],
            log=self.task.logs / f"{step}.log",
            cwd=self.task.work,
            environment={},
            timeout_s=self.task.options.timeout_h * 3600.0 or None,
        )
        write_json(self.state, self.seconds)


def read_predictions(archive: Path, folder: Path, scene: Scene) -> dict[str, Path]:
    """Unpack the renders of a predictions archive: test view -> PNG in `folder`, which is replaced.

    Raises:
        AwError: the archive is damaged or hostile, or a test view has no render in it.
    """
    with atomic_dir(folder) as temporary:
        names = unpack(archive, temporary, LIMITS, wanted=lambda name: name.startswith("color/"))
    by_stem = {str(PurePosixPath(name).relative_to("color").with_suffix("")): folder / name for name in names}
    stems = {view.name: str(PurePosixPath(view.name).with_suffix("")) for view in scene.test}
    missing = [name for name, stem in stems.items() if stem not in by_stem]
    if missing:
        raise AwError(
            f"{archive} has no render of {len(missing)} of {len(stems)} test photos: {shortlist(missing)}; "
            "NerfBaselines splits by train_list.txt and test_list.txt, else takes every 8th"
        )
    return {name: by_stem[stem] for name, stem in stems.items()}


def _loaded_factor(scene: Scene) -> int:
    path = scene.root / "nb-info.json"
    if not path.is_file():
        return 1  # NerfBaselines' COLMAP loader reads images/
    arguments = _json(path).get("loader_kwargs")
    folder = arguments.get("images_path", "images") if isinstance(arguments, dict) else "images"
    tail = str(folder).removeprefix("images").removeprefix("_")
    return int(tail) if tail.isdecimal() else 1


def _checkpoint(output: Path) -> Path | None:
    """Return the last complete checkpoint-N; its nb-info.json is written last."""
    complete = [
        (int(path.name.removeprefix("checkpoint-")), path)
        for path in output.glob("checkpoint-*")
        if path.name.removeprefix("checkpoint-").isdecimal() and (path / "nb-info.json").is_file()
    ]
    return max(complete)[1] if complete else None


def _cost(info: Facts, seconds: dict[str, float]) -> dict[str, float]:
    """Return the training time that NerfBaselines reports, and the wall time of its commands."""
    cost = {f"{step}_wall_s": seconds[f"{step}_s"] for step in ("train", "render") if f"{step}_s" in seconds}
    train_s = info.get("total_train_time", seconds.get("train_s"))
    used = info.get("resources_utilization")
    used = used if isinstance(used, dict) else {}
    reported = {
        "train_s": train_s,
        "iterations": info.get("num_iterations"),
        "peak_rss_mb": used.get("memory"),
        "peak_gpu_mb": used.get("gpu_memory"),
    }
    cost |= {key: value for key, value in reported.items() if isinstance(value, (int, float))}
    if cost.get("iterations") and "train_s" in cost:
        cost["ms_per_iteration"] = 1e3 * cost["train_s"] / cost["iterations"]
    return cost


def _backend(options: Any) -> list[str]:
    return ["--backend", options.backend] if options.backend else []


def _json(path: Path) -> Facts:
    try:
        data = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError) as error:
        raise AwError(f"{path} of NerfBaselines cannot be read: {error}") from None
    return data if isinstance(data, dict) else {}
