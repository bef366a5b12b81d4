"""Which pretrained weights are on this machine, where they are searched, and how to download them.

This module imports neither torch nor transformers and downloads nothing; it only reports.
"""

from __future__ import annotations

import os
import shlex
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, NamedTuple


@dataclass(frozen=True)
class Weight:
    """One pretrained model and the files it needs."""

    name: str  # also its folder below AW_WEIGHTS
    kind: Literal["hub", "file"]  # a transformers folder, or a single file
    files: tuple[str, ...]  # all are needed
    used_for: str
    hub_id: str = ""  # of kind hub
    url: str = ""  # of kind file


class WeightStatus(NamedTuple):
    """One line of `status`."""

    name: str
    present: bool
    where: str  # the path, or why it is missing
    command: str  # downloads it; "" if present


DEFAULT_FOLDER = "~/.cache/ambiguous_wild/weights"  # proposed if AW_WEIGHTS is not set
_HUB_FILES = ("config.json", "model.safetensors")
_TEXT_FILES = (*_HUB_FILES, "tokenizer.json", "tokenizer_config.json")


def _hub(name: str, used_for: str, owner: str = "facebook", files: tuple[str, ...] = _HUB_FILES) -> Weight:
    return Weight(name, "hub", files, used_for, f"{owner}/{name}")


def _file(name: str, file: str, used_for: str, url: str) -> Weight:
    return Weight(name, "file", (file,), used_for, url=url)


_TORCHVISION = "https://download.pytorch.org/models"
_LPIPS = "https://raw.githubusercontent.com/richzhang/PerceptualSimilarity/master/lpips/weights/v0.1"

KNOWN: tuple[Weight, ...] = (
    _hub("dinov2-small", "features"),
    _hub("dinov2-with-registers-small", "features"),
    _hub("dino-vits16", "features"),
    _hub("sam-vit-base", "instance masks"),
    _hub("sam2.1-hiera-tiny", "instance masks and identities"),
    _hub("grounding-dino-tiny", "instance masks by prompt", "IDEA-Research", _TEXT_FILES),
    _file("alexnet", "alexnet-owt-7be5be79.pth", "LPIPS (alex)", f"{_TORCHVISION}/alexnet-owt-7be5be79.pth"),
    _file("vgg16", "vgg16-397923af.pth", "LPIPS (vgg)", f"{_TORCHVISION}/vgg16-397923af.pth"),
    _file("lpips-alex", "lpips_alex.pth", "LPIPS (alex), linear heads", f"{_LPIPS}/alex.pth"),
    _file("lpips-vgg", "lpips_vgg.pth", "LPIPS (vgg), linear heads", f"{_LPIPS}/vgg.pth"),
)

# Other sizes of these models: loaded by name, not listed by `aw doctor`.
OTHER_SIZES: tuple[Weight, ...] = (
    _hub("dinov2-base", "features"),
    _hub("dinov2-with-registers-base", "features"),
    _hub("dino-vits8", "features"),
    _hub("dino-vitb16", "features"),
    _hub("dino-vitb8", "features"),
    _hub("sam-vit-large", "instance masks"),
    _hub("sam-vit-huge", "instance masks"),
    _hub("sam2.1-hiera-small", "instance masks and identities"),
    _hub("sam2.1-hiera-base-plus", "instance masks and identities"),
    _hub("sam2.1-hiera-large", "instance masks and identities"),
    _hub("grounding-dino-base", "instance masks by prompt", "IDEA-Research", _TEXT_FILES),
)


def named(name: str) -> Weight:
    """The weights of this name, from `KNOWN` or `OTHER_SIZES`.

    Raises:
        AwError: unknown; names the nearest.
    """
    from ambiguous_wild.core.errors import unknown  # imports numpy, which `status` does not need

    every = {weight.name: weight for weight in KNOWN + OTHER_SIZES}
    if name not in every:
        raise unknown("pretrained model", name, every)
    return every[name]


def weights_folder() -> Path | None:
    """The folder AW_WEIGHTS, or None if the variable is not set."""
    value = os.environ.get("AW_WEIGHTS", "").strip()
    return Path(value).expanduser() if value else None


def torch_hub_folder() -> Path:
    """Folder of checkpoints that torch downloads: TORCH_HOME/hub/checkpoints or its default."""
    cache = Path(os.environ.get("XDG_CACHE_HOME", "~/.cache")).expanduser()
    home = Path(os.environ.get("TORCH_HOME", cache / "torch")).expanduser()
    return home / "hub" / "checkpoints"


def hub_folder() -> Path:
    """Folder of models that huggingface_hub downloads: HF_HUB_CACHE, HF_HOME/hub or the default."""
    explicit = os.environ.get("HF_HUB_CACHE", "").strip()
    if explicit:
        return Path(explicit).expanduser()
    cache = Path(os.environ.get("XDG_CACHE_HOME", "~/.cache")).expanduser()
    return Path(os.environ.get("HF_HOME", cache / "huggingface")).expanduser() / "hub"


def find(weight: Weight) -> tuple[Path | None, str]:
    """The folder with every file of the weights, or None and the reason."""
    places = _places(weight)
    for place in places:
        missing = [name for name in weight.files if not (place / name).is_file()]
        if not missing:
            return place, ""
        if place.is_dir() and len(missing) < len(weight.files):
            return None, f"incomplete: {place} lacks {', '.join(missing)}"
        if place.is_dir() and (place / "pytorch_model.bin").is_file():
            return None, f"{place} has pytorch_model.bin only; model.safetensors is needed"
    return None, "not in " + ", ".join(str(p) for p in _searched(weight))


def status() -> list[WeightStatus]:
    """Every entry of `KNOWN`: name, present or not, path or reason, and the command that downloads it."""
    lines = []
    for weight in KNOWN:
        place, reason = find(weight)
        if place is not None:
            lines.append(WeightStatus(weight.name, True, str(place), ""))
        else:
            lines.append(WeightStatus(weight.name, False, reason, download_command(weight)))
    return lines


def _places(weight: Weight) -> list[Path]:
    """Folders to search, in order."""
    own = weights_folder()
    places = [own / weight.name] if own else []
    if weight.kind == "file":
        return places + ([own] if own else []) + [torch_hub_folder()]
    repository = hub_folder() / ("models--" + weight.hub_id.replace("/", "--"))
    main = repository / "refs" / "main"
    try:
        commit = main.read_text(encoding="utf-8").strip()
    except (OSError, UnicodeDecodeError):
        commit = ""
    # the commit becomes a folder name, so accept hexadecimal digits only
    if commit and all(c in "0123456789abcdef" for c in commit):
        places.append(repository / "snapshots" / commit)
    return places


def _searched(weight: Weight) -> list[Path]:
    own = weights_folder()
    return ([own / weight.name] if own else []) + [
        torch_hub_folder() if weight.kind == "file" else hub_folder()
    ]


def download_command(*weights: Weight) -> str:
    """A shell command that downloads the weights; sets AW_WEIGHTS first if it is not set."""
    own = weights_folder()
    folder = shlex.quote(str(own)) if own else '"$AW_WEIGHTS"'
    steps = [] if own else [f"export AW_WEIGHTS={DEFAULT_FOLDER}"]
    if any(weight.kind == "file" for weight in weights):
        steps.append(f"mkdir -p {folder}")
    for weight in weights:
        if weight.kind == "hub":
            files = " ".join(weight.files)
            steps.append(f"hf download {weight.hub_id} {files} --local-dir {folder}/{weight.name}")
        else:
            steps.append(f"curl -fL -o {folder}/{weight.files[0]} {weight.url}")
    return " && ".join(steps)
