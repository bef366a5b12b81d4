"""gsplat's sources cut to what is called, compiled by ourselves, resumed where a compile was interrupted."""

import subprocess
import sys
from pathlib import Path
from types import ModuleType

import pytest

from ambiguous_wild.splat.gpu import gsplat_build, gsplat_cut, gsplat_seam, readiness

FUNCTION = """std::tuple<at::Tensor, at::Tensor>
{name}(
    const at::Tensor means // [..., N, 3]
) {{
#define __LAUNCH_KERNEL__(N)                                                   \\
    case N:                                                                    \\
        launch<N>(means);                                                      \\
        break;

    switch (channels) {{
        __LAUNCH_KERNEL__(1)
        __LAUNCH_KERNEL__(2)
        __LAUNCH_KERNEL__(3)
        __LAUNCH_KERNEL__(513)
    default:
        AT_ERROR("Unsupported");
    }}
}}
"""
KERNEL = """namespace gsplat {{
{clamps}
#define __INS__(CDIM)                                                          \\
    template void launch<CDIM>(int);

__INS__(1)
__INS__(3)
__INS__(16)
#undef __INS__
}} // namespace gsplat
"""


def package_at(root: Path, clamp: str = "0.999f") -> Path:
    """A package with sources of the shape that gsplat's have."""
    csrc = root / "gsplat" / "cuda" / "csrc"
    csrc.mkdir(parents=True)
    for name in gsplat_cut._WHOLE:
        (csrc / name).write_text(f"// {name}\n")
    for name, calls in gsplat_cut._CALLS.items():
        others = ["projection_2dgs_fused_fwd", *calls, calls[0].replace("3dgs", "2dgs")]
        body = "\n".join(FUNCTION.format(name=call) for call in others)
        (csrc / name).write_text(
            f'#include "Ops.h"\n\nnamespace gsplat {{\n\n{body}\n}} // namespace gsplat\n'
        )
    for name, times in gsplat_cut._CLAMPED.items():
        text = KERNEL.format(clamps="\n".join([f"alpha = min({clamp}, vis);"] * times))
        (csrc / name).write_text(text)
    (root / "gsplat" / "__init__.py").write_text("__version__ = '1.5.3'\n")
    gsplat_cut.sources.cache_clear()
    return root / "gsplat"


@pytest.fixture
def package(tmp_path):
    return package_at(tmp_path)


def test_only_the_calls_and_channels_that_are_used_are_left(package):
    found = gsplat_cut.sources(package)
    for name, calls in gsplat_cut._CALLS.items():
        text = found[name]
        assert text.startswith('#include "Ops.h"') and text.endswith("} // namespace gsplat\n")
        assert all(f"{call}(\n" in text for call in calls) and "2dgs" not in text
        assert text.count("{") == text.count("}")
        assert [line.strip() for line in text.splitlines() if line.strip().startswith("__LAUNCH")] == [
            "__LAUNCH_KERNEL__(1)", "__LAUNCH_KERNEL__(3)",
        ] * 2  # fmt: skip
    for name, times in gsplat_cut._CLAMPED.items():
        assert "0.999f" not in found[name] and found[name].count("0.99f") == times
        assert "__INS__(3)\n" in found[name] and "__INS__(16)" not in found[name]
    assert all(f"&gsplat::{call});" in found["module.cpp"] for call in gsplat_cut._BOUND)


@pytest.mark.parametrize("how", ["clamp", "absent", "renamed"])
def test_other_sources_are_left_to_gsplat_itself(tmp_path, how):
    package = package_at(tmp_path, "0.99f" if how == "clamp" else "0.999f")
    csrc = package / "cuda/csrc"
    if how == "absent":
        (csrc / "IntersectTile.cu").unlink()
    if how == "renamed":
        (csrc / "Projection.cpp").write_text("namespace gsplat {\n}\n")
    with pytest.raises(gsplat_cut.CannotCut):
        gsplat_cut.sources(package)
    assert gsplat_cut.folder_of(package, gsplat_build.kernels_folder("13.0")) is None


def test_the_folder_changes_with_the_sources(package, monkeypatch, tmp_path):
    monkeypatch.setenv("TORCH_EXTENSIONS_DIR", str(tmp_path / "kept"))
    first = gsplat_cut.folder_of(package, gsplat_build.kernels_folder("13.0"))
    assert first.parent == tmp_path / "kept" and first.name.startswith("gsplat_cut_")
    (package / "cuda/csrc/Intersect.cpp").write_text("// changed\n")
    gsplat_cut.sources.cache_clear()
    assert gsplat_cut.folder_of(package, gsplat_build.kernels_folder("13.0")) not in (None, first)


