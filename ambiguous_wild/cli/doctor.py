"""`aw doctor`: checks of this machine; what is missing, and a command to install it.

This module imports nothing heavy: imports that may crash or hang are tested in other processes, in parallel.
"""

from __future__ import annotations

import dataclasses
import importlib.metadata
import importlib.util
import json
import os
import platform
import shlex
import shutil
import subprocess
import sys
from collections.abc import Iterable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import click

from ambiguous_wild.cli.options import json_option
from ambiguous_wild.core.errors import AwError, install_command, installed
from ambiguous_wild.core.machine import usable_cores, usable_memory
from ambiguous_wild.core.processes import python_command
from ambiguous_wild.io.images import ximgproc
from ambiguous_wild.io.terminal import say
from ambiguous_wild.splat import readiness

TIMEOUT_S = 60

# Code of each probe, which prints one line of JSON.
PROBES = {
    "torch": """
from ambiguous_wild.splat.readiness import torch_facts
print(json.dumps(torch_facts()))
""",
    "torchvision": "import torchvision; print(json.dumps({'version': torchvision.__version__}))",
    "numba": """
import numba
threads = numba.get_num_threads()  # starts the threading layer
print(json.dumps({"threads": threads, "layer": numba.threading_layer()}))
""",
    "OpenImageIO": "import OpenImageIO; print(json.dumps({'version': OpenImageIO.VERSION_STRING}))",
    "pycolmap": """
import tempfile, pathlib
from ambiguous_wild.io.safe_pycolmap import pycolmap
import numpy as np
from ambiguous_wild.io.images import read_png_rgb, write_png
image = np.arange(48 * 64 * 3, dtype=np.uint8).reshape(48, 64, 3)
with tempfile.TemporaryDirectory() as folder:
    path = pathlib.Path(folder) / "probe.png"
    write_png(path, image)
    assert (read_png_rgb(path) == image).all(), "the PNG read back differs from the one written"
print(json.dumps({"version": pycolmap.__version__}))
""",
}


@dataclass(frozen=True)
class Probe:
    """The facts that a process printed, or its error."""

    facts: Any  # the JSON object that it printed; None if it failed
    error: str = ""


def probe(name: str) -> Probe:
    """Run one of `PROBES` in its own process."""
    code = "import json\n" + PROBES[name]
    try:
        done = subprocess.run(
            python_command(code), capture_output=True, text=True, timeout=TIMEOUT_S, check=False
        )
    except subprocess.TimeoutExpired:
        return Probe(None, f"no answer within {TIMEOUT_S} s")
    if done.returncode < 0:
        return Probe(None, f"the process crashed (signal {-done.returncode})")
    lines = done.stderr.strip().splitlines()
    if done.returncode:
        return Probe(None, lines[-1] if lines else f"exit code {done.returncode}")
    try:
        return Probe(json.loads(done.stdout.strip().splitlines()[-1]))
    except (IndexError, ValueError):
        return Probe(None, f"unexpected output {done.stdout[-200:]!r}")


PACKAGE = Path(__file__).resolve().parent.parent
DISTRIBUTION = "ambiguous-wild"
SMALL_MEMORY_GB = 2.0  # COLMAP and a training of 100 000 Gaussians need this much
SMALL_DISK_GB = 1.0  # photos, features and one run
# A remedy that begins with one of these is a command.
COMMANDS = (f"{sys.executable} ", f"{shlex.quote(sys.executable)} ", "sudo ", "brew ", "python3 ", "aw ", "#")
_PIP = f"{shlex.quote(sys.executable)} -m pip"


@dataclass(frozen=True)
class SystemCheck:
    """One line of the report."""

    group: Literal["core", "optional"]
    name: str
    ok: bool
    detail: str  # what was found
    fix: str = ""  # shell command to paste, or a # comment where no command can do it; "" if nothing is to do


def _core(name: str, ok: bool, detail: str, fix: str = "") -> SystemCheck:
    return SystemCheck("core", name, ok, detail, "" if ok else fix)


def _optional(name: str, ok: bool, detail: str, fix: str = "") -> SystemCheck:
    return SystemCheck("optional", name, ok, detail, "" if ok else fix)


