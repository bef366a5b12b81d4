"""Pretrained models: find the folder or download it, check it, load every tensor, else a one-line error."""

from __future__ import annotations

import functools
import hashlib
import importlib.util
import json
import logging
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ambiguous_wild.core import AwError
from ambiguous_wild.core.errors import install_command, shortlist
from ambiguous_wild.core.weight_files import expanded, not_finite
from ambiguous_wild.io.files import sha256_file
from ambiguous_wild.vision import weight_download, weight_registry

TENSORS = weight_registry.TENSORS


@dataclass(frozen=True)
class Pretrained:
    """A folder with one complete model of an expected type."""

    name: str
    folder: Path
    config: dict[str, Any]  # config.json
    digest: str  # hash of the tensors and config.json, 12 hex digits; part of cache keys
    advice: str  # what to do if a file cannot be used

    @property
    def model_type(self) -> str:
        return str(self.config["model_type"])


def locate(name: str, model_types: Sequence[str], explicit: str | Path | None = None) -> Pretrained:
    """Find the model's folder and check it without loading it.

    Uses the explicit folder, else AW_WEIGHTS/name, else the hub's cache, else downloads it
    (`vision.weight_download`).

    Args:
        name: name of the weights, e.g. ``"dinov2-small"``.
        model_types: allowed values of model_type in config.json.
        explicit: the user's folder; if given, no other is searched.

    Raises:
        AwError: transformers is not installed; the name is unknown; the weights are missing and cannot be
            downloaded; the folder lacks a file, holds another type of model, or no safetensors.
    """
    if importlib.util.find_spec("transformers") is None:
        raise AwError(
            f"{name} needs transformers, which is not installed; install it with: {install_command('masks')}"
        )
    if explicit is not None:
        return _inspect(name, expanded(explicit, "the folder of weights"), model_types)
    weight = weight_registry.get_weight(name)
    folder, reason = weight_registry.find_weight(weight)
    return _inspect(name, folder or _download(weight, reason), model_types)


def load(source: Pretrained, class_name: str, harmless: Sequence[str] = (), **options: Any) -> Any:
    """Load the model in float32, frozen, in evaluation mode; every tensor must come from the file.

    By default the library only logs a missing tensor and fills it with random values; here it is an error.

    Args:
        source: the result of `locate`.
        class_name: name of the library's class.
        harmless: prefixes of tensors in the file that the class may ignore.
        options: arguments of the class.

    Raises:
        AwError: a tensor is missing, unexpected, of another shape or not finite; a file is damaged.
    """
    import torch

    cls = model_class(class_name)
    # building a net draws random numbers; keep the caller's generator unchanged
    with _quiet(), torch.random.fork_rng(devices=[]):
        try:
            model, report = cls.from_pretrained(
                str(source.folder),
                use_safetensors=True,  # never a pickle
                local_files_only=True,
                output_loading_info=True,
                dtype=torch.float32,
                **options,
            )
        # no common base class for damaged files, other shapes and invalid configs
        except Exception as error:
            first = str(error).strip().splitlines()[0] if str(error).strip() else type(error).__name__
            raise AwError(
                f"{source.folder} could not be loaded as {class_name}: {first}; {source.advice}"
            ) from error
    left_over = [k for k in report["unexpected_keys"] if not k.startswith(tuple(harmless))]
    wrong = {
        "missing": list(report["missing_keys"]),
        "unexpected": left_over,
        "of another shape": [str(k[0] if isinstance(k, tuple) else k) for k in report["mismatched_keys"]],
    }
    if any(wrong.values()):
        what = "; ".join(f"{len(k)} {kind}: {shortlist(sorted(k), 3)}" for kind, k in wrong.items() if k)
        raise AwError(
            f"{source.folder} is not a complete {class_name} (tensors {what}); the rest would be random: "
            f"{source.advice}"
        )
    broken = not_finite(model.state_dict())
    if broken is not None:
        raise AwError(
            f"{source.folder / TENSORS} holds values that are not finite, in tensor {broken}; {source.advice}"
        )
    return model.eval().requires_grad_(False)


