"""`run.py` of the kit that `gpu_pack.py` makes; the standard library alone until packages are found.

    python3 -I run.py --call 1 --results OUT      the stages of one call of ten minutes, on the GPU
    python3 -I run.py --rehearse                  all stages on the CPU, small, with stand-ins for the kernels

Other arguments are those of benchmarks/gpu.py. Packages that this machine has are used; those it lacks are
unpacked from wheels/ into .site beside this file. A stage that was stopped goes on with the same --work.
"""

from __future__ import annotations

import importlib.util
import os
import re
import shutil
import sys
import zipfile
from pathlib import Path

HERE = Path(__file__).resolve().parent
SITE = HERE / ".site"
BATCHED = ("3dgs-2-views", "3dgs-4-views")
NAMES = {"pillow": "PIL"}  # what is imported, where it is not the name of the wheel


def unpack(wheels: Path, site: Path) -> list[str]:
    """Unpack wheels whose module is missing, each into a folder of its own; returns their names.

    The folders are put at the end of `sys.path`. Exits with 2 where a wheel is for another Python.
    """
    made = []
    for wheel in sorted(wheels.glob("*.whl")):
        name = wheel.name.split("-")[0].lower()
        place = site / name
        if place.is_dir():
            sys.path.append(str(place))
        if importlib.util.find_spec(NAMES.get(name, name)) is not None:
            continue
        tag = re.search(r"-cp(\d)(\d+)-(abi3|cp\d+)", wheel.name)
        here = sys.version_info[:2]
        if tag is not None:
            built = (int(tag[1]), int(tag[2]))
            if built > here or (tag[3] != "abi3" and built != here):
                wanted = ".".join(map(str, here))
                fail(f"{wheel.name} is not for Python {wanted}; pack the kit again with --python {wanted}")
        part = site / f"{name}.part"
        shutil.rmtree(part, ignore_errors=True)  # of a call that was stopped
        with zipfile.ZipFile(wheel) as archive:
            archive.extractall(part)
        for path in [*part.rglob("bin/*"), *part.rglob("*.data/scripts/*")]:
            path.chmod(0o755)  # archives of zip keep no permissions
        part.rename(place)
        sys.path.append(str(place))
        importlib.invalidate_caches()
        made.append(name)
    for folder in [*site.rglob("bin"), *site.rglob("*.data/scripts")]:
        os.environ["PATH"] = f"{folder}{os.pathsep}{os.environ.get('PATH', '')}"
    return made


def fail(message: str) -> None:
    print(f"error: {message}", file=sys.stderr)
    raise SystemExit(2)


def rehearse(words: list[str]) -> int:
    """Every stage that has what it needs, on the CPU, with stand-ins for the compiled kernels.

    Args:
        words: arguments of gpu.py that go before the small ones used here; --call N rehearses one call.
    """
    import fake_kernels
    import gpu
    import gpu_stages

    gpu_stages.BLOCK = 2
    only = int(words[words.index("--call") + 1]) if "--call" in words[:-1] else None
    usual = ["--device", "cpu", "--iterations", "6", "--warm-up", "1", "--turns", "1", "--budget", "2"]
    place = ["--scene", str(HERE / "rehearsal"), "--work", str(HERE / "rehearsed")]
    code = 0
    with fake_kernels.in_place():
        for call, (stages, methods) in gpu.CALLS.items():
            if only not in (None, call):
                continue
            for line in gpu_stages.lacking(list(stages), list(methods)):
                print(f"call {call}, left out: {line}", flush=True)
            able = [method for method in methods if not gpu_stages.missing(method)]
            if not able or gpu_stages.lacking(list(stages), []):
                continue
            print(f"call {call}: {' '.join(able)}", flush=True)
            code |= gpu.main([*place, *usual, "--methods", *able, *words, "--call", str(call)])
        if only is None:
            print(f"call of variants: {' '.join(BATCHED)}", flush=True)
            code |= gpu.main([*place, *usual, "--stages", "train", "cost", "--methods", *BATCHED, *words])
    return code


def main() -> int:
    words = sys.argv[1:]
    # not the site folder first: what the machine has goes before what the kit brings, gsplat excepted
    sys.path[:0] = [str(HERE), str(HERE / "benchmarks"), str(HERE / "lib")]
    if importlib.util.find_spec("torch") is None:
        fail(f"{sys.executable} has no torch: run this with the Python that has it")
    made = unpack(HERE / "wheels", SITE)
    if made:
        print(f"unpacked {', '.join(made)} into {SITE}", flush=True)
    os.environ.setdefault("TORCH_EXTENSIONS_DIR", str(HERE / ".kernels"))
    # for processes that this one starts
    os.environ["PYTHONPATH"] = os.pathsep.join(
        [str(HERE), str(HERE / "benchmarks"), str(HERE / "lib"), str(SITE)]
    )
    if "--rehearse" in words:
        return rehearse([word for word in words if word != "--rehearse"])
    import gpu

    usual = []
    if "--scene" not in words:
        usual += ["--scene", str(HERE / "scene")]
    if "--work" not in words:
        usual += ["--work", str(HERE / "work")]
    return gpu.main([*usual, *words])


if __name__ == "__main__":
    sys.exit(main())
