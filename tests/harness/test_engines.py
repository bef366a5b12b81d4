"""Cells in processes and on Ray are the cells of one process, also where a worker is killed in the middle."""

import importlib.util
import json
import sys
from dataclasses import replace
from pathlib import Path

import pytest
import yaml
from click.testing import CliRunner

from ambiguous_wild.cli.bench import command as bench
from ambiguous_wild.core import AwError
from ambiguous_wild.harness import job as jobs
from ambiguous_wild.harness.cell import CellReport, RunOptions
from ambiguous_wild.harness.cell_run import existing_outcome
from ambiguous_wild.harness.grid import cell_folder, plan_cells
from ambiguous_wild.harness.ray_cluster import PackedReport, run_sent, send_scene, unpack_report
from ambiguous_wild.harness.result_file import read_result
from ambiguous_wild.harness.session import run_in_processes
from ambiguous_wild.io.archive import pack_folder
from ambiguous_wild.methods import registry
from ambiguous_wild.splat.train_config import TrainConfig
from tests.tiny_scene import write_tiny_scene

SHORT = TrainConfig(iterations=40)
NEEDS_RAY = pytest.mark.skipif(importlib.util.find_spec("ray") is None, reason="needs the extra [ray]")
# Writes the renders of its seed, and in the middle kills whoever started it, as often as a file says.
FRAIL = """
import os, shutil, signal, sys
from pathlib import Path

images, output, seed, deaths = Path(sys.argv[1]), Path(sys.argv[2]), int(sys.argv[3]), Path(sys.argv[4])
photos = sorted(images.glob("train*"))
shutil.copy(photos[seed], output / "0.png")
left = int(deaths.read_text()) if seed == 1 else 0
if left:
    deaths.write_text(str(left - 1))
    os.kill(os.getppid(), signal.SIGKILL)
shutil.copy(photos[seed + 1], output / "1.png")
"""


@pytest.fixture(scope="module")
def frail(tmp_path_factory):
    """A method's reference, and the file that says how often it kills its worker."""
    folder = tmp_path_factory.mktemp("method")
    deaths = folder / "deaths"
    deaths.write_text("0")
    (folder / "frail.py").write_text(FRAIL)
    train = [sys.executable, "-S", "frail.py", "{scene}/{images}", "{output}", "{seed}", str(deaths)]
    description = {"name": "frail", "train": train, "renders": "{output}/{index}.png"}
    (folder / "frail.yaml").write_text(yaml.safe_dump(description))
    return f"external:{folder / 'frail.yaml'}", deaths


def aw_bench(output, scene, method, *words):
    arguments = ["--method", method, "--scene", scene, "--seed", 0, "--seed", 1, "--seed", 2]
    arguments += ["--iterations", 40, "-o", output, *words]
    return CliRunner().invoke(bench, [str(a) for a in arguments])


@pytest.fixture(scope="module")
def local(scene, frail, tmp_path_factory):
    """The same grid in one process, undisturbed."""
    output = tmp_path_factory.mktemp("local")
    done = aw_bench(output, scene, frail[0])
    assert done.exit_code == 0, done.output
    registry.registered.clear()
    return results(output)


def results(output):
    """Everything that must not depend on where a cell ran, by path below the output."""
    kept = {}
    for path in sorted(output.rglob("*")):
        name = path.relative_to(output).as_posix()
        if path.is_dir() or any(part.startswith(".") for part in path.relative_to(output).parts):
            continue
        if path.name == "metrics.json":
            kept[name] = {k: v for k, v in json.loads(path.read_text()).items() if k != "cost"}
        elif path.name == "config.yaml":
            config = yaml.safe_load(path.read_text())
            config["scene"].pop("path")
            kept[name] = config
        elif path.suffix in (".png", ".ply"):
            kept[name] = path.read_bytes()
        else:
            kept[name] = None  # times, versions, moments: there, and that is all
    return kept


def test_processes_one_killed_in_the_middle_give_what_one_process_gives(scene, frail, local, tmp_path):
    frail[1].write_text("1")
    done = aw_bench(tmp_path, scene, frail[0], "--jobs", 2)
    assert done.exit_code == 0, done.output
    assert frail[1].read_text() == "0"
    assert results(tmp_path) == local
    assert len([name for name in local if name.endswith("metrics.json")]) == 3
    assert done.output.count("begins: frail on scene") == 4
    assert "[3/3] frail on scene" in done.output and "3 runs: 3 trained" in done.output