def all_checks() -> list[SystemCheck]:
    """Make all checks, core first."""
    names = [n for n in PROBES if n != "torchvision" or importlib.util.find_spec(n) is not None]
    with ThreadPoolExecutor(len(names)) as pool:
        probed = dict(zip(names, pool.map(probe, names)))
    return [
        *_machine(),
        _packages(),
        _library("torch", probed["torch"], "training and LPIPS"),
        _library("OpenImageIO", probed["OpenImageIO"], "reading photos"),
        _library(
            "pycolmap", probed["pycolmap"], "structure from motion; PNG files are written correctly after it"
        ),
        _opencv(),
        *_numba(probed["numba"]),
        *_gpu(probed["torch"]),
        _torchvision(probed.get("torchvision")),
        *_vision(),
        *_metrics(),
        _git(),
        *_extras(),
    ]


def _machine() -> list[SystemCheck]:
    python = _system_install("python3.11", "https://www.python.org/downloads")
    checks = [
        _core("python", sys.version_info >= (3, 11), platform.python_version(), python),
        _core("cpu", True, f"{usable_cores()} cores usable of {os.cpu_count()}, {platform.machine()}"),
    ]
    if (memory := usable_memory()) is not None:
        fix = f"# use {SMALL_MEMORY_GB:.0f} GB or more, or train with aw bench --max-gaussians 50000"
        checks.append(_core("memory", memory >= SMALL_MEMORY_GB * 1e9, f"{memory / 1e9:.1f} GB", fix))
    free = shutil.disk_usage(Path.cwd()).free / 1e9
    fix = f"df -h .  # free at least {SMALL_DISK_GB:.0f} GB, or use a folder on another disk"
    return [*checks, _core("disk", free >= SMALL_DISK_GB, f"{free:.0f} GB free in {Path.cwd()}", fix)]


def _system_install(package: str, page: str) -> str:
    """Return the command that installs a system package with the package manager of this machine."""
    managers = {"apt-get": "sudo apt-get install -y", "dnf": "sudo dnf install -y", "brew": "brew install"}
    for name, command in managers.items():
        if shutil.which(name) is not None:
            return f"{command} {package}"
    return f"# install {package} from {page}"


def _packages() -> SystemCheck:
    """Check the required packages: allowed ranges, and tested versions."""
    try:
        required = [r for r in importlib.metadata.requires(DISTRIBUTION) or [] if "extra ==" not in r]
    except importlib.metadata.PackageNotFoundError:
        fix = f"{_PIP} install -e {shlex.quote(str(PACKAGE.parent))}"
        return _core("packages", False, f"{DISTRIBUTION} is not installed", fix)
    if wrong := unmet(required):
        fix = f"{_PIP} install " + " ".join(f"'{w}'" for w in wrong)
        return _core("packages", False, "missing or wrong version: " + ", ".join(wrong), fix)
    other = other_versions(PACKAGE.parent / "constraints.txt")
    detail = f"all {len(required)} required packages"
    if other is not None:
        detail += (
            f"; other than the tested version: {', '.join(other)}" if other else ", in the tested versions"
        )
    return _core("packages", True, detail)


def unmet(requirements: Iterable[str]) -> list[str]:
    """Return the requirements ("name>=1.0") that the installed packages do not meet."""
    from packaging.requirements import Requirement

    wrong = []
    for text in requirements:
        requirement = Requirement(text)
        version = installed(requirement.name)
        if version is None or not requirement.specifier.contains(version, prereleases=True):
            wrong.append(f"{requirement.name}{requirement.specifier}")
    return wrong


def other_versions(constraints: Path) -> list[str] | None:
    """List installed packages whose version differs from the pinned one; None without the file of pins."""
    if not constraints.is_file():
        return None
    lines = []
    for line in constraints.read_text(encoding="utf-8").splitlines():
        name, _, pinned = line.partition("#")[0].strip().partition("==")
        version = installed(name) if pinned else None
        # A local build such as 2.13.0+cpu is the same version.
        if version is not None and version.partition("+")[0] != pinned:
            lines.append(f"{name} {version} (tested: {pinned})")
    return lines


def _install_again(words: str) -> str:
    """Return the pip command that installs the tested versions, in a checkout."""
    path = PACKAGE.parent / "constraints.txt"
    tested = f" -c {shlex.quote(str(path))}" if path.is_file() else ""
    return f"{_PIP} install{tested} --force-reinstall {words}"


