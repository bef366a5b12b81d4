"""Which pretrained weights are on this machine, where they are looked for, and what brings them.

Nothing here imports torch or transformers and nothing downloads: a missing weight is a fact to report.
"""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, NamedTuple


@dataclass(frozen=True)
class Weight:
    """One pretrained model we can use, and the files that make it whole."""

    name: str  # also its folder below AW_WEIGHTS
    kind: Literal["hub", "file"]  # a transformers folder, or single files
    files: tuple[str, ...]  # all of them are needed
    used_for: str
    hub_id: str = ""  # of kind hub


class WeightStatus(NamedTuple):
    """One line of `status`."""

    name: str
    present: bool
    where: str  # the path, or why it is missing
    bring: str  # what to do to have it; "" when present


_HUB_FILES = ("config.json", "model.safetensors")
KNOWN: tuple[Weight, ...] = (
    Weight("dinov2-small", "hub", _HUB_FILES, "features", "facebook/dinov2-small"),
    Weight(
        "dinov2-with-registers-small", "hub", _HUB_FILES, "features", "facebook/dinov2-with-registers-small"
    ),
    Weight("dino-vits16", "hub", _HUB_FILES, "features", "facebook/dino-vits16"),
    Weight("sam-vit-base", "hub", _HUB_FILES, "instance masks", "facebook/sam-vit-base"),
    Weight("sam2.1-hiera-tiny", "hub", _HUB_FILES, "instance masks", "facebook/sam2.1-hiera-tiny"),
    Weight("grounding-dino-tiny", "hub", _HUB_FILES, "instance masks", "IDEA-Research/grounding-dino-tiny"),
    Weight("alexnet", "file", ("alexnet-owt-7be5be79.pth",), "LPIPS (alex)"),
    Weight("vgg16", "file", ("vgg16-397923af.pth",), "LPIPS (vgg)"),
    Weight("lpips-alex", "file", ("lpips_alex.pth",), "LPIPS (alex), the learnt heads"),
    Weight("lpips-vgg", "file", ("lpips_vgg.pth",), "LPIPS (vgg), the learnt heads"),
)


def weights_folder() -> Path | None:
    """The folder of AW_WEIGHTS, or None where the variable is not set."""
    value = os.environ.get("AW_WEIGHTS", "").strip()
    return Path(value).expanduser() if value else None


def torch_hub_folder() -> Path:
    """Where torch keeps downloaded checkpoints: TORCH_HOME/hub/checkpoints or its default."""
    cache = Path(os.environ.get("XDG_CACHE_HOME", "~/.cache")).expanduser()
    home = Path(os.environ.get("TORCH_HOME", cache / "torch")).expanduser()
    return home / "hub" / "checkpoints"


def hub_folder() -> Path:
    """Where huggingface_hub keeps downloaded models: HF_HUB_CACHE, HF_HOME/hub or the default."""
    explicit = os.environ.get("HF_HUB_CACHE", "").strip()
    if explicit:
        return Path(explicit).expanduser()
    cache = Path(os.environ.get("XDG_CACHE_HOME", "~/.cache")).expanduser()
    return Path(os.environ.get("HF_HOME", cache / "huggingface")).expanduser() / "hub"


def find(weight: Weight) -> tuple[Path | None, str]:
    """The folder that holds every file of the weight, or None and the reason."""
    places = _places(weight)
    for place in places:
        missing = [name for name in weight.files if not (place / name).is_file()]
        if not missing:
            return place, ""
        if place.is_dir() and len(missing) < len(weight.files):
            return None, f"incomplete: {place} lacks {', '.join(missing)}"
        if place.is_dir() and (place / "pytorch_model.bin").is_file():
            return None, f"{place} has pytorch_model.bin only; safetensors are needed"
    return None, "not in " + ", ".join(str(p) for p in _searched(weight))


def status() -> list[WeightStatus]:
    """Every weight we can use: name, present, path or reason, and what brings it."""
    lines = []
    for weight in KNOWN:
        place, reason = find(weight)
        if place is not None:
            lines.append(WeightStatus(weight.name, True, str(place), ""))
        else:
            lines.append(WeightStatus(weight.name, False, reason, _bring(weight)))
    return lines


def _places(weight: Weight) -> list[Path]:
    """Folders to look into, best first."""
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
    # the commit names a folder: nothing in that file may lead elsewhere
    if commit and all(c in "0123456789abcdef" for c in commit):
        places.append(repository / "snapshots" / commit)
    return places


def _searched(weight: Weight) -> list[Path]:
    own = weights_folder()
    return ([own / weight.name] if own else []) + [
        torch_hub_folder() if weight.kind == "file" else hub_folder()
    ]


def _bring(weight: Weight) -> str:
    folder = weights_folder() or Path("$AW_WEIGHTS")
    if weight.kind == "hub":
        target = folder / weight.name
        return f"hf download {weight.hub_id} {' '.join(weight.files)} --local-dir {target}"
    return f"copy {' and '.join(weight.files)} ({weight.used_for}) into {folder}, and set AW_WEIGHTS"