@pytest.mark.slow
@NEEDS_RAY
def test_ray_one_worker_killed_in_the_middle_gives_what_one_process_gives(scene, frail, local, tmp_path):
    frail[1].write_text("1")
    done = aw_bench(tmp_path, scene, frail[0], "--engine", "ray", "--jobs", 2)
    assert done.exit_code == 0, done.output
    assert frail[1].read_text() == "0"
    assert results(tmp_path) == local
    assert "Ray: 1 node, 2 CPU" in done.output and "3 runs: 3 trained" in done.output
    assert list(tmp_path.glob(".aw-shared-*")) == []


@pytest.fixture
def cell(scene, frail, tmp_path):
    """A cell that is never trained here, and its job."""
    (cell,) = plan_cells([frail[0]], [scene], [0], SHORT)
    return cell, job_of(cell, frail[0], tmp_path)


def job_of(cell, method, folder):
    sources = jobs.read_sources([], [method])
    return jobs.make_job(cell, cell_folder(folder / "runs", cell), RunOptions(folder / "c"), sources)


def test_a_plugin_with_a_recipe_travels_as_a_method(tmp_path):
    (tmp_path / "own.py").write_text("def mine(): ...\n")
    (source,) = jobs.read_sources([tmp_path / "own.py:mine"], [])
    assert (source.kind, source.text) == ("method", f"{tmp_path}/own.py:mine")
    assert (source.path, source.content) == (str(tmp_path / "own.py"), b"def mine(): ...\n")


def test_a_cell_that_kills_every_process_is_a_failure(cell):
    cell, job = cell
    killer = jobs.CodeSource(
        "killer.py", "plugin", "/nowhere/killer.py", b"import os; os.kill(os.getpid(), 9)"
    )
    folder = Path(job.folder)
    folder.mkdir(parents=True)
    (report,) = run_in_processes(
        [replace(job, sources=(killer,))], 2, 0, lambda index, reason: jobs.record_lost(cell, folder, reason)
    )  # fmt: skip
    assert (report.outcome, report.error) == ("failed", "its process was killed by signal 9, 1 times")
    assert read_result(folder / "failed.json")["error"] == report.error


def test_a_job_makes_the_same_cell_without_the_files_of_its_method(cell, scene, tmp_path):
    def elsewhere(job):
        registry.registered.clear()
        sources = [replace(s, path=f"/nowhere/{Path(s.path).name}") for s in job.sources]
        return jobs.make_cell(replace(job, sources=tuple(sources)))

    with pytest.raises(AwError, match="a file of the method differs there"):  # frail.py does not travel
        elsewhere(cell[1])
    own = tmp_path / "own.py"
    own.write_text(
        "from ambiguous_wild.splat.method_hooks import MethodHooks\ndef own(): return MethodHooks()\n"
    )
    (cell,) = plan_cells([f"{own}:own"], [scene], [0], SHORT)
    again = elsewhere(job_of(cell, f"{own}:own", tmp_path))
    assert again.identity == cell.identity
    assert again.options == cell.options and again.train == cell.train


def test_what_differs_where_it_runs_is_refused(cell, tmp_path):
    _, job = cell
    other = write_tiny_scene(tmp_path / "other", distractors=False)
    (other / "test_list.txt").write_text("test_0.png\n")
    assert "the code of ambiguous_wild differs" in jobs.run_job(replace(job, code="x")).error
    assert "would be another run" in jobs.run_job(replace(job, scene=str(other))).error
    changed = [replace(s, content=s.content + b"\nenvironment: {A: b}\n") for s in job.sources]
    registry.registered.clear()
    assert "would be another run" in jobs.run_job(replace(job, sources=tuple(changed))).error
    with pytest.raises(AwError, match=r"cannot see .*--set engine.transfer=store"):
        jobs.check_storage(replace(job, token=str(tmp_path / "absent")), wait_s=0.0)


