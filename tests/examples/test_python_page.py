"""docs/python.md does what it says, and docs/scene.md names what is there."""

import re
import subprocess
import sys
from pathlib import Path

import pytest

from ambiguous_wild.builder.records import SceneRecord
from ambiguous_wild.core.scene import SceneInfo
from ambiguous_wild.simulate.capture_writer import simulate
from ambiguous_wild.simulate.presets import preset

DOCS = Path(__file__).parents[2] / "docs"


@pytest.mark.slow
def test_the_code_of_the_page_about_python_runs(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    simulate(preset("tiny"), tmp_path / "photos")
    code = "\n".join(re.findall(r"```python\n(.*?)```", (DOCS / "python.md").read_text(), re.DOTALL))
    space: dict = {}
    exec(code.replace("iterations=3000", "iterations=20"), space)
    said = capsys.readouterr().out
    first, *_ = [run.mean("psnr") for run in space["report"].runs]
    assert f"RunReport(3dgs on scene, seed 0: trained, {first:.2f} dB)" in said
    assert re.search(rf"3dgs +{first:.2f}", said) and "train s" in said  # the table
    assert repr(space["built"]).endswith("scene: 12 train and 3 test photos)")
    assert repr(space["report"]) == "BenchReport(runs: 2 trained)"
    assert repr(space["runs"]) == "Runs(2 runs of 2 methods on 1 scene)"
    assert repr(space["planned"]).startswith("Plan(scene: --effects ")
    assert repr(space["shown"]) == "Tables(scene)" and "<table" in space["shown"]._repr_html_()
    assert all(len(repr(space[name])) < 200 for name in ("built", "planned", "report", "shown", "runs"))


def test_the_names_are_offered_and_importing_the_package_stays_light():
    code = (
        "import sys, ambiguous_wild as aw; before = set(sys.modules)\n"
        "heavy = {'torch', 'numba', 'pandas', 'numpy', 'cv2'} & before; assert not heavy, heavy\n"
        "names = ('Metric', 'bench', 'build_scene', 'plan', 'read_runs', 'table')\n"
        "assert all(callable(getattr(aw, name)) for name in names) and set(names) <= set(dir(aw))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


def test_the_page_about_scene_folders_names_keys_that_scene_json_has():
    page = (DOCS / "scene.md").read_text()
    keys = set(re.findall(r"^\| `(\w+)`(?:, `(\w+)`)? \|", page.partition("Keys of")[2], re.MULTILINE))
    others = re.findall(r"`(\w+)`", page.rpartition("The others")[2])
    named = {key for pair in keys for key in pair if key} | set(others)
    known = SceneRecord.__annotations__.keys() | SceneInfo.__annotations__.keys()
    assert len(named) > 15 and named <= known
