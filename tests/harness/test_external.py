"""External programs as cells: the adapter runs a real one, NerfBaselines a stand-in that writes its files."""

import contextlib
import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
import yaml
from click.testing import CliRunner

from ambiguous_wild.cli.bench import command as bench
from ambiguous_wild.core import AwError
from ambiguous_wild.harness.grid import plan_cells, run_cells
from ambiguous_wild.harness.result_file import read_result
from ambiguous_wild.harness.store import read_runs
from ambiguous_wild.io.images import read_png_rgb
from ambiguous_wild.io.ply import write_splat_ply
from ambiguous_wild.methods import registry
from ambiguous_wild.methods.external_process import end_left_over
from ambiguous_wild.metrics.image import psnr
from ambiguous_wild.splat.train_config import TrainConfig
from tests.tiny_scene import TEST, TRAIN, write_tiny_scene

PROGRAM = Path(__file__).parents[1] / "methods" / "external_program.py"
SHORT = TrainConfig(iterations=7)
BASE = {
    "name": "nearest",
    "prefix": [sys.executable, str(PROGRAM)],
    "train": "train --scene {scene} --output {output} --images {images} "
    "--seed {seed} --iterations {iterations}",
    "render": ["render", "--scene", "{scene}", "--output", "{output}"],
    "renders": "{output}/test/ours_*/renders/{index:05d}.png",
    "scene_files": {"sparse/0/test.txt": "{test_names}"},
}


def describe(folder, **changes):
    path = folder / "nearest.yaml"
    path.write_text(yaml.safe_dump(BASE | changes))
    return f"external:{path}"


def run(reference, scene, output, train=SHORT, **kw):
    (cell,) = plan_cells([reference], [scene], [3], train, **kw)
    (report,) = run_cells([cell], output)
    return cell, report


def files(folder):
    return {p.relative_to(folder): p.read_bytes() for p in sorted(folder.rglob("*")) if p.is_file()}


def test_a_program_is_a_cell_like_any_other(scene, tmp_path):
    splats = tmp_path / "splats.ply"
    rng = np.random.default_rng(0)
    shapes = {"means": 3, "quats": 4, "log_scales": 3, "sh0": 3}
    arrays = {k: rng.normal(size=(5, n)).astype(np.float32) for k, n in shapes.items()}
    write_splat_ply(
        splats, arrays | {"opacity_logits": np.zeros(5, np.float32), "sh_rest": np.zeros((5, 0, 3))}
    )
    before = files(scene)
    reference = describe(
        tmp_path,
        train=[*BASE["train"].split(), "--splats", str(splats)],
        render=[*BASE["render"], "--truth", "{source}/truth/distractor"],
        masks="{output}/masks/{stem}.png",
        ply="{output}/splats.ply",
    )
    _, report = run(reference, scene, tmp_path / "runs")
    assert report.outcome == "trained", report.error
    assert report.folder == tmp_path / "runs" / "scene" / "nearest" / "seed3"
    result = read_result(report.folder / "metrics.json")
    for row in result["per_image"]:
        drawn = read_png_rgb(report.folder / "renders" / "test" / row["name"])
        assert row["psnr"] == pytest.approx(psnr(drawn, read_png_rgb(scene / "images" / row["name"])))
        # the nearest photo, pixel for pixel
        assert any(np.array_equal(drawn, read_png_rgb(scene / "images" / name)) for name in TRAIN)
    assert result["masks"]["iou"] == 1.0
    assert result["cost"]["gaussians"] == 5
    assert result["cost"]["iterations"] == 7
    assert result["cost"]["train_s"] > 0
    assert result["facts"]["not_told"] == []
    assert json.loads((report.folder / "external/output/state.json").read_text())["seed"] == 3
    assert files(scene) == before  # the program wrote into its scene folder, and that was a copy
    assert not (report.folder / ".scene").exists()
    assert run(reference, scene, tmp_path / "runs")[1].outcome == "kept"
    table = read_runs(tmp_path / "runs").runs
    assert list(table["method"]) == ["nearest"]