def _library(name: str, probed: Probe, use: str) -> SystemCheck:
    detail = probed.error if probed.facts is None else str(probed.facts["version"])
    return _core(name, probed.facts is not None, f"{detail} ({use})", _install_again(f"--no-deps {name}"))


def _opencv() -> SystemCheck:
    try:
        ximgproc()
    except AwError as error:
        fault, _, fix = str(error).partition(": ")
        return _core("opencv", False, fault, f"{_PIP.removesuffix('pip')}{fix}")
    return _core("opencv", True, "with ximgproc (masks, segments)")


def _numba(probed: Probe) -> list[SystemCheck]:
    if probed.facts is None:
        return [_core("numba", False, probed.error, _install_again("numba llvmlite"))]
    from ambiguous_wild.io.numba_cache import cache_in_use, is_writable

    folder = cache_in_use()
    compiled = len(list(folder.rglob("*.nbi"))) if folder.is_dir() else 0
    wait = "not compiled yet: the first run takes 1 minute longer"
    state = f"{compiled} kernels compiled" if compiled else wait
    useful = bool(compiled) or is_writable(folder)
    where = f"in {folder}" if useful else f"{folder} is not writable"
    return [
        _core("numba", True, f"{probed.facts['threads']} threads, threading layer {probed.facts['layer']}"),
        _core("kernel cache", useful, f"{state}, {where}", "export NUMBA_CACHE_DIR=$HOME/.cache/numba"),
    ]


def _gpu(torch: Probe) -> list[SystemCheck]:
    """Check the GPU, with the same messages as `--device`."""
    if torch.facts is None:
        return [_optional("torch cuda", False, torch.error, _install_again("--no-deps torch"))]
    facts = readiness.gpu_facts(torch.facts)
    driver = facts.driver
    checks = [
        _optional(
            "nvidia driver", driver is not None, driver or "no nvidia-smi; the CPU is used", _driver_install()
        ),
        _part("torch cuda", ", ".join(torch.facts["names"]), readiness.cuda_problem(facts)),
        _part("gsplat", facts.gsplat or "", readiness.gsplat_problem(facts)),
    ]
    if facts.gsplat and facts.torch["cuda"]:
        state = "in the wheel" if facts.prebuilt else "compiled by the first run, which takes minutes longer"
        checks.append(_part("gsplat kernels", state, readiness.compiler_problem(facts)))
    return checks


def _driver_install() -> str:
    if shutil.which("ubuntu-drivers") is not None:
        return "sudo ubuntu-drivers install  # only if this machine has an NVIDIA GPU"
    return "# if this machine has an NVIDIA GPU, install its driver: https://www.nvidia.com/drivers"


def _part(name: str, fine: str, lack: readiness.MissingDependency | None) -> SystemCheck:
    if lack is None:
        return _optional(name, True, fine)
    return _optional(name, False, lack.what, pastable(lack.fix))


def pastable(fix: str) -> str:
    """Turn a remedy into a shell line; words that are no command become a comment."""
    if fix.startswith(("export ", "unset ")):
        line, comma, why = fix.partition(", ")
        return f"{line}  # {why}" if comma else line
    return fix if fix.startswith(COMMANDS) else f"# {fix}"


def _installed(name: str, extra: str, use: str) -> SystemCheck:
    version = installed(name)
    detail = f"{version or 'not installed'} ({use})"
    return _optional(name, version is not None, detail, install_command(extra))


def _extras() -> list[SystemCheck]:
    """Check packages for single commands, and nerfbaselines, which has its own environment."""
    from ambiguous_wild.methods.nerfbaselines_methods import find_program

    checks = [
        _installed("ray", "ray", "aw bench --engine ray"),
        _installed("pi-heif", "heic", "HEIC photos of phones"),
        _installed("viser", "view", "aw view --live"),
        _installed("choix", "study", "aw study score: ranking"),
        _installed("nltk", "study", "aw study score: agreement"),
    ]
    try:
        return [*checks, _optional("nerfbaselines", True, f"{find_program()} (its methods)")]
    except AwError as error:
        what, _, fix = str(error).partition(": ")
        return [*checks, _optional("nerfbaselines", False, what, fix)]


