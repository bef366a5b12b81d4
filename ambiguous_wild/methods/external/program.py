"""The interface of an external method: the harness starts it and reads the pictures that it writes."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NoReturn, Protocol

from ambiguous_wild.core import AwError, Scene

WORK, LOGS = "external", "logs"  # folders of a run: the program's output, and its logs
DONE = "done.json"  # in WORK: the commands that ended, and the seconds they took


@dataclass(frozen=True)
class Task:
    """One run of a program."""

    scene: Scene
    options: Any  # the method's frozen dataclass
    seed: int
    iterations: int
    budget_s: float | None  # training time, if the run has one instead of a length
    device: str  # "cpu" or "cuda"
    folder: Path  # the run folder
    work: Path  # folder for what the program writes; kept when a run is resumed
    logs: Path  # folder of its logs


@dataclass(frozen=True)
class Produced:
    """The output of a program, and its known cost."""

    renders: Mapping[str, Path]  # test view -> 8-bit PNG at the size of its photo
    masks: Mapping[str, Path] = field(default_factory=dict)  # train view -> PNG, white = kept
    ply: Path | None = None  # splats, as 3DGS writes them
    drawn_by_us: bool = False  # there are no renders: the harness draws the test views from `ply`
    cost: Mapping[str, float] = field(default_factory=dict)  # train_s, render_s and other known costs
    facts: Mapping[str, Any] = field(default_factory=dict)


class Program(Protocol):
    """Trains, renders the test views, and returns the paths of its output."""

    def missing(self, options: Any) -> str:
        """The command that this machine lacks; empty if all are here.

        Args:
            options: the method's.
        """
        ...

    def run(self, task: Task) -> Produced:
        """Run, or resume a stopped run.

        Raises:
            AwError: it fails, takes too long, or writes no complete output.
        """
        ...


def no_parts(options: Any) -> NoReturn:
    """The recipe of an external method, which has no parts."""
    raise AwError("an external method is a program of its own: it has no parts that fit into another method")
