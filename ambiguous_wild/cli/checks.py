"""What `aw doctor` looks at: each check says what it found and, where something lacks, what brings it.

Nothing heavy is imported with this module: what may crash or hang is tried by `probes`, all at the same time.
"""

from __future__ import annotations

import importlib.metadata
import importlib.util
import os
import platform
import shlex
import shutil
import sys
from collections.abc import Iterable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from ambiguous_wild.cli.probes import PROBES, Probe, probe
from ambiguous_wild.core.errors import AwError
from ambiguous_wild.core.extras import install_command
from ambiguous_wild.harness.environment import installed
from ambiguous_wild.splat import cuda_ready

PACKAGE = Path(__file__).resolve().parent.parent
DISTRIBUTION = "ambiguous-wild"
SMALL_MEMORY_GB = 2.0  # below it COLMAP and a training of 100 000 Gaussians do not fit
UNUSED = "not used by this version yet"
SMALL_DISK_GB = 1.0  # photos, features and one run


@dataclass(frozen=True)
class Check:
    """One line of the report."""

    group: Literal["core", "optional", "planned"]  # planned: no code of this version uses it
    name: str
    ok: bool
    detail: str  # what was found
    fix: str = ""  # the command that brings it; empty where nothing lacks or nothing is gained


def all_checks() -> list[Check]:
    """Every check, core first."""
    names = [n for n in PROBES if n != "torchvision" or importlib.util.find_spec(n) is not None]
    with ThreadPoolExecutor(len(names)) as pool:
        found = dict(zip(names, pool.map(probe, names)))
    return [
        *_machine(),
        *_packages(),
        _library("torch", found["torch"], "training and LPIPS"),
        _library("OpenImageIO", found["OpenImageIO"], "reading photos"),
        _library("pycolmap", found["pycolmap"], "structure from motion; a PNG written after it is intact"),
        *_numba(found["numba"]),
        *_gpu(found["torch"]),
        _torchvision(found.get("torchvision")),
        *_vision(),
        *_metrics(),
        _git(),
        *_extras(),
        *_planned(),
    ]


def _machine() -> list[Check]:
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    python = sys.version_info >= (3, 11)
    checks = [
        Check(
            "core",
            "python",
            python,
            platform.python_version(),
            "" if python else "install Python 3.11 or newer",
        ),
        Check("core", "cpu", True, f"{cores} cores usable of {os.cpu_count()}, {platform.machine()}"),
    ]
    memory = _memory_gb()
    if memory is not None:
        fine = memory >= SMALL_MEMORY_GB
        fix = (
            "" if fine else f"free some, or train with --max-gaussians: {SMALL_MEMORY_GB:.0f} GB are advised"
        )
        checks.append(Check("core", "memory", fine, f"{memory:.1f} GB", fix))
    free = shutil.disk_usage(Path.cwd()).free / 1e9
    fine = free >= SMALL_DISK_GB
    fix = "" if fine else f"free {SMALL_DISK_GB:.0f} GB, or work elsewhere"
    checks.append(Check("core", "disk", fine, f"{free:.0f} GB free in {Path.cwd()}", fix))
    return checks


def _memory_gb() -> float | None:
    """Physical memory; None where the system does not say."""
    try:
        return os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / 1e9
    except (AttributeError, ValueError, OSError):
        return None


def _packages() -> list[Check]:
    """The required packages against their ranges, and against the versions the project is tested with."""
    try:
        required = importlib.metadata.requires(DISTRIBUTION) or []
    except importlib.metadata.PackageNotFoundError:
        return [Check("core", "packages", False, f"{DISTRIBUTION} is not installed", "pip install -e .")]
    wrong = unmet(r for r in required if "extra ==" not in r)
    if wrong:
        fix = "pip install " + " ".join(f"'{w}'" for w in wrong)
        return [Check("core", "packages", False, "absent or too old: " + ", ".join(wrong), fix)]
    other = other_versions(PACKAGE.parent / "constraints.txt")
    detail = f"all {sum('extra ==' not in r for r in required)} required ones"
    if other is None:
        return [Check("core", "packages", True, detail)]
    detail += ", the tested versions" if not other else "; not the tested version: " + ", ".join(other)
    return [Check("core", "packages", True, detail)]


def unmet(requirements: Iterable[str]) -> list[str]:
    """The requirements ("name>=1.0") that what is installed does not meet."""
    from packaging.requirements import Requirement

    wrong = []
    for text in requirements:
        requirement = Requirement(text)
        version = installed(requirement.name)
        if version is None or not requirement.specifier.contains(version, prereleases=True):
            wrong.append(f"{requirement.name}{requirement.specifier}")
    return wrong


def other_versions(constraints: Path) -> list[str] | None:
    """Installed packages whose version is not the pinned one; None where there is no such file."""
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


def _library(name: str, found: Probe, use: str) -> Check:
    if found.facts is not None:
        return Check("core", name, True, f"{found.facts['version']} ({use})")
    fix = "pip install -c constraints.txt --force-reinstall --no-deps " + name
    return Check("core", name, False, f"{found.error} ({use})", fix)


