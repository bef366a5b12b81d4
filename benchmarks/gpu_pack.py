"""A kit for a machine with a GPU, torch and a CUDA toolkit, and without a network.

    bash benchmarks/gpu.sh --pack DIR [--python 3.12] [--gsplat FOLDER-OR-WHEEL] [--scene SCENE]

DIR/kit gets the package, the benchmarks, gsplat's Python with its sources cut to what is called, wheels of
what the other machine may lack, a simulated scene of the size of NeRF On-the-go, and `kit.json`: every file
with its size and sha256, and what each stage needs. There:

    python3 -I kit/run.py --call 1 --results OUT        then --call 2, 3, 4
    python3 -I kit/run.py --rehearse                    all stages on the CPU, with stand-ins for the kernels
"""

from __future__ import annotations

import argparse
import hashlib
import importlib.util
import json
import shutil
import subprocess
import sys
import tempfile
import zipfile
from pathlib import Path

from gpu import CALLS
from gpu_scene import make_scene
from gpu_stages import MODULES

from ambiguous_wild.core import AwError
from ambiguous_wild.io.atomic import atomic_dir, write_json
from ambiguous_wild.splat.gpu import gsplat_cut
from ambiguous_wild.splat.gpu.gsplat_seam import TESTED

ROOT = Path(__file__).resolve().parents[1]
LIMIT_MB = 60
PHOTOS, WIDTH = 150, 582  # as many pixels a photo as NeRF On-the-go at factor 8
PACKAGES = (
    "numpy",
    "pillow",
    "safetensors",
    "ninja",
    "setuptools",
)  # what torch does not bring, and is small
PLATFORMS = (
    "manylinux_2_28_x86_64",
    "manylinux_2_27_x86_64",
    "manylinux_2_17_x86_64",
    "manylinux2014_x86_64",
)
DATA = (".py", ".yaml", ".html", ".css", ".js")
# of gsplat: what `rasterization`, the yardstick, and our calls import
PYTHON = (
    "version.py", "rendering.py", "distributed.py", "utils.py", "_helper.py", "cuda/__init__.py",
    "cuda/_wrapper.py", "cuda/_torch_impl.py",
)  # fmt: skip
_INIT = '''"""gsplat {version} (Apache-2.0), cut to what is called here; other files are unchanged."""

from .cuda._wrapper import (
    fully_fused_projection,
    isect_offset_encode,
    isect_tiles,
    rasterize_to_pixels,
    spherical_harmonics,
)
from .rendering import rasterization
from .version import __version__
'''
_BACKEND = '"""The compiled module, which the caller has put there."""\n\nfrom gsplat import csrc as _C\n'