def test_of_half_test_photos_the_pictures_of_a_program_are_measured_as_they_are(scene, tmp_path):
    _, report = run(describe(tmp_path), scene, tmp_path / "runs", protocol="half")
    assert report.outcome == "trained", report.error
    result = read_result(report.folder / "metrics.json")
    assert len(result["per_image"]) == len(TEST)
    for row in result["per_image"]:
        drawn = read_png_rgb(report.folder / "renders" / "test" / row["name"])
        photo = read_png_rgb(scene / "images" / row["name"])
        right = slice(photo.shape[1] // 2, None)
        halves = (np.ascontiguousarray(picture[:, right]) for picture in (drawn, photo))
        assert row["psnr"] == pytest.approx(psnr(*halves))


def test_options_and_variables_reach_the_program_and_are_part_of_the_run(scene, tmp_path):
    reference = describe(tmp_path, options={"gain": 1.0}, environment={"GAIN": "{gain}"})
    plain, _ = run(reference, scene, tmp_path / "a")
    dark, report = run(reference, scene, tmp_path / "b", settings=["nearest.gain=0.5"])
    assert report.outcome == "trained", report.error
    assert plain.identity != dark.identity
    means = [read_png_rgb(tmp_path / d / "scene/nearest/seed3/renders/test/test_0.png").mean() for d in "ab"]
    assert means[1] == pytest.approx(means[0] / 2, rel=0.02)


def test_what_changes_the_result_changes_the_identity_and_nothing_else_does(scene, tmp_path):
    def identity(**changes):
        registry.registered.clear()
        return plan_cells([describe(tmp_path, **changes)], [scene], [0], SHORT)[0].identity

    assert identity() == identity(summary="words", timeout_h=3.0)
    assert identity() != identity(render=[*BASE["render"], "--half-size"])
    named = ["python", "own.py", str(tmp_path / "log")]
    by_script = [identity(prefix=named)]  # no such file yet: as in earlier versions
    for code, log in (("first", "a"), ("second", "a"), ("second", "b")):
        (tmp_path / "own.py").write_text(code)
        (tmp_path / "log").write_text(log)
        by_script.append(identity(prefix=named))
    assert len(set(by_script)) == 3 and by_script[2] == by_script[3]


def test_a_failure_is_the_result_and_says_the_last_lines_of_its_log(scene, tmp_path):
    reference = describe(tmp_path, train=BASE["train"] + " --stop-after-start")
    _, report = run(reference, scene, tmp_path / "runs")
    assert report.outcome == "failed"
    assert "train of nearest ended with exit code 3" in report.error
    assert "100% | out of luck" in report.error
    assert "\r" not in report.error
    failed = read_result(report.folder / "failed.json")
    assert failed["status"] == "failed" and failed["error"] == report.error
    assert "out of luck" in (report.folder / "logs/train.log").read_text()


def test_a_program_that_cannot_say_its_version_is_not_trained(scene, tmp_path):
    _, report = run(describe(tmp_path, version="--version"), scene, tmp_path / "runs")
    assert report.outcome == "failed"
    assert "version of nearest ended with exit code 2; last lines of" in report.error
    assert "usage: external_program.py" in (report.folder / "logs/version.log").read_text()
    assert not (report.folder / "logs/train.log").exists()
    _, report = run(describe(tmp_path, version="--help"), scene, tmp_path / "runs")
    assert report.outcome == "trained", report.error  # the same run


def test_a_run_that_stopped_goes_on_with_what_is_done(scene, tmp_path):
    run(describe(tmp_path, render=["render", "--nonsense"]), scene, tmp_path / "runs")
    folder = tmp_path / "runs/scene/nearest/seed3"
    assert (folder / "failed.json").exists()
    # The same run, its render mended from outside: training is not repeated.
    registry.registered.clear()
    (cell,) = plan_cells([describe(tmp_path)], [scene], [3], SHORT)
    config = yaml.safe_load((folder / "config.yaml").read_text())
    (folder / "config.yaml").write_text(yaml.safe_dump(config | {"config_hash": cell.identity}))
    (report,) = run_cells([cell], tmp_path / "runs")
    assert report.outcome == "trained", report.error
    assert (folder / "external/output/trained.txt").read_text() == "once\n"
    assert report.result["cost"]["train_s"] > 0


def test_a_description_that_never_trained_may_be_mended(scene, tmp_path):
    assert (
        run(describe(tmp_path, prefix=["no-such-program"]), scene, tmp_path / "runs")[1].outcome == "failed"
    )
    registry.registered.clear()
    cell, report = run(describe(tmp_path), scene, tmp_path / "runs")
    assert report.outcome == "trained", report.error
    registry.registered.clear()
    with pytest.raises(AwError, match="another configuration"):  # now there is something to lose
        run(describe(tmp_path, renders=BASE["renders"].replace("*", "7")), scene, tmp_path / "runs")
    assert read_result(report.folder / "metrics.json")["config_hash"] == cell.identity


def test_a_resume_command_takes_over_where_something_lies(scene, tmp_path):
    reference = describe(tmp_path, train=BASE["train"] + " --stop-after-start", resume=BASE["train"])
    assert run(reference, scene, tmp_path / "runs")[1].outcome == "failed"
    _, report = run(reference, scene, tmp_path / "runs")
    assert report.outcome == "trained", report.error
    assert (report.folder / "external/output/begun").exists()
    # the time before the stop is not known
    assert not {"train_s", "ms_per_iteration", "reference_s"} & report.result["cost"].keys()


def test_effects_that_no_method_takes_are_refused(scene, tmp_path):
    words = ["--method", describe(tmp_path), "--scene", str(scene.root), "--effects", "exposure"]
    refused = CliRunner().invoke(bench, [*words, "-o", str(tmp_path / "runs")]).exception
    assert isinstance(refused, AwError) and "--effects exposure would not be used by nearest" in str(refused)
    assert not (tmp_path / "runs").exists()


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"render": [*BASE["render"], "--half-size"]}, "is 32x24, its photo test_0.png 64x48"),
        ({"renders": "{output}/{stem}.png"}, "left no render of 2 of 2 test photos"),
        ({"renders": "{output}/*{index:.0s}"}, "cannot be filled in"),
        ({"renders": "{output}/test/ours_7/renders/0*{name:.0}.png"}, "2 files fit"),
        (
            {
                "render": [*BASE["render"], "--suffix", ".jpg"],
                "renders": BASE["renders"].replace("png", "jpg"),
            },
            "is no PNG",
        ),
        (
            {"train": ["train", "--sleep", "60", *BASE["train"].split()[1:]], "timeout_h": 0.2 / 3600},
            "took longer",
        ),
        ({"prefix": ["no-such-program"]}, "there is no program 'no-such-program'"),
    ],
)
def test_what_a_program_leaves_wrong_is_one_clear_line(scene, tmp_path, changes, message):
    _, report = run(describe(tmp_path, **changes), scene, tmp_path / "runs")
    assert report.outcome == "failed"
    assert message in report.error


