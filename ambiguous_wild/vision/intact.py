"""Whether files of weights are whole and those that were published; no network is built."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from ambiguous_wild.core import AwError
from ambiguous_wild.io.hashing import sha256_file
from ambiguous_wild.vision import hub
from ambiguous_wild.vision.convert import read_as_arrays, tensors_digest, used_tensors
from ambiguous_wild.vision.weights import Weight


def check(weight: Weight, place: Path, advice: str) -> None:
    """Check the file, or each file of the folder.

    Args:
        weight: of the registry.
        place: from `weights.where`.
        advice: what to do about a file that cannot be used; ends the error.

    Raises:
        AwError: a file is damaged, or not the one that was published or downloaded.
    """
    if weight.kind == "file":
        check_file(weight, place, advice)
    else:
        check_folder(weight, place, advice)


def check_file(weight: Weight, path: Path, advice: str) -> int:
    """Read the file and compare its hash; the number of its tensors. See `check`."""
    arrays = used_tensors(weight, read_as_arrays(path, advice))
    check_published(weight, path, arrays, advice)
    return len(arrays)


def check_published(
    weight: Weight, path: Path, arrays: Mapping[str, np.ndarray], advice: str, sha256: str = ""
) -> None:
    """Compare the file with the published one.

    Args:
        weight: of kind file.
        path: of the file.
        arrays: its `used_tensors`.
        advice: see `check`.
        sha256: of the file, if it is known already.

    Raises:
        AwError: it is another one.
    """
    stated = path.stem.rpartition("-")[2]  # torchvision's names end in the first 8 digits of the sha256
    if path.suffix == ".pth" and len(stated) == 8 and set(stated) <= set("0123456789abcdef"):
        if not (sha256 or sha256_file(path)).startswith(stated):
            raise AwError(f"{path} does not have the sha256 of its name; {advice}")
    elif weight.tensors and tensors_digest(arrays) != weight.tensors:
        raise AwError(f"{path} holds other tensors than those published; {advice}")


def check_folder(weight: Weight, folder: Path, advice: str) -> bool:
    """Compare the files with the hashes of their download; whether such hashes are there.

    Without them, JSON files must parse, and tensors must have the length that their header states.
    """
    receipt = folder / hub.RECEIPT
    if not receipt.is_file():
        for name in weight.files:
            _parse(folder / name, advice)
        return False
    try:
        stated = json.loads(receipt.read_text(encoding="utf-8"))["sha256"]
        wrong = [name for name in weight.files if sha256_file(folder / name) != stated[name]]
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise AwError(f"cannot read {receipt} ({error}); {advice}") from None
    if wrong:
        raise AwError(f"{folder / wrong[0]} has changed since its download; {advice}")
    return True


def _parse(path: Path, advice: str) -> None:
    from safetensors import SafetensorError, safe_open

    try:
        if path.suffix == ".safetensors":
            with safe_open(path, framework="numpy"):
                return
        json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError, SafetensorError) as error:
        raise AwError(f"{path} is damaged ({error}); {advice}") from None