def _numba(found: Probe) -> list[Check]:
    if found.facts is None:
        fix = "pip install -c constraints.txt --force-reinstall numba llvmlite"
        return [Check("core", "numba", False, found.error, fix)]
    layer = f"{found.facts['threads']} threads, layer {found.facts['layer']}"
    checks = [Check("core", "numba", True, layer)]
    from ambiguous_wild.splat.cpu.cache import kernel_cache

    folder = kernel_cache()
    existing = next(p for p in (folder, *folder.parents) if p.exists())
    compiled = len(list(folder.rglob("*.nbi"))) if folder.is_dir() else 0
    state = (
        f"{compiled} kernels compiled" if compiled else "not compiled yet: the first run takes a minute more"
    )
    writable = os.access(existing, os.W_OK)
    where = f"in {folder}" if writable else f"{folder} is not writable"
    fix = "" if writable else "export NUMBA_CACHE_DIR=$HOME/.cache/numba"
    checks.append(Check("core", "kernel cache", writable, f"{state}, {where}", fix))
    return checks


def _gpu(torch: Probe) -> list[Check]:
    """In the words with which `--device` refuses a GPU."""
    if torch.facts is None:
        return [Check("optional", "torch cuda", False, torch.error, "mend torch first")]
    found = cuda_ready.look(torch.facts)
    driver, version = found.driver, installed("gsplat") or "present"
    checks = [
        Check("optional", "nvidia driver", driver is not None, driver or "no nvidia-smi; the CPU is used",
              "" if driver else "install the NVIDIA driver, if there is a GPU"),
        _part("torch cuda", ", ".join(torch.facts["names"]), cuda_ready.no_cuda(found)),
        _part("gsplat", version, cuda_ready.no_gsplat(found)),
    ]  # fmt: skip
    if found.gsplat and found.has_gpu:
        state = f"compiled, in {found.folder}"
        if found.prebuilt:
            state = "part of its wheel"
        elif not found.compiled:
            state = f"not compiled yet: the first run takes several minutes more, kept in {found.folder}"
        checks.append(_part("gsplat kernels", state, cuda_ready.no_kernels(found)))
    return checks


def _part(name: str, fine: str, lack: cuda_ready.Lack | None) -> Check:
    return Check(
        "optional", name, lack is None, fine if lack is None else lack.what, lack.fix if lack else ""
    )


def _extras() -> list[Check]:
    """Packages that one command needs, and a program that has an environment of its own."""
    from ambiguous_wild.methods.external.nerfbaselines import find_program

    packages = {
        "ray": ("ray", "aw bench --engine ray"),
        "choix": ("study", "aw study score: ranking"),
        "nltk": ("study", "aw study score: agreement"),
    }
    checks = []
    for name, (extra, use) in packages.items():
        version = installed(name)
        fix = "" if version else install_command(extra)
        checks.append(Check("optional", name, version is not None, f"{version or 'absent'} ({use})", fix))
    try:
        checks.append(Check("optional", "nerfbaselines", True, f"{find_program()} (its methods)"))
    except AwError as error:
        what, _, fix = str(error).partition(": ")
        checks.append(Check("optional", "nerfbaselines", False, what, fix))
    return checks


def _planned() -> list[Check]:
    """What later versions will use: named without a command, so that nobody installs it for nothing."""
    packages = {"viser": "interactive viewer"}
    return [
        Check(
            "planned", name, bool(version := installed(name)),
            f"{'present' if version else 'absent'}, {UNUSED} ({use})",
        )
        for name, use in packages.items()
    ]  # fmt: skip


def _vision() -> list[Check]:
    """Real foundation models: the package that runs them, and which weights are here."""
    from ambiguous_wild.vision import weights

    version = installed("transformers")
    detail = f"{version or 'absent'} (DINO features, SAM masks)"
    fix = "" if version else install_command("masks")
    checks = [Check("optional", "transformers", version is not None, detail, fix)]
    hub = {w.name: w.used_for for w in weights.KNOWN if w.kind == "hub"}
    checks += [
        Check("optional", line.name, line.present, f"{hub[line.name]}: {line.where}", line.bring)
        for line in weights.status()
        if line.name in hub
    ]
    return checks


def _torchvision(found: Probe | None) -> Check:
    """Absent is fine. Present but broken takes transformers down with it."""
    if found is None:
        return Check("optional", "torchvision", True, "absent, and not needed")
    if found.facts is not None:
        return Check("optional", "torchvision", True, f"{found.facts['version']}, not needed")
    return Check("optional", "torchvision", False, f"broken, and breaks transformers: {found.error}",
                 "pip uninstall torchvision")  # fmt: skip


def _metrics() -> list[Check]:
    """LPIPS by metric, not by file: a backbone alone measures nothing."""
    from ambiguous_wild.metrics import lpips
    from ambiguous_wild.vision import weights

    own = weights.weights_folder()
    if own:
        folder = f"mkdir -p {shlex.quote(str(own))}"
    else:
        folder = f'export AW_WEIGHTS={weights.USUAL_FOLDER} && mkdir -p "$AW_WEIGHTS"'
    checks = []
    for metric, reason in lpips.available().items():
        detail, _, what = (reason or "weights found").partition(": ")
        # A comment keeps the line fit to paste: no program brings these files.
        fix = f"{folder}  # then {what.rpartition(' into ')[0]} into it" if what else ""
        checks.append(Check("optional", metric, reason is None, detail, fix))
    return checks


def _git() -> Check:
    version = cuda_ready.first_line("git", "--version")
    return Check(
        "optional", "git", version is not None, version or "absent", "" if version else "install git"
    )
