"""A metric of one's own, from a file or a package: measured, kept with the run, tabulated; faults named."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace

import pytest

from ambiguous_wild.core import AwError
from ambiguous_wild.harness import measures
from ambiguous_wild.harness.benchmark import bench
from ambiguous_wild.harness.measures import Metric, load_metrics, measure, metrics
from ambiguous_wild.harness.result_file import read_result
from ambiguous_wild.io.images import read_png_rgb
from ambiguous_wild.methods.references import hash_of_package
from tests.command_line import aw
from tests.report.board_runs import write_run
from tests.tiny_scene import write_tiny_scene

OWN = """
from ambiguous_wild import Metric

def grey_error(render, photo):
    return abs(float(render.mean()) - float(photo.mean())) * 1

GREY = Metric("grey_error", "grey error", "lower", 1, unit="levels", function=grey_error)
CONTRAST = Metric("contrast", "contrast", "higher", function=lambda render: render.std(), needs=())
"""


@pytest.fixture(autouse=True)
def forgotten(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    monkeypatch.setattr(measures, "own_metrics", {})
    measures._installed.cache_clear()
    yield
    measures._installed.cache_clear()


@pytest.fixture
def own(tmp_path: Path) -> Path:
    path = tmp_path / "my_metric.py"
    path.write_text(OWN)
    return path


def test_it_is_measured_and_stands_in_table_cost_and_board_without_its_file(
    own: Path, tmp_path: Path
) -> None:
    scene = write_tiny_scene(tmp_path / "scene")
    runs = [
        write_run(tmp_path / "runs", scene, method, noise=noise)
        for method, noise in (("3dgs", 20.0), ("robustsplat", 5.0))
    ]
    done = aw("rescore", tmp_path / "runs", "--metric-file", own)
    assert done.returncode == 0 and "grey_error" in done.stdout
    result = read_result(runs[0] / "metrics.json")
    render = read_png_rgb((runs[0] / "renders/test" / result["per_image"][0]["name"]).with_suffix(".png"))
    photo = read_png_rgb(scene / "images" / result["per_image"][0]["name"])
    assert result["per_image"][0]["grey_error"] == abs(render.mean() - photo.mean())  # type: ignore[typeddict-item]
    assert result["per_image"][0]["contrast"] == render.std()  # type: ignore[typeddict-item]
    assert result["metrics"]["grey_error"]["label"] == "grey error levels"
    assert aw("rescore", tmp_path / "runs", "--metric-file", own).stderr.startswith("2 complete")

    own.write_text(OWN.replace("* 1", "* 2"))  # another state of the file measures again
    assert "added contrast, grey_error" in aw("rescore", tmp_path / "runs", "--metric-file", own).stdout
    again = read_result(runs[0] / "metrics.json")["per_image"][0]
    assert again["grey_error"] == 2 * result["per_image"][0]["grey_error"]  # type: ignore[typeddict-item]

    own.unlink()
    table = aw("table", tmp_path / "runs").stdout
    assert "not shown" in table and "grey error levels↓" in table and "contrast↑" in table
    assert aw("cost", tmp_path / "runs", "-o", tmp_path / "cost").returncode == 0
    head = (tmp_path / "cost/cost.csv").read_text().splitlines()[0].split(",")
    assert {"grey_error", "contrast"} <= set(head)
    added = aw("leaderboard", "add", tmp_path / "runs", "--board", tmp_path / "board", "--dataset", "d",
               "--scene", tmp_path)  # fmt: skip
    assert added.returncode == 0, added.stderr
    assert ",grey_error," in (tmp_path / "board/measured/d.csv").read_text().splitlines()[0]


@pytest.mark.parametrize(
    ("text", "said"),
    [
        (OWN.replace("* 1", "* wrong"), "NameError: name 'wrong' is not defined (my_metric.py, line 5)"),
        (OWN.replace("return", "x ="), "metric grey_error: the function returned NoneType, not one number"),
        (
            OWN.replace("render.std()", "render - 1"),
            "metric contrast: the function returned ndarray, not one number",
        ),
        (OWN.replace('"grey_error", "grey', '"psnr", "grey'), "metric 'psnr' is built in"),
        (OWN.replace('"grey_error", "grey', '"Grey error", "grey'), "'Grey error' cannot name a metric"),
        (OWN.replace('"lower"', '"low"'), "'grey_error': better is 'low': write 'higher', 'lower' or None"),
        (OWN.replace('"lower", 1', '"lower", 0.1'), "digits is 0.1: write a whole number"),
        (OWN.replace("needs=()", 'needs=("photo")'), "'contrast': needs is 'photo': write a tuple"),
        ("x = 1", "holds no Metric"),
        ("import sys; sys.exit(3)", "fails when it is loaded: SystemExit: 3 (my_metric.py, line 1)"),
    ],
)
def test_what_is_wrong_with_it_is_said_before_anything_is_trained(
    own: Path, tmp_path: Path, text: str, said: str
) -> None:
    own.write_text(text)
    scene = write_tiny_scene(tmp_path / "scene")
    with pytest.raises(AwError) as error:
        bench("3dgs", scene, metrics=own, output=tmp_path / "runs", iterations=2, device="cpu")
    assert said in str(error.value) and not list((tmp_path / "runs").glob("**/config.yaml"))


def test_two_files_with_one_key_are_refused(own: Path, tmp_path: Path) -> None:
    load_metrics(own)
    own.write_text(own.read_text() + "# edited\n")
    load_metrics(own)  # again, as in a notebook
    other = tmp_path / "other.py"
    other.write_text(own.read_text() + "# another one\n")
    with pytest.raises(AwError, match="both hold a metric"):
        load_metrics(other)


def test_an_installed_package_announces_it_as_an_entry_point(
    own: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    metric = Metric("edges", "edges", "higher", function=lambda render, photo: 1.0)
    module = tmp_path / "edges_package.py"
    module.write_text("one = 1\n")
    monkeypatch.syspath_prepend(tmp_path)
    version = SimpleNamespace(version="1.0")
    point = SimpleNamespace(name="edges", load=lambda: metric, module="edges_package", dist=version)
    monkeypatch.setattr(
        "importlib.metadata.entry_points", lambda group: [point] if "metrics" in group else []
    )
    assert measure("edges").better == "higher" and "edges" in metrics()
    before = metrics()["edges"].source
    module.write_text("one = 100\n")
    assert len(before) == 64 and hash_of_package(point) != before  # type: ignore[arg-type]
    load_metrics(own)
    assert {"edges", "grey_error", "contrast"} <= set(metrics())