def _vision() -> list[SystemCheck]:
    """Check foundation models: transformers and the weights."""
    from ambiguous_wild.vision import weight_registry

    # Weights of LPIPS are listed by metric.
    listed = {w.name: w for w in weight_registry.KNOWN if "LPIPS" not in w.used_for}
    return [
        _installed("transformers", "masks", "DINO features, SAM masks"),
        *(
            _optional(w.name, w.present, f"{listed[w.name].used_for}: {w.where}", w.command)
            for w in weight_registry.status(listed.values())
        ),
    ]


def _torchvision(probed: Probe | None) -> SystemCheck:
    """Check torchvision: it is not needed, but a broken one keeps transformers from being imported."""
    if probed is None:
        return _optional("torchvision", True, "not installed, not needed")
    if probed.facts is not None:
        return _optional("torchvision", True, f"{probed.facts['version']}, not needed")
    why = f"broken, and breaks transformers: {probed.error}"
    return _optional("torchvision", False, why, f"{_PIP} uninstall -y torchvision")


def _metrics() -> list[SystemCheck]:
    """Check LPIPS metric by metric, because each needs two files."""
    from ambiguous_wild.metrics import lpips
    from ambiguous_wild.vision import weight_registry

    checks = []
    for metric in lpips.VARIANTS:
        missing = lpips.missing_weights(metric)
        detail = f"weights missing: {', '.join(missing)}" if missing else "weights found"
        checks.append(
            _optional(metric, not missing, detail, weight_registry.download_hint(*missing) if missing else "")
        )
    return checks


def _git() -> SystemCheck:
    version = readiness.first_output_line("git", "--version")
    fix = _system_install("git", "https://git-scm.com/downloads")
    return _optional("git", version is not None, version or "not installed", fix)


def _warm() -> str:
    """Compile the kernels; return what is wrong, for after the checks, which may say why."""
    try:
        from ambiguous_wild.methods.refinesplat.multiview import compile_kernels
        from ambiguous_wild.simulate.photo_render import compile_tracer
        from ambiguous_wild.splat.calibration import warm_up

        warm_up(lambda line: click.echo(line, err=True), helper=True)
        compile_kernels()
        compile_tracer()
    except Exception as error:  # whatever a damaged installation raises
        return f"the kernels could not be compiled: {type(error).__name__}: {error}"
    return ""


@click.command(name="doctor")
@json_option
@click.option(
    "--warm", is_flag=True,
    help="First compile the CPU kernels of 3dgs, refinesplat and the simulator, into $NUMBA_CACHE_DIR if that "
    "is set: a folder that containers and machines with such a processor can use, also read-only.",
)  # fmt: skip
def command(as_json: bool, warm: bool) -> None:
    """Check this machine: packages, CPU, GPU, kernels, weights; with a command to install what is missing.

    Exit code 0 if the core works (optional parts may be missing), else 2.
    """
    problem = _warm() if warm else ""
    checks = all_checks()
    broken = [c for c in checks if c.group == "core" and not c.ok]
    if as_json:
        facts = {"ok": not broken, "checks": [dataclasses.asdict(c) for c in checks]}
        click.echo(json.dumps(facts, indent=2, ensure_ascii=False))
    else:
        for group in ("core", "optional"):
            _print_group(group, [c for c in checks if c.group == group])
    if broken:
        names = ", ".join(c.name for c in broken)
        raise AwError(f"the core does not work on this machine: {names}; first run: {broken[0].fix}")
    if problem:
        raise AwError(problem)
    if not as_json:
        missing = sum(c.group == "optional" and not c.ok for c in checks)
        click.echo()
        say(
            f"the core works; {missing} optional parts are missing" if missing else "all parts work", out=True
        )


def _print_group(group: str, checks: list[SystemCheck]) -> None:
    if not checks:
        return
    click.secho(("" if group == "core" else "\n") + group, bold=True)
    width = max(len(c.name) for c in checks)
    for c in checks:
        mark, colour = ("✓", "green") if c.ok else ("✗", "red" if c.group == "core" else "yellow")
        say(f"  {mark} {c.name.ljust(width)}  {c.detail}", out=True, fg=colour, only=mark)
        if not c.ok and c.fix:
            say(f"    {' ' * width}  → {c.fix}", out=True)
