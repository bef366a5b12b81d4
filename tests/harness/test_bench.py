"""`bench()` from Python: what it reports, what it is told, and what it refuses before anything is trained."""

import json
import subprocess
import sys

import pytest

from ambiguous_wild import bench
from ambiguous_wild.core import AwError
from ambiguous_wild.harness.benchmark import Callbacks, Engine, Lines
from ambiguous_wild.splat.trainer import Trainer


def small(scene, output, **options):
    words = {"iterations": 5, "device": "cpu", "pictures": False, "train": {"probes": 0}}
    return bench("3dgs", scene, output=output, **(words | options))


class Heard(Callbacks):
    def __init__(self):
        self.events = []

    def planned(self, cells, one_by_one):
        self.events.append(("planned", len(cells), one_by_one))

    def started(self, cell, folder):
        self.events.append(("started", cell.train.seed, folder.name))

    def tick(self, trainer):
        self.events.append(("tick", trainer.iteration))

    def ended(self, cell, report):
        self.events.append(("ended", cell.train.seed, report.outcome))


def test_the_report_holds_what_the_files_hold(scene, tmp_path):
    heard = Heard()
    report = small(scene, tmp_path / "runs", seeds=[3], callbacks=heard)
    (run,) = report.runs
    assert (run.method, run.scene, run.seed, run.outcome) == ("3dgs", "scene", 3, "trained")
    assert run.folder == tmp_path / "runs" / "scene" / "3dgs" / "seed3"
    on_disk = json.loads((run.folder / "metrics.json").read_text())
    assert run.result["per_image"] == on_disk["per_image"]
    psnr = [row["psnr"] for row in on_disk["per_image"]]
    assert run.mean("psnr") == pytest.approx(sum(psnr) / 2) and len(psnr) == 2
    assert run.mean("no such metric") is None
    ticks = [("tick", i) for i in range(1, 6)]
    ends = [("ended", 3, "trained")]
    assert heard.events == [("planned", 1, True), ("started", 3, "seed3"), *ticks, *ends]
    assert list(report.read().runs["seed"]) == [3]

    again = small(scene, tmp_path / "runs", seeds=[3])
    assert again.outcomes == {"kept": 1} and again.runs[0].mean("psnr") == run.mean("psnr")


def test_a_run_that_fails_is_in_the_report_and_the_next_one_runs(scene, tmp_path, monkeypatch):
    real, calls = Trainer.step, []

    def breaks(self):
        calls.append(1)
        if len(calls) == 2:
            raise RuntimeError("shapes differ")
        return real(self)

    monkeypatch.setattr(Trainer, "step", breaks)
    lines = []
    report = small(scene, tmp_path / "runs", seeds=[0, 1], effects="none", callbacks=Lines(lines.append))
    assert [run.outcome for run in report.runs] == ["failed", "trained"]
    assert (
        report.failed[0].error.startswith("RuntimeError: shapes differ; traceback: ")
        and report.failed[0].result is None
    )
    assert report.outcomes == {"failed": 1, "trained": 1}
    assert lines[0] == "begins: 3dgs on scene, seed 0"
    assert lines[1].startswith(
        "[1/2] 3dgs on scene, seed 0: failed: RuntimeError: shapes differ; traceback: "
    )
    assert lines[3].startswith("[2/2] 3dgs on scene, seed 1: PSNR ")


def test_the_line_of_a_run_says_that_an_effect_had_no_room(scene, tmp_path):
    heard = [[], []]
    for lines, most in zip(heard, (100, 100_000)):
        train = {"probes": 0, "max_gaussians": most}
        small(scene, tmp_path / str(most), effects="skybox", train=train, callbacks=Lines(lines.append))
    assert "skybox added no point" in heard[0][-1]
    assert "no point" not in heard[1][-1]


def test_several_choices_of_effects_have_a_folder_each(scene, tmp_path):
    report = small(scene, tmp_path / "runs", effects=["none", "exposure"])
    assert report.folders == (tmp_path / "runs/effects-none", tmp_path / "runs/effects-exposure")
    assert [run.effects for run in report.runs] == [(), ("exposure",)]
    (row,) = report.read(report.folders[1]).runs.itertuples()
    assert row.folder == str(report.runs[1].folder)


def test_parts_of_another_method_make_a_graft(scene, tmp_path):
    report = small(scene, tmp_path / "runs", parts={"mask": "truth"})
    assert report.runs[0].method == "3dgs@mask=truth"


def test_several_processes_tell_the_same(scene, tmp_path):
    heard = Heard()
    report = small(scene, tmp_path / "runs", seeds=[0, 1], jobs=2, threads=1, callbacks=heard)
    assert report.outcomes == {"trained": 2}
    assert heard.events[0] == ("planned", 2, False)
    assert sorted(heard.events[1:]) == sorted(
        [("started", 0, "seed0"), ("started", 1, "seed1"), ("ended", 0, "trained"), ("ended", 1, "trained")]
    )


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"budgets_s": [5.0]}, "exclude each other"),
        ({"effects": ["expsure"]}, "did you mean 'exposure'"),
        ({"settings": ["3dgs=1"]}, "METHOD.KEY=VALUE"),
        ({"engine": Engine(address="auto")}, "add --engine ray"),
        ({"parts": {"mask": "refinsplat"}}, "refinesplat"),
    ],
)
def test_what_cannot_be_is_said_before_anything_is_made(scene, tmp_path, options, message):
    with pytest.raises(AwError, match=message):
        small(scene, tmp_path / "runs", **options)
    assert not (tmp_path / "runs").exists()


def test_a_fault_of_the_last_method_is_found_before_the_first_is_trained(scene, tmp_path):
    wrong = ["dronesplat.instances=graph,nonsense=3"]
    with pytest.raises(AwError, match="nonsense"):
        bench(
            ["3dgs", "dronesplat"],
            scene,
            output=tmp_path / "runs",
            iterations=5,
            device="cpu",
            settings=wrong,
        )
    assert not (tmp_path / "runs").exists()


def test_a_misspelt_method_is_answered_without_torch():
    code = (
        "import sys\nfrom ambiguous_wild import bench\n"
        "try:\n    bench('3dsg', 'scene')\nexcept Exception as error:\n    print(error)\n"
        "print([name for name in ('torch', 'numba', 'pandas') if name in sys.modules])\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    said, heavy = done.stdout.splitlines()
    assert "did you mean '3dgs'" in said and heavy == "[]"