def pack(
    out: Path,
    *,
    python: str,
    gsplat: Path | None = None,
    scene: Path | None = None,
    photos: int = PHOTOS,
    width: int = WIDTH,
    wheels: bool = True,
) -> Path:
    """Make the kit; returns its folder.

    Args:
        out: gets the folder `kit`.
        python: version of the other machine's interpreter, e.g. "3.12".
        gsplat: its package folder or wheel; None = the installed one, else pip downloads the wheel.
        scene: a scene folder to carry; None = simulated.
        photos, width: of the simulated scene; train photos, and their width in px.
        wheels: whether to bring packages.

    Raises:
        AwError: there is a kit already, gsplat is of another release, or the kit is too large.
    """
    if (out / "kit").exists():
        raise AwError(f"{out / 'kit'} is there already; remove it, or give another folder")
    with tempfile.TemporaryDirectory() as temporary, atomic_dir(out / "kit") as kit:
        _code(kit)
        _gsplat(kit / "lib" / "gsplat", _found_gsplat(gsplat, Path(temporary)))
        if wheels:
            _wheels(kit / "wheels", python)
        if scene is None:
            make_scene(
                kit / "scene",
                name="courtyard-colour",
                train=photos,
                test=max(photos * 2 // 15, 1),
                width=width,
                to_train_on=True,
            )
        else:
            shutil.copytree(scene, kit / "scene", ignore=shutil.ignore_patterns("truth", "images_*"))
        make_scene(
            kit / "rehearsal", name="courtyard-colour", train=5, test=1, width=64, to_train_on=True, every=8
        )
        files = {
            path.relative_to(kit).as_posix(): {
                "bytes": path.stat().st_size, "sha256": hashlib.sha256(path.read_bytes()).hexdigest()
            }
            for path in sorted(kit.rglob("*")) if path.is_file()
        }  # fmt: skip
        total = sum(entry["bytes"] for entry in files.values()) / 1e6
        if total > LIMIT_MB:
            raise AwError(f"the kit has {total:.0f} MB, more than {LIMIT_MB}: give a smaller --scene")
        write_json(kit / "kit.json", {
            "python": python if wheels else None, "gsplat": TESTED, "megabytes": round(total, 1),
            "calls": {str(n): {"stages": s, "methods": m} for n, (s, m) in CALLS.items()},
            "needs": {"every stage": ["torch with CUDA", "nvcc", "c++", *PACKAGES], **MODULES},
            "files": files,
        })  # fmt: skip
    return out / "kit"


def _code(kit: Path) -> None:
    for folder, pattern in (("ambiguous_wild", "*"), ("benchmarks", "gpu*")):
        for path in (ROOT / folder).rglob(pattern):
            if path.suffix in DATA and "__pycache__" not in path.parts:
                target = kit / path.relative_to(ROOT)
                target.parent.mkdir(parents=True, exist_ok=True)
                shutil.copyfile(path, target)
    for name in ("fake_gsplat.py", "fake_kernels.py"):
        shutil.copyfile(ROOT / "tests" / "splat" / name, kit / "benchmarks" / name)
    shutil.move(kit / "benchmarks" / "gpu_kit.py", kit / "run.py")


def _found_gsplat(given: Path | None, temporary: Path) -> Path:
    """The package's folder."""
    spec = importlib.util.find_spec("gsplat") if given is None else None
    if given is None and spec is not None and spec.origin is not None:
        given = Path(spec.origin).parent
    if given is None:
        _pip("download", "--no-deps", "-d", str(temporary), f"gsplat=={TESTED}")
        given = next(temporary.glob("*.whl"))
    if given.suffix == ".whl":
        with zipfile.ZipFile(given) as archive:
            archive.extractall(temporary / "gsplat")  # zipfile drops ".." and roots from names
        given = temporary / "gsplat" / "gsplat"
    return given


def _gsplat(target: Path, package: Path) -> None:
    try:
        sources = gsplat_cut.sources(package)
    except gsplat_cut.CannotCut as error:
        raise AwError(f"{package} is not gsplat {TESTED}, which the kit needs: {error}") from None
    csrc = package / "cuda" / "csrc"
    wanted = [package / name for name in PYTHON]
    wanted += [csrc / name for name in gsplat_cut.originals()]
    wanted += [p for p in (package / "cuda" / "include").iterdir() if p.is_file()]
    wanted += [p for p in csrc.iterdir() if p.suffix in (".h", ".cuh")]
    wanted += [p for p in (csrc / "third_party/glm/glm").rglob("*") if p.suffix in (".hpp", ".inl", ".h")]
    for path in wanted:
        place = target / path.relative_to(package)
        place.parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(path, place)
    for licence in (*package.parent.glob("gsplat-*/licenses/LICENSE"), csrc / "third_party/glm/copying.txt"):
        if licence.is_file():
            shutil.copyfile(licence, target / f"LICENSE-{licence.parent.name}.txt")
    (target / "__init__.py").write_text(_INIT.format(version=TESTED), encoding="utf-8")
    (target / "cuda" / "_backend.py").write_text(_BACKEND, encoding="utf-8")
    gsplat_cut.sources.cache_clear()
    if gsplat_cut.sources(target) != sources:
        raise AwError("the cut sources changed on their way into the kit")


def _wheels(target: Path, python: str) -> None:
    target.mkdir(parents=True)
    platforms = [word for name in PLATFORMS for word in ("--platform", name)]
    _pip(
        "download", "--no-deps", "--only-binary=:all:", "--python-version", python, *platforms,
        "-d", str(target), *PACKAGES,
    )  # fmt: skip


def _pip(*words: str) -> None:
    done = subprocess.run(
        [sys.executable, "-m", "pip", "--disable-pip-version-check", *words],
        capture_output=True, text=True, check=False,
    )  # fmt: skip
    if done.returncode:
        lines = done.stderr.strip().splitlines() or ["no message"]
        raise AwError(f"pip {words[0]} failed: {lines[-1]}")


def main(words: list[str] | None = None) -> int:
    p = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    p.add_argument("out", type=Path, metavar="DIR")
    p.add_argument("--python", default="3.12", help="version of the other machine's interpreter")
    p.add_argument("--gsplat", type=Path, help="gsplat's package folder or wheel")
    p.add_argument("--scene", type=Path, help="a scene to carry instead of the simulated one")
    p.add_argument("--photos", type=int, default=PHOTOS, help="train photos of the simulated scene")
    p.add_argument("--width", type=int, default=WIDTH, help="their width in px")
    p.add_argument("--no-wheels", dest="wheels", action="store_false")
    args = p.parse_args(words)
    try:
        kit = pack(**vars(args))
    except AwError as error:
        p.error(str(error))
    known = json.loads((kit / "kit.json").read_text(encoding="utf-8"))
    print(f"{kit}: {len(known['files'])} files, {known['megabytes']} MB")
    for number, (stages, methods) in CALLS.items():
        print(f"  python3 -I kit/run.py --call {number}    {' '.join(stages)}: {' '.join(methods)}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
