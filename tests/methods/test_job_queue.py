"""benchmarks/job_queue.py: finished runs are not run again, also after a way through the archive."""

import io
import json
import shlex
import tarfile

import pytest

from ambiguous_wild.core import AwError
from ambiguous_wild.harness.running.store import read_config
from tests.benchmark_scripts import benchmark
from tests.tiny_scene import write_tiny_scene


@pytest.fixture(scope="module")
def queue():
    with benchmark("job_queue") as module:
        yield module


def finish(folder, text):
    folder.mkdir(parents=True)
    for name in ("env.json", "metrics.json"):
        (folder / name).write_text(text + name)
    (folder / "config.yaml").write_text("scene: {path: /data/mine/yard}\n")
    (folder / "point_cloud.ply").write_bytes(b"large")


def runs_of(queue, root):
    return [queue.Run(f"seed {s}", root / "a" / f"seed{s}", "3dgs", ()) for s in (0, 1)]


def test_texts_of_finished_runs_come_back_and_are_not_run_again(queue, tmp_path, capsys):
    runs = runs_of(queue, tmp_path / "here")
    finish(runs[1].folder, "one of /data/mine/yard ")
    archive = tmp_path / "kept.tar.xz"
    queue.keep(tmp_path / "here", archive)
    first = archive.read_bytes()
    queue.keep(tmp_path / "here", archive)
    assert archive.read_bytes() == first

    there = tmp_path / "there"
    assert queue.restore(there, archive) == 1
    again = runs_of(queue, there)
    assert [run.finished for run in again] == [False, True]
    assert sorted(p.name for p in again[1].folder.iterdir()) == ["config.yaml", "env.json", "metrics.json"]
    assert (again[1].folder / "metrics.json").read_text() == "one of yard metrics.json"
    (again[1].folder / "metrics.json").write_text("newer")
    assert queue.restore(there, archive) == 0  # what lies there stays
    assert (again[1].folder / "metrics.json").read_text() == "newer"
    assert queue.run_all(again[1:]) == []
    assert "1 runs: 1 finished before, 0 to go" in capsys.readouterr().out


def test_runs_of_other_settings_are_not_mixed(queue, tmp_path):
    queue.check_settings(tmp_path / "table", iterations=7)
    (tmp_path / "table.json").write_text(json.dumps({"iterations": 7}))
    queue.check_settings(tmp_path / "table", iterations=7, max_gaussians=9)
    with pytest.raises(AwError, match="iterations 7, not 8: give --results"):
        queue.check_settings(tmp_path / "table", iterations=8)


def test_a_failed_run_is_told_and_the_others_go_on(queue, tmp_path, capsys):
    scene, out = write_tiny_scene(tmp_path / "wall"), tmp_path / "runs"
    words = ("--scene", str(scene), "--iterations", "2", "--effects", "none", "--probes", "0", "-o", str(out))
    folder = out / "wall" / "mcmc" / "seed0"
    bad = queue.Run("bad", tmp_path / "bad", "no-such-method", (*words, "--no-pictures"))
    good = queue.Run("good", folder, "mcmc", words, ("start=400",))
    (failed,) = queue.run_all([bad, good])
    assert failed.startswith("bad: ") and "no-such-method" in failed
    said = capsys.readouterr().out
    assert "[2/2]" in said and " dB" in said
    assert read_config(folder)["options"]["start"] == 400


def test_methods_with_the_same_other_words_share_a_process(queue, tmp_path):
    runs = [
        queue.Run(f"{method} {seed}", tmp_path, method, ("--seed", seed), options)
        for seed in "01"
        for method, options in (("3dgs", ()), ("mcmc", ("start=9",)), ("3dgs", ()))
    ]
    first, second, *_ = found = queue.batches(runs)
    assert [[run.name for run in batch] for batch in found] == [
        ["3dgs 0", "mcmc 0"], ["3dgs 0"], ["3dgs 1", "mcmc 1"], ["3dgs 1"]
    ]  # fmt: skip
    assert queue.command(first) == shlex.split(
        "bench --method 3dgs --method mcmc --set mcmc.start=9 --seed 0"
    )
    assert queue.command(second) == shlex.split("bench --method 3dgs --seed 0")
    assert [len(batch) for batch in queue.batches([runs[1]], largest=1)] == [1]


def test_damaged_archives_and_paths_that_leave_are_refused(queue, tmp_path):
    assert queue.restore(tmp_path / "out", tmp_path / "none.tar.xz") == 0
    archive = tmp_path / "kept.tar.xz"
    archive.write_bytes(b"no archive")
    with pytest.raises(AwError, match="cannot read the kept runs"):
        queue.restore(tmp_path / "out", archive)
    with tarfile.open(archive, "w:xz") as tar:
        info = tarfile.TarInfo("../outside/metrics.json")
        info.size = 1
        tar.addfile(info, io.BytesIO(b"x"))
    with pytest.raises(AwError, match="cannot read the kept runs"):
        queue.restore(tmp_path / "out", archive)
    assert not (tmp_path / "outside").exists()