@pytest.mark.parametrize(
    ("changes", "word"),
    [
        ({"prefix": ["no-such-program", "run"]}, "no-such-program"),
        ({"prefix": [], "train": "./train.sh"}, "./train.sh"),  # may not be executed
        ({"prefix": [], "train": "{tool} {scene}", "options": {"tool": "no-such-tool"}}, "no-such-tool"),
        ({"prefix": [], "render": "no-renderer", "train": f"{sys.executable} x"}, "no-renderer"),
        ({"prefix": ["echo"], "environment": {"PATH": "/nowhere"}}, "echo"),
    ],
)
def test_a_program_that_is_not_here_is_told_before_anything_is_trained(scene, tmp_path, changes, word):
    (tmp_path / "train.sh").write_text("#!/bin/sh")
    reference = describe(tmp_path, needs="the program nearest on PATH", **changes)
    output = tmp_path / "runs"
    arguments = ["--method", "3dgs", "--method", reference, "--scene", str(scene), "--iterations", "3"]
    result = CliRunner().invoke(bench, [*arguments, "-o", str(output)])
    assert isinstance(result.exception, AwError), result.output
    assert f"nearest needs the program nearest on PATH: there is no program {word!r}" in str(result.exception)
    assert not output.exists()


@pytest.mark.parametrize(
    "changes",
    [
        {},
        {"prefix": [], "train": "./train.sh"},
        {"prefix": [], "train": "{output}/x", "render": "echo"},  # known when it runs
        {"prefix": ["train.sh"], "environment": {"PATH": "{bin}"}, "options": {"bin": "."}},
    ],
)
def test_a_program_that_is_here_is_found(tmp_path, changes):
    script = tmp_path / "train.sh"
    script.write_text("#!/bin/sh")
    script.chmod(0o755)
    changes = {"render": ""} | changes if changes else changes
    if "options" in changes:
        changes = changes | {"options": {"bin": str(tmp_path)}}
    entry = registry.get_method(describe(tmp_path, **changes))
    assert entry.program.missing(entry.options()) == ""


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"trian": "x"}, "did you mean 'train'"),
        ({"train": "x {sed}"}, "did you mean 'seed'"),
        ({"train": "x {seed.__class__}"}, "is no placeholder"),
        ({"train": "x {seed"}, "write {{"),
        ({"train": 'x "'}, "No closing quotation"),
        ({"renders": "{output}/all.png"}, "one file a test photo"),
        ({"renders": ""}, "does not say renders"),
        ({"name": "../x"}, "holds '/'"),
        ({"name": "3dgs"}, "so is another method"),
        ({"options": {"seed": 1}}, "option 'seed'"),
        ({"options": {"a": [1]}}, "needs a text"),
        ({"cwd": "nowhere"}, "is no folder"),
        ({"scene_files": {"a": "{photos}"}}, "placeholder in"),
    ],
)
def test_a_description_with_a_mistake_is_one_clear_line(tmp_path, changes, message):
    with pytest.raises(AwError, match=r"(?s).*") as error:
        registry.get_method(describe(tmp_path, **changes))
    assert message in str(error.value)
    assert "\n" not in str(error.value)