def model_class(name: str) -> Any:
    """Import a class of transformers by name.

    Raises:
        AwError: the import fails, most often because torchvision does not match torch.
    """
    try:
        import transformers

        return getattr(transformers, name)
    except Exception as error:  # a broken torchvision raises RuntimeError, ImportError, AttributeError ...
        cause = str(error).strip().splitlines()[-1] if str(error).strip() else type(error).__name__
        if importlib.util.find_spec("torchvision") is not None and not _imports("torchvision"):
            raise AwError(
                "transformers cannot be imported: the installed torchvision does not match torch. It is not "
                "needed; remove it with: pip uninstall -y torchvision"
            ) from error
        raise AwError(
            f"transformers has no usable {name}: {cause}; reinstall it with: {install_command('masks')}"
        ) from error


def _imports(name: str) -> bool:
    try:
        importlib.import_module(name)
    except Exception:
        return False
    return True


def _inspect(name: str, folder: Path, model_types: Sequence[str]) -> Pretrained:
    if not folder.is_dir():
        raise AwError(
            f"no folder {folder} with the weights of {name}; give a folder with config.json and {TENSORS}"
        )
    path, advice = folder / "config.json", _advice(name, folder)
    try:
        config = json.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError as error:
        raise AwError(
            f"{folder} has no config.json, so it is not a pretrained model; {name} needs config.json"
            f" and {TENSORS}"
        ) from error
    except (OSError, ValueError) as error:
        raise AwError(f"cannot read {path}: {error}; {advice}") from error
    model_type = config.get("model_type") if isinstance(config, dict) else None
    if model_type not in model_types:
        raise AwError(
            f"{folder} holds a model of type {model_type!r}, {name} needs {' or '.join(model_types)}; "
            f"{advice}"
        )
    if not (folder / TENSORS).is_file():
        pickle = (folder / "pytorch_model.bin").is_file()
        why = "pytorch_model.bin only, a pickle that can run code" if pickle else f"no {TENSORS}"
        raise AwError(f"{folder} has {why}; {name} needs {TENSORS}")
    return Pretrained(name, folder, config, _digest(folder), advice)


def _advice(name: str, folder: Path) -> str:
    """Say what to do about unusable files; the command replaces only a folder that it finds itself."""
    registered = {weight.name: weight for weight in weight_registry.KNOWN + weight_registry.OTHER_SIZES}
    if name in registered and weight_registry.weight_path(registered[name]) == folder:
        return f"run: {weight_registry.get_command(name, again=True)}"
    return "replace this folder by a complete one"


def _digest(folder: Path) -> str:
    parts = [_file_digest(str(folder / f), (folder / f).stat().st_mtime_ns) for f in ("config.json", TENSORS)]
    return hashlib.sha256("".join(parts).encode()).hexdigest()[:12]


@functools.lru_cache(maxsize=64)  # hash large files once a process, not once a back end
def _file_digest(path: str, changed_ns: int) -> str:
    return sha256_file(path)


def _download(weight: weight_registry.Weight, reason: str) -> Path:
    """Download the weights into the weights folder, unless the hub is switched off."""
    try:
        if weight_download.offline():
            raise weight_download.hub_error(weight, weight_download.switched_off())
        return weight_download.download_weights(
            [weight], lambda line: print(line, file=sys.stderr, flush=True)
        )[0]
    except AwError as error:
        raise AwError(f"the weights of {weight.name} are missing ({reason}); {error}") from None


@contextmanager
def _quiet() -> Iterator[None]:
    """Silence the library's report and bars: `load` reports problems as one error."""
    from transformers.utils import logging as library

    root = logging.getLogger("transformers")
    level, bars = root.level, library.is_progress_bar_enabled()
    root.setLevel(logging.ERROR)
    library.disable_progress_bar()
    try:
        yield
    finally:
        root.setLevel(level)
        if bars:
            library.enable_progress_bar()
