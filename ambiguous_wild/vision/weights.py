"""Which pretrained weights are on this machine, where they are looked for, and what brings them.

Nothing here imports torch or transformers and nothing downloads: a missing weight is a fact to report.
"""

from __future__ import annotations

import os
import shlex
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


USUAL_FOLDER = "~/.cache/ambiguous_wild/weights"  # proposed where AW_WEIGHTS is not set
_HUB_FILES = ("config.json", "model.safetensors")
_TEXT_FILES = (*_HUB_FILES, "tokenizer.json", "tokenizer_config.json")


def _hub(name: str, used_for: str, owner: str = "facebook", files: tuple[str, ...] = _HUB_FILES) -> Weight:
    return Weight(name, "hub", files, used_for, f"{owner}/{name}")


KNOWN: tuple[Weight, ...] = (
    _hub("dinov2-small", "features"),
    _hub("dinov2-with-registers-small", "features"),
    _hub("dino-vits16", "features"),
    _hub("sam-vit-base", "instance masks"),
    _hub("sam2.1-hiera-tiny", "instance masks and identities"),
    _hub("grounding-dino-tiny", "instance masks by prompt", "IDEA-Research", _TEXT_FILES),
    Weight("alexnet", "file", ("alexnet-owt-7be5be79.pth",), "LPIPS (alex)"),
    Weight("vgg16", "file", ("vgg16-397923af.pth",), "LPIPS (vgg)"),
    Weight("lpips-alex", "file", ("lpips_alex.pth",), "LPIPS (alex), the learnt heads"),
    Weight("lpips-vgg", "file", ("lpips_vgg.pth",), "LPIPS (vgg), the learnt heads"),
)

# Larger or finer ones of the same kinds: found and loaded by name, not listed by `aw doctor`.
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
    """The weight of that name, of the listed ones or the other sizes.

    Raises:
        AwError: there is none; names the nearest.
    """
    from ambiguous_wild.core.errors import unknown  # brings numpy, which `status` does without

    every = {weight.name: weight for weight in KNOWN + OTHER_SIZES}
    if name not in every:
        raise unknown("pretrained model", name, every)
    return every[name]


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
            lines.append(WeightStatus(weight.name, False, reason, bring(weight)))
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


def bring(weight: Weight) -> str:
    """A command to paste; where AW_WEIGHTS is not set it sets it first."""
    own = weights_folder()
    start = "" if own else f"export AW_WEIGHTS={USUAL_FOLDER} && "
    folder, files = shlex.quote(str(own)) if own else '"$AW_WEIGHTS"', " ".join(weight.files)
    if weight.kind == "hub":
        return f"{start}hf download {weight.hub_id} {files} --local-dir {folder}/{weight.name}"
    return f"{start}mkdir -p {folder} && cp {files} {folder}/"