def test_files_for_the_scene_stay_in_the_copy(scene, tmp_path):
    for name in ("../out.txt", "images/new.txt", "/tmp/out.txt"):
        registry.registered.clear()
        _, report = run(describe(tmp_path, scene_files={name: "x"}), scene, tmp_path / name.replace("/", "_"))
        assert "lies outside the copy" in report.error
    assert not (scene / "images" / "new.txt").exists()


def test_values_stay_within_their_argument(scene, tmp_path):
    """No shell: a folder called like a command is a name and nothing else."""
    hostile = tmp_path / "s; touch pwned $(touch pwned) {seed} *"
    scene = write_tiny_scene(hostile / "scene")
    _, report = run(describe(tmp_path, cwd=str(tmp_path)), scene, hostile / "runs")
    assert report.outcome == "trained", report.error
    assert not (tmp_path / "pwned").exists()


def test_a_toml_file_says_the_same(tmp_path):
    path = tmp_path / "nearest.toml"
    lines = [f"{key} = {json.dumps(BASE[key])}" for key in BASE if key != "scene_files"]
    path.write_text("\n".join([*lines, "[scene_files]", '"sparse/0/test.txt" = "{test_names}"']))
    assert (
        registry.get_method(f"external:{path}").source_hash
        == registry.get_method(describe(tmp_path)).source_hash
    )


def test_effects_are_not_taken_and_budgets_refused(scene, tmp_path):
    _, report = run(describe(tmp_path), scene, tmp_path / "a", effects="exposure")
    assert report.outcome == "trained" and report.result["facts"]["no_effects"]
    (row,) = read_runs(tmp_path / "a").runs.itertuples()
    assert row.effects == "none: an external program takes none"
    _, report = run(describe(tmp_path), scene, tmp_path / "b", train=TrainConfig(budget_s=5.0))
    assert "give --iterations" in report.error


def test_what_was_started_ends_with_us(tmp_path):
    """On Ctrl-C at once; after kill -9 when the run goes on, so that no two work in one folder."""
    code = (
        # a shell that runs us in the background has told its children to ignore Ctrl-C
        "import signal; signal.signal(signal.SIGINT, signal.default_int_handler); "
        "from pathlib import Path; from ambiguous_wild.methods.external_process import run_logged; "
        f"run_logged('x', ['sh', '-c', 'sleep 60 & wait'], log=Path({str(tmp_path / 'x.log')!r}), "
        "cwd=Path('.'), environment={}, timeout_s=None)"
    )
    record = tmp_path / "x.running.json"
    for sign in (signal.SIGINT, signal.SIGKILL):
        process = subprocess.Popen([sys.executable, "-c", code], stderr=subprocess.DEVNULL)
        deadline = time.monotonic() + 60
        while not record.exists() and time.monotonic() < deadline:
            time.sleep(0.01)
        group = json.loads(record.read_text())["group"]
        os.kill(process.pid, sign)
        process.wait(30)
        assert _lives(group) == record.exists() == (sign == signal.SIGKILL)
    end_left_over(tmp_path)
    assert not _lives(group) and not record.exists()


def _lives(group):
    """Whether any process of the group runs; one that ended and that nobody has asked about does not."""
    states = []
    for path in Path("/proc").glob("[0-9]*/stat"):
        with contextlib.suppress(OSError):
            words = path.read_text().rpartition(")")[2].split()
            states += [words[0]] if int(words[2]) == group else []
    return any(state != "Z" for state in states)


def test_as_it_is_typed(scene, tmp_path):
    words = ["--method", describe(tmp_path), "--scene", scene, "-o", tmp_path / "runs", "--iterations", "7"]
    done = CliRunner().invoke(bench, [str(w) for w in words], catch_exceptions=False)
    assert done.exit_code == 0, done.output
    assert "nearest on scene, seed 0" in done.output
    assert f"over {len(TEST)} test views" in done.output
