"""Ctrl-C during training: the iteration ends, the model is kept and measured, the run goes on later."""

from __future__ import annotations

import json
import signal
from pathlib import Path

import pytest

from ambiguous_wild.cli import main
from ambiguous_wild.core import AwError
from ambiguous_wild.harness.benchmark import Callbacks, bench
from ambiguous_wild.harness.store import run_folders
from ambiguous_wild.harness.trained_models import find_run_models
from ambiguous_wild.io.ply import read_splat_ply
from ambiguous_wild.splat.training_loop import Stopped, defer_interrupt
from tests.tiny_scene import write_tiny_scene

LENGTH = 30


class PressesAt(Callbacks):
    """Ctrl-C after so many iterations; again while the model is measured, if asked."""

    def __init__(self, iteration: int) -> None:
        self.iteration = iteration

    def tick(self, trainer):
        if trainer.iteration == self.iteration:
            signal.raise_signal(signal.SIGINT)


@pytest.fixture
def ctrl_c():
    """Ctrl-C as a terminal's process answers it."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


@pytest.fixture
def scene(tmp_path: Path) -> Path:
    return write_tiny_scene(tmp_path / "wall")


def train(scene: Path, out: Path, callbacks: Callbacks | None = None):
    return bench(
        "3dgs", scene, output=out, iterations=LENGTH, effects="none", pictures=False, callbacks=callbacks
    )


def test_the_model_is_kept_and_the_same_command_goes_on(tmp_path: Path, scene: Path, ctrl_c: None) -> None:
    with pytest.raises(Stopped, match=f"after 12 iterations of {LENGTH}.* dB over .* test views") as told:
        train(scene, tmp_path / "runs", PressesAt(12))
    run = tmp_path / "runs" / "wall" / "3dgs" / "seed0"
    kept = run / "stopped"
    assert str(kept) in str(told.value) and not (run / "metrics.json").exists()
    measured = json.loads((kept / "measured.json").read_text())
    assert measured["iteration"] == 12 and measured["train_s"] > 0
    assert all(row["psnr"] > 5 for row in measured["per_image"])
    assert len(list((kept / "renders").glob("*.png"))) == len(measured["per_image"])
    assert len(read_splat_ply(kept / "point_cloud.ply")["means"]) > 3
    assert list(run_folders(tmp_path / "runs")) == [run]  # what is kept is no run of its own
    with pytest.raises(AwError, match=f"is not finished: .*its model is {kept / 'point_cloud.ply'}"):
        find_run_models([tmp_path / "runs"])

    (again,) = train(scene, tmp_path / "runs").runs
    (whole,) = train(scene, tmp_path / "whole").runs
    plys = [Path(r.folder) / "point_cloud.ply" for r in (again, whole)]
    assert plys[0].read_bytes() == plys[1].read_bytes()
    assert not kept.exists()


def test_a_second_one_ends_at_once(
    tmp_path: Path, scene: Path, ctrl_c: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    from ambiguous_wild.harness import training

    def pressed(*_: object, **__: object) -> None:
        signal.raise_signal(signal.SIGINT)

    monkeypatch.setattr(training.evaluate, "render_and_measure", pressed)
    with pytest.raises(Stopped, match="to resume") as told:
        train(scene, tmp_path / "runs", PressesAt(5))
    run = tmp_path / "runs" / "wall" / "3dgs" / "seed0"
    assert "dB" not in str(told.value) and not (run / "stopped").exists()
    assert not [p for p in run.iterdir() if "stopped" in p.name]
    assert (run / "checkpoint" / "last.safetensors").is_file()


def test_the_command_says_what_it_kept(ctrl_c: None, monkeypatch: pytest.MonkeyPatch, capsys) -> None:
    def bench_that_is_stopped(*args: object, **kwargs: object) -> None:
        raise Stopped("stopped after 3 iterations of 9")

    monkeypatch.setattr("click.core.Context.invoke", bench_that_is_stopped)
    monkeypatch.setattr("sys.argv", ["aw", "methods"])
    with pytest.raises(SystemExit) as ended:
        main.main()
    assert ended.value.code == 130 and "stopped after 3 iterations of 9" in capsys.readouterr().err


def test_only_the_main_thread_and_the_default_answer_are_touched() -> None:
    def other(number, frame):
        raise AssertionError

    before = signal.signal(signal.SIGINT, other)
    try:
        with defer_interrupt() as interrupted:
            assert signal.getsignal(signal.SIGINT) is other and not interrupted()
    finally:
        signal.signal(signal.SIGINT, before)
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        with defer_interrupt() as interrupted:
            signal.raise_signal(signal.SIGINT)
            assert interrupted()
            with pytest.raises(KeyboardInterrupt):
                signal.raise_signal(signal.SIGINT)
        assert signal.getsignal(signal.SIGINT) is signal.default_int_handler
    finally:
        signal.signal(signal.SIGINT, before)
