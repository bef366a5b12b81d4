"""The kit for a machine without a network: packed from sources like gsplat's, unpacked, rehearsed apart."""

import json
import os
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

from ambiguous_wild.core import AwError
from ambiguous_wild.splat.gpu import gsplat_cut

from .test_gsplat_cut import package_at

BENCHMARKS = Path(__file__).parents[2] / "benchmarks"


@pytest.fixture
def modules(monkeypatch):
    monkeypatch.syspath_prepend(str(BENCHMARKS))
    import gpu_kit
    import gpu_pack

    yield gpu_pack, gpu_kit
    for name in list(sys.modules):
        if name == "gpu" or name.startswith("gpu_"):
            sys.modules.pop(name)


@pytest.fixture
def package(tmp_path):
    package = package_at(tmp_path / "made")
    for name in (*gpu_python(), "cuda/include/Common.h", "cuda/csrc/third_party/glm/glm/glm.hpp"):
        path = package / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text("")
    (package / "cuda/csrc/Projection2DGSFused.cu").write_text("// not called\n")
    (package / "version.py").write_text('__version__ = "1.5.3"\n')
    return package


def gpu_python():
    return ("version.py", "rendering.py", "distributed.py", "utils.py", "_helper.py", "cuda/__init__.py",
            "cuda/_wrapper.py", "cuda/_torch_impl.py")  # fmt: skip


@pytest.fixture
def small(tmp_path, modules, monkeypatch):
    """A packed kit without wheels, with tiny scenes."""
    from tests.tiny_scene import write_tiny_scene

    scene = write_tiny_scene(tmp_path / "scene")

    def copied(out, **_):
        import shutil

        shutil.copytree(scene, out)

    monkeypatch.setattr(modules[0], "make_scene", copied)
    return modules[0]


def test_the_kit_holds_what_a_stage_needs_and_nothing_else(small, package, tmp_path):
    given = {"python": "3.12", "gsplat": package, "scene": tmp_path / "scene", "wheels": False}
    kit = small.pack(tmp_path / "out", **given)
    known = json.loads((kit / "kit.json").read_text())
    names = set(known["files"])
    assert known["megabytes"] < small.LIMIT_MB and set(known["calls"]) == {"1", "2", "3", "4"}
    assert {
        "run.py",
        "benchmarks/gpu.py",
        "ambiguous_wild/splat/trainer.py",
        "benchmarks/fake_kernels.py",
    } <= names
    assert "lib/gsplat/cuda/csrc/IntersectTile.cu" in names
    assert not [n for n in names if "2DGSFused" in n or "__pycache__" in n or n.startswith("scene/truth")]
    assert str(tmp_path) not in (kit / "kit.json").read_text()
    gsplat_cut.sources.cache_clear()
    assert gsplat_cut.digest(kit / "lib/gsplat") == gsplat_cut.digest(package)
    assert {"scene/images/train_0.png", "scene/test_list.txt"} <= names
    assert [n for n in names if n.startswith("scene/sparse/0/points3D.")]
    with pytest.raises(AwError, match="is there already"):
        small.pack(tmp_path / "out", **given)


def test_a_kit_that_is_too_large_or_of_another_release_is_refused(small, package, tmp_path, monkeypatch):
    monkeypatch.setattr(small, "LIMIT_MB", 0.1)
    with pytest.raises(AwError, match=r"more than 0\.1"):
        small.pack(tmp_path / "out", python="3.12", gsplat=package, wheels=False)
    (package / "cuda/csrc/Intersect.cpp").unlink()
    gsplat_cut.sources.cache_clear()
    with pytest.raises(AwError, match=r"is not gsplat 1\.5\.3"):
        small.pack(tmp_path / "out", python="3.12", gsplat=package, wheels=False)
    assert not (tmp_path / "out" / "kit").exists()


def wheel(folder, name, files):
    with zipfile.ZipFile(folder / name, "w") as archive:
        for path, text in files.items():
            archive.writestr(path, text)


