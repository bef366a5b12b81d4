"""The wheel is whole: installed in an empty environment, outside of any checkout, its commands work."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
import sysconfig
import venv
import zipfile
from pathlib import Path
from typing import Any

import pytest

pytestmark = pytest.mark.slow
ROOT = Path(__file__).resolve().parents[2]
# What a build reads; the rest of a checkout is none of a wheel's business.
SOURCES = ("ambiguous_wild", "pyproject.toml", "README.md", "LICENSE")
DATA = (".yaml", ".html", ".css", ".js", ".csv", ".json", ".gz", ".txt")


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The wheel of a copy of the sources: a build leaves folders beside them."""
    # asked in a process of its own: setuptools refuses to be imported after distutils was
    asked = "import setuptools; print(setuptools.__version__.partition('.')[0])"
    found = subprocess.run([sys.executable, "-c", asked], capture_output=True, text=True, check=False)
    if found.returncode or int(found.stdout) < 77:
        pytest.skip("needs setuptools 77 to build the wheel")
    copy, out = tmp_path_factory.mktemp("sources"), tmp_path_factory.mktemp("wheel")
    for name in SOURCES:
        source = ROOT / name
        if source.is_dir():
            shutil.copytree(source, copy / name, ignore=shutil.ignore_patterns("__pycache__", "*.pyc"))
        else:
            shutil.copyfile(source, copy / name)
    code = f"import setuptools.build_meta as build; print(build.build_wheel({str(out)!r}))"
    subprocess.run([sys.executable, "-c", code], cwd=copy, check=True, capture_output=True)
    (path,) = out.glob("*.whl")
    return path


@pytest.fixture(scope="module")
def installed(wheel: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The Python of a new environment that has the wheel, and this one's dependencies behind it."""
    home = tmp_path_factory.mktemp("installed")
    venv.create(home / "venv", with_pip=False, symlinks=os.name != "nt")
    python = home / "venv" / ("Scripts/python.exe" if os.name == "nt" else "bin/python")
    asked = [str(python), "-c", "import sysconfig; print(sysconfig.get_path('purelib'))"]
    site = Path(subprocess.run(asked, capture_output=True, text=True, check=True).stdout.strip())
    with zipfile.ZipFile(wheel) as archive:
        archive.extractall(site)
    (site / "dependencies.pth").write_text(sysconfig.get_path("purelib") + "\n", encoding="utf-8")
    return python


def run(python: Path, folder: Path, *words: Any) -> subprocess.CompletedProcess[str]:
    """One command of the installed package, from a folder that is no checkout."""
    code = "import sys; from ambiguous_wild.cli.main import main; main()"
    environment = {k: v for k, v in os.environ.items() if k != "PYTHONPATH"}
    done = subprocess.run(
        [str(python), "-c", code, *map(str, words)],
        cwd=folder, capture_output=True, text=True, env=environment, check=False,
    )  # fmt: skip
    assert done.returncode == 0, f"aw {' '.join(map(str, words))}: {done.stderr[-1500:]}"
    return done


def test_the_wheel_holds_every_file_of_the_package(wheel: Path) -> None:
    with zipfile.ZipFile(wheel) as archive:
        inside = set(archive.namelist())
    package = ROOT / "ambiguous_wild"
    expected = {
        p.relative_to(ROOT).as_posix()
        for p in package.rglob("*")
        if p.is_file() and (p.suffix == ".py" or p.suffix in DATA) and "__pycache__" not in p.parts
    }
    files = [p for p in package.rglob("*") if p.is_file() and "__pycache__" not in p.parts]
    other = {p for p in files if p.suffix not in (".py", *DATA)}
    assert not other, "files of a kind that package-data in pyproject.toml does not name"
    assert expected - inside == set()
    assert any("reported/ambiguous-wild-main.csv" in name for name in inside)
    assert any(name.endswith("entry_points.txt") for name in inside)


def test_it_is_the_installed_package_that_runs(installed: Path, tmp_path: Path) -> None:
    environment = {k: v for k, v in os.environ.items() if k != "PYTHONPATH"}
    asked = [str(installed), "-c", "import ambiguous_wild; print(ambiguous_wild.__file__)"]
    done = subprocess.run(asked, cwd=tmp_path, env=environment, capture_output=True, text=True, check=True)
    assert Path(done.stdout.strip()).is_relative_to(installed.parents[1])


def test_light_commands_work_outside_a_checkout(installed: Path, tmp_path: Path) -> None:
    assert "findings in" in run(installed, tmp_path, "audit").stderr
    assert json.loads(run(installed, tmp_path, "methods", "--json").stdout)


def test_a_capture_becomes_a_scene_a_table_and_a_page(installed: Path, tmp_path: Path) -> None:
    run(installed, tmp_path, "simulate", "courtyard", "-o", "raw", "--views", 12, "--width", 240)
    run(installed, tmp_path, "build-scene", "raw", "-o", "scene", "--factor", 2)
    run(
        installed, tmp_path, "bench", "--method", "3dgs", "--scene", "scene", "--iterations", 20, "-o", "runs"
    )
    assert "3dgs" in run(installed, tmp_path, "table", "runs").stdout
    run(installed, tmp_path, "cost", "runs")
    run(installed, tmp_path, "leaderboard", "add", "runs", "--board", "board")
    run(installed, tmp_path, "leaderboard", "publish", "--board", "board", "-o", "page", "--reported")
    page = (tmp_path / "page" / "index.html").read_text(encoding="utf-8")
    assert "RefineSplat" in page and "3dgs" in page
