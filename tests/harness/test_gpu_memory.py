"""A GPU that is too small is one line of the run, not a traceback."""

import pytest
import torch

from ambiguous_wild.core import AwError
from ambiguous_wild.harness import training
from ambiguous_wild.harness.cell import RunOptions
from ambiguous_wild.harness.grid import plan_cells, run_cells
from ambiguous_wild.harness.result_file import read_result
from ambiguous_wild.harness.run_cost import is_out_of_gpu_memory, out_of_gpu_memory
from ambiguous_wild.splat.train_config import TrainConfig
from ambiguous_wild.splat.trainer import Trainer
from tests.tiny_scene import write_tiny_scene

SAID = "CUDA out of memory. Tried to allocate 2.50 GiB. GPU 0 has a total capacity of 8.00 GiB of which"


@pytest.mark.parametrize(
    ("error", "is_it"),
    [
        (torch.OutOfMemoryError(SAID), True),
        (RuntimeError(SAID), True),  # of an extension that was built by itself
        (RuntimeError("CUDA error: out of memory"), True),
        (RuntimeError("shapes differ"), False),
        (MemoryError("CUDA out of memory"), False),
        (AwError("CUDA out of memory"), False),
    ],
)
def test_which_errors_are_of_a_gpu_without_memory(error, is_it):
    assert is_out_of_gpu_memory(error) is is_it


def test_what_helps_is_said_with_the_numbers_of_the_run():
    assert str(out_of_gpu_memory(torch.OutOfMemoryError(SAID), 3_000_000, 2)) == (
        "out of GPU memory with 3,000,000 Gaussians, tried to allocate 2.50 GiB; what helps: "
        "--max-gaussians 1500000, --factor 4 (smaller photos, where the scene has them), a GPU with more "
        "memory, or no other program on this one"
    )
    early = str(out_of_gpu_memory(RuntimeError("CUDA error: out of memory"), None, None))
    assert early.startswith("out of GPU memory; what helps: --factor 2 (")


@pytest.mark.parametrize("where", ["step", "load_train_data", "__init__"])
def test_the_cell_fails_with_one_line_and_the_next_one_runs(where, tmp_path, monkeypatch):
    scene = write_tiny_scene(tmp_path / "scene")
    cells = plan_cells(["3dgs"], [scene], [0, 1], TrainConfig(iterations=5, probes=0))
    owner = training if where == "load_train_data" else Trainer
    real, calls = getattr(owner, where), []

    def full(*words, **options):
        calls.append(1)
        if len(calls) == (3 if where == "step" else 1):
            raise torch.OutOfMemoryError(SAID)
        return real(*words, **options)

    monkeypatch.setattr(owner, where, full)
    first, second = run_cells(
        cells, tmp_path / "runs", RunOptions(tmp_path / "runs" / ".cache", pictures=False)
    )
    assert second.outcome == "trained" and first.outcome == "failed"
    gaussians = " with 400 Gaussians" if where == "step" else ""
    assert first.error.startswith(f"out of GPU memory{gaussians}, tried to allocate 2.50 GiB; what helps: ")
    assert ("--max-gaussians 200" in first.error) is (where == "step") and "\n" not in first.error
    assert read_result(first.folder / "failed.json")["error"] == first.error
    assert not (first.folder / "traceback.txt").exists()


def test_any_other_error_keeps_its_traceback(tmp_path, monkeypatch):
    cells = plan_cells(["3dgs"], [write_tiny_scene(tmp_path / "scene")], [0], TrainConfig(iterations=5))

    def wrong(self):
        raise RuntimeError("shapes differ")

    monkeypatch.setattr(Trainer, "step", wrong)
    (report,) = run_cells(cells, tmp_path / "runs", RunOptions(tmp_path / "runs" / ".cache", pictures=False))
    assert report.error.startswith("RuntimeError: shapes differ; traceback: ")
    assert "in wrong" in (report.folder / "traceback.txt").read_text()