def test_an_interrupted_compile_keeps_what_it_has(package, tmp_path, monkeypatch):
    """ninja goes by times of files: sources that are the same are not written again, objects stay."""
    from torch.utils import cpp_extension

    folder, calls = tmp_path / "build", []

    def load(name, sources, build_directory, **options):
        assert not (folder / "lock").exists()  # torch would wait for the process that was killed
        calls.append([Path(s).name for s in sources])
        (folder / "Intersect.o").touch()
        if len(calls) == 1:
            (folder / "lock").touch()
            raise KeyboardInterrupt
        (folder / f"{name}.so").touch()

    monkeypatch.setattr(cpp_extension, "load", load)
    with pytest.raises(KeyboardInterrupt):
        gsplat_cut.compile_here(package, folder)
    assert not gsplat_cut.is_complete(folder)
    before = {p.name: p.stat().st_mtime_ns for p in [*(folder / "src").iterdir(), folder / "Intersect.o"]}
    gsplat_cut.compile_here(package, folder)
    assert gsplat_cut.is_complete(folder)
    after = {p.name: p.stat().st_mtime_ns for p in (folder / "src").iterdir()}
    assert after == {name: time for name, time in before.items() if name != "Intersect.o"}
    assert calls[0] == calls[1] and "module.cpp" in calls[0] and len(calls[0]) == 10


def test_the_compile_runs_in_a_process_that_finds_the_packages_under_isolation(package, tmp_path):
    """`python -I` ignores PYTHONPATH and the current folder; the child gets this process's path."""
    folder, runs = tmp_path / f"{gsplat_cut.NAME}_x", []

    def run(words, **options):
        runs.append(words)
        code = words[2].replace("compile_here(Path(", "print(Path(").replace("'), Path(", "'), Path(")
        done = subprocess.run([words[0], "-I", "-c", code], capture_output=True, text=True, cwd="/")
        assert done.returncode == 0 and str(folder) in done.stdout, done.stderr
        folder.mkdir()
        for name in (gsplat_cut._DONE, f"{gsplat_cut.NAME}.so"):
            (folder / name).touch()
        return done

    said = []
    for _ in range(2):
        gsplat_build.compile_kernels(
            folder, lambda: gsplat_build.is_compiled(folder), said.append, package=package, run=run
        )
    assert len(runs) == len(said) == 1 and str(package) in runs[0][2]


def test_compiled_cut_kernels_need_no_compiler_to_load(package, tmp_path, monkeypatch):
    monkeypatch.setenv("TORCH_EXTENSIONS_DIR", str(tmp_path / "kept"))
    monkeypatch.syspath_prepend(str(package.parent))
    monkeypatch.delitem(sys.modules, "gsplat", raising=False)
    facts = {"version": "2", "built": "13.0", "cuda": True, "names": ["GPU"], "capabilities": [[9, 0]],
             "archs": ["sm_90"], "error": ""}  # fmt: skip
    found = readiness.look(facts)
    assert found.cut and not found.compiled and found.gsplat == str(package)
    found.folder.mkdir(parents=True)
    for name in (gsplat_cut._DONE, f"{gsplat_cut.NAME}.so"):
        (found.folder / name).touch()
    monkeypatch.setenv("PATH", "/nowhere")
    monkeypatch.setenv("CXX", "absent")
    assert readiness.look(facts).compiled and readiness.no_kernels(readiness.look(facts)) is None


def test_gsplat_is_given_the_compiled_module(package, tmp_path, monkeypatch):
    used = []
    monkeypatch.setenv("TORCH_EXTENSIONS_DIR", str(tmp_path / "kept"))
    fake = ModuleType("gsplat")
    fake.__file__, fake.__path__ = str(package / "__init__.py"), [str(package)]
    monkeypatch.setitem(sys.modules, "gsplat", fake)
    monkeypatch.setattr(gsplat_cut, "use", used.append)
    monkeypatch.setattr(gsplat_seam.torch.version, "cuda", "13.0")
    gsplat_seam._use_own_build(fake)
    assert used == []  # not compiled yet: gsplat goes its own way
    folder = gsplat_cut.folder_of(package, gsplat_build.kernels_folder("13.0"))
    folder.mkdir(parents=True)
    for name in (gsplat_cut._DONE, f"{gsplat_cut.NAME}.so"):
        (folder / name).touch()
    gsplat_seam._use_own_build(fake)
    assert used == [folder]
    (package / "csrc.py").touch()  # a module of a prebuilt wheel
    gsplat_seam._use_own_build(fake)
    assert used == [folder]


def test_the_installed_release_can_be_cut():
    gsplat = pytest.importorskip("gsplat")
    if gsplat.__version__ != "1.5.3":
        pytest.skip(f"gsplat {gsplat.__version__} compiles itself")
    gsplat_cut.sources.cache_clear()
    assert len(gsplat_cut.sources(Path(gsplat.__file__).parent)) == 10