def test_only_what_is_missing_is_unpacked(modules, tmp_path, monkeypatch):
    _, kit = modules
    monkeypatch.setenv("PATH", "/bin")
    wheels, site = tmp_path / "wheels", tmp_path / "site"
    wheels.mkdir()
    wheel(wheels, "numpy-9-py3-none-any.whl", {"numpy/__init__.py": "raise RuntimeError"})
    wheel(
        wheels, "notthere-1-py3-none-any.whl", {"notthere/__init__.py": "value = 3", "bin/tool": "#!/bin/sh"}
    )
    monkeypatch.setattr(sys, "path", list(sys.path))
    (site / "notthere.part").mkdir(parents=True)  # of a call that was stopped
    assert kit.unpack(wheels, site) == ["notthere"]
    assert kit.unpack(wheels, site) == [] and str(site / "notthere") in sys.path
    assert sorted(path.name for path in site.iterdir()) == ["notthere"]
    assert os.access(site / "notthere/bin/tool", os.X_OK) and str(site / "notthere/bin") in os.environ["PATH"]


@pytest.mark.parametrize(
    ("tag", "fits"), [("cp99-cp99", False), ("cp38-abi3", True), ("py3-none", True), ("cp38-cp38", False)]
)
def test_a_wheel_of_another_python_is_refused_in_one_line(modules, tmp_path, capsys, monkeypatch, tag, fits):
    _, kit = modules
    monkeypatch.setattr(sys, "path", list(sys.path))
    wheel(tmp_path, f"absentpackage-1-{tag}-any.whl", {"absentpackage.py": ""})
    if fits:
        assert kit.unpack(tmp_path, tmp_path / "site") == ["absentpackage"]
        return
    with pytest.raises(SystemExit) as end:
        kit.unpack(tmp_path, tmp_path / "site")
    here = ".".join(map(str, sys.version_info[:2]))
    assert end.value.code == 2 and f"is not for Python {here}; pack" in capsys.readouterr().err


def test_without_torch_it_says_so(modules, tmp_path):
    code = (BENCHMARKS / "gpu_kit.py").read_text()
    (tmp_path / "run.py").write_text(code)
    blocked = (
        "import importlib.util as u, runpy, sys; look = u.find_spec; "
        "u.find_spec = lambda n, p=None: None if n == 'torch' else look(n, p); "
        f"sys.argv = ['run.py']; runpy.run_path({str(tmp_path / 'run.py')!r}, run_name='__main__')"
    )
    done = subprocess.run([sys.executable, "-I", "-c", blocked], capture_output=True, text=True)
    assert done.returncode == 2 and done.stderr.startswith("error: ") and "has no torch" in done.stderr


def test_the_log_of_a_rehearsal_has_stages_and_errors_and_neither_times_nor_folders(modules):
    import gpu_rehearse

    place = Path("/somewhere")
    kept = {
        "stage train": "stage train",
        "train: 17 s": "train: done",
        "cost needs 3dgs trained for 6 iterations: found": "cost needs 3dgs trained for 6 iterations: found",
        "unpacked pillow into /somewhere/kit/.site": "unpacked pillow into ./kit/.site",
        "AwError: /somewhere/kit/scene is empty": "AwError: ./kit/scene is empty",
    }
    assert [gpu_rehearse.shortened(line + "\n", place) for line in kept] == list(kept.values())
    assert gpu_rehearse.shortened("{'method': '3dgs', 'fps': 812.3}\n", place) is None


def test_a_rehearsal_names_what_it_leaves_out(modules, monkeypatch, capsys):
    """Without scipy and OpenCV RobustSplat still runs; without Numba CPU and GPU are not compared."""
    import contextlib
    from types import SimpleNamespace

    _, kit = modules
    import gpu
    import gpu_stages

    stand_in = SimpleNamespace(in_place=contextlib.nullcontext)
    monkeypatch.setitem(sys.modules, "fake_kernels", stand_in)
    monkeypatch.setattr(gpu_stages, "BLOCK", 50)
    monkeypatch.setattr(
        gpu_stages.importlib.util, "find_spec", lambda name: None if name in ("scipy", "numba") else name
    )
    calls = []
    monkeypatch.setattr(gpu, "main", lambda words: calls.append(words) or 0)
    assert kit.rehearse(["--results", "there"]) == 0
    said = capsys.readouterr().out
    assert "call 2, left out: refinesplat needs scipy, which this machine lacks" in said
    assert "call 4, left out: same needs scipy, numba, which this machine lacks" in said
    methods = [words[words.index("--methods") + 1 :] for words in calls]
    assert [m[: m.index("--results")] for m in methods] == [["3dgs"], ["robustsplat"], list(kit.BATCHED)]
    calls.clear()
    assert kit.rehearse(["--call", "1"]) == 0 and len(calls) == 1
