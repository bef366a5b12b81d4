"""Read NerfBaselines' folders, whose nb-info.json names the loader and the evaluation protocol."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from pathlib import Path

from ambiguous_wild.core.errors import AwError, unknown
from ambiguous_wild.core.scene import Evaluation
from ambiguous_wild.datasets.foreign import ForeignScene, inside
from ambiguous_wild.datasets.imported_photos import at_photo_size
from ambiguous_wild.datasets.readers.colmap import read_plain
from ambiguous_wild.datasets.readers.phototourism import NERF_W, read_phototourism
from ambiguous_wild.datasets.readers.transforms import read_blender, read_object, read_transforms

COLMAP = {"colmap": read_plain, "phototourism": read_phototourism}
LOADERS: dict[str, Callable[..., ForeignScene]] = {
    **COLMAP,
    "nerfstudio": read_transforms,
    "blender": read_blender,
}
DATASETS = {
    "phototourism": "Photo Tourism",
    "nerfonthego": "NeRF On-the-go",
    "nerfonthego-undistorted": "NeRF On-the-go",
    "robustnerf": "RobustNeRF",
}
PROTOCOLS: dict[str, Evaluation] = {"default": {}, "nerf": {}, "nerfw": NERF_W}


def read_nerfbaselines(root: Path, chosen: str = "") -> ForeignScene:
    """Read a folder with nb-info.json.

    Raises:
        AwError: another loader, protocol or folder than are supported.
    """
    path = root / "nb-info.json"
    info = read_object(path)
    # The loader is a name or a function: nerfbaselines.datasets.phototourism:load_phototourism_dataset
    loader = str(info.get("loader", "colmap")).partition(":")[0].rpartition(".")[2]
    if loader not in LOADERS:
        raise unknown(f"loader in {path}", loader[:60], LOADERS)
    protocol = str(info.get("evaluation_protocol") or ("nerfw" if loader == "phototourism" else "default"))
    if protocol not in PROTOCOLS:
        raise unknown(f"evaluation_protocol in {path}", protocol[:60], PROTOCOLS)
    scene = LOADERS[loader](root, chosen) if loader in COLMAP else LOADERS[loader](root)
    kwargs = info.get("loader_kwargs")
    options: dict[str, object] = kwargs if isinstance(kwargs, dict) else {}
    images = options.get("images_path", "images")
    factor = _factor(str(images), _whole(info.get("downscale_factor")), root, path)
    loaded = _whole(info.get("downscale_loaded_factor") or options.get("downscale_loaded_factor"))
    if loaded > 1:  # this factor refers to the photos on disk, not to their cameras
        factor = loaded * max(factor, round(at_photo_size(scene)[1]))
    identity = str(info.get("id") or "").lower()
    return dataclasses.replace(
        scene,
        kind="nerfbaselines",
        factor=factor,
        dataset=DATASETS.get(identity, scene.dataset),
        evaluation=PROTOCOLS[protocol],
    )


def _whole(stated: object) -> int:
    return stated if isinstance(stated, int) and not isinstance(stated, bool) and stated > 1 else 1


def _factor(images: str, stated: int, root: Path, path: Path) -> int:
    """Return the factor in the name of a folder: 8 for images_8, 1 for images."""
    folder = inside(images, root)
    tail = folder.removeprefix("images").removeprefix("_")
    if folder == "images":
        return stated  # refers to the cameras; `aw import` compares the photos on disk with them
    if not tail.isdigit() or not 1 <= int(tail) <= 64:
        raise AwError(f"{path}: images_path {images[:60]!r} is not supported: images or images_N is")
    return int(tail)