def test_a_scene_travels_and_a_run_folder_comes_back(scene, tmp_path, monkeypatch):
    """Without Ray: what a node does, in this process."""
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path / "node"))
    (tmp_path / "node").mkdir()
    method = tmp_path / "copy.yaml"
    copy = "cp {scene}/{images}/train_0.png {output}/0.png && cp {output}/0.png {output}/1.png"
    method.write_text(
        yaml.safe_dump({"name": "copy", "renders": "{output}/{index}.png", "train": ["sh", "-c", copy]})
    )
    (cell,) = plan_cells([f"external:{method}"], [scene], [0], SHORT)
    sources = jobs.read_sources([], [f"external:{method}"])
    job = jobs.make_job(cell, cell_folder(tmp_path / "runs", cell), RunOptions(tmp_path / "c"), sources)
    assert existing_outcome(Path(job.folder), "missing", job.config) is None
    key, content = send_scene(scene, 10.0)
    for _ in range(2):  # the second finds the scene unpacked
        report = unpack_report(run_sent(job, key, content, 10.0), job, 10.0)
        assert report.outcome == "trained", report.error
    assert report.folder == Path(job.folder)
    assert read_result(report.folder / "metrics.json")["config_hash"] == cell.identity
    assert (report.folder / "renders/test/test_0.png").is_file()
    assert existing_outcome(report.folder, "missing", job.config) == "kept"
    assert existing_outcome(report.folder, "always", job.config) is None
    assert existing_outcome(report.folder, "changed", job.config) == "kept"
    assert existing_outcome(report.folder, "changed", {**job.config, "source": "0" * 64}) is None
    assert [p.name for p in (tmp_path / "node").rglob("scene")] == ["scene"]
    assert list((tmp_path / "node").rglob("run-*")) == []
    (report.folder / "notes.txt").write_text("mine")
    again = unpack_report(run_sent(job, key, content, 10.0), job, 10.0)
    assert again.outcome == "trained" and (report.folder / "notes.txt").read_text() == "mine"
    (report.folder / "metrics.json").unlink()
    (report.folder / "checkpoint").mkdir()
    node = tmp_path / "node" / "failed"
    node.mkdir()
    for name in ("failed.json", "config.yaml"):
        (node / name).write_text(name)
    (report.folder / "failed.json").write_text("of the attempt before")
    failed = PackedReport(CellReport(report.folder, "failed", error="no memory"), pack_folder(node, 1.0))
    before = (report.folder / "config.yaml").read_bytes()
    assert unpack_report(failed, job, 10.0).outcome == "failed"
    assert (report.folder / "checkpoint").is_dir() and (report.folder / "notes.txt").is_file()
    assert (report.folder / "failed.json").read_text() == "failed.json"
    assert (report.folder / "config.yaml").read_bytes() == before
    with pytest.raises(AwError, match=r"engine\.transfer_limit"):
        send_scene(scene, 0.001)


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--address", "auto"], "--address is for a cluster: add --engine ray"),
        (["--set", "engine.gpus_per_cell=1", "--set", "engine.cpus_per_cell=2"],
         "--set engine.cpus_per_cell, --set engine.gpus_per_cell is for"),
        (["--set", "engine.transfer=store"], "--set engine.transfer is for a cluster"),
        (["--jobs", "0"], "--jobs"),
        (["--set", "engine.retries=-1"], "setting retries is at least 0"),
        (["--set", "engine.memory_per_cell=4"], "--set engine.memory_per_cell is for a cluster"),
        (["--set", "engine.retrys=1"], "did you mean 'engine.retries'?"),
        (["--engine", "slurm"], "'local', 'ray'"),
        pytest.param(
            ["--engine", "ray", "--address", "auto", "--jobs", "2"], "--jobs is for this machine",
            marks=NEEDS_RAY,
        ),
        pytest.param(
            ["--engine", "ray", "--set", "engine.transfer=store", "--overwrite", "longer"], "does not send",
            marks=NEEDS_RAY,
        ),
        pytest.param(
            ["--engine", "ray", "--set", "engine.transfer=store", "--start", __file__],
            "--start needs a file that", marks=NEEDS_RAY,
        ),
    ],
)  # fmt: skip
def test_what_does_not_go_together_is_refused(scene, tmp_path, words, message):
    done = aw_bench(tmp_path / "runs", scene, "3dgs", *words)
    said = done.output + str(done.exception)
    assert done.exit_code != 0 and message in said
    assert not (tmp_path / "runs").exists()


def test_jobs_do_not_go_with_a_cluster_that_the_environment_names(scene, tmp_path, monkeypatch):
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: True)
    monkeypatch.setenv("RAY_ADDRESS", "auto")
    done = aw_bench(tmp_path / "runs", scene, "3dgs", "--engine", "ray", "--jobs", "2")
    assert done.exit_code != 0 and "--jobs is for this machine" in done.output + str(done.exception)


def test_without_ray_the_command_that_brings_it_is_said(scene, tmp_path, monkeypatch):
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    done = aw_bench(tmp_path / "runs", scene, "3dgs", "--engine", "ray")
    assert isinstance(done.exception, AwError) and "pip install" in str(done.exception)
    assert "[ray]" in str(done.exception)
