"""Add distractors to the train photos of a real scene: write a complete scene folder with the truth.

SCENE2/images* sparse masks lists     as in the source scene; train photos changed, test photos not
SCENE2/truth/distractor/<stem>.png    255 where a cut-out or its shadow covers a quarter of the pixel or more
SCENE2/truth/clean/<stem>.png         the original train photo
SCENE2/truth/composite.json           config, cut-outs with sha256; per photo placed cut-outs and coverage
"""

from __future__ import annotations

import shutil
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import cast

import numpy as np

from ambiguous_wild import __version__
from ambiguous_wild.core.config import Facts, to_plain
from ambiguous_wild.core.errors import AwError
from ambiguous_wild.core.names import check_name
from ambiguous_wild.core.scene import Scene, SceneInfo
from ambiguous_wild.io.files import atomic_dir, sha256_file, write_json
from ambiguous_wild.io.images import image_size, read_gray, read_png_rgb, write_png
from ambiguous_wild.io.progress_bar import Progress
from ambiguous_wild.io.scene_folder import SCENE_SCHEMA, load_scene, read_scene_json
from ambiguous_wild.simulate.cutouts import (
    Cutout,
    CutoutPlacement,
    blend_layer,
    blobs,
    draw_layer,
    layer_mask,
    read_cutouts,
    resized,
)
from ambiguous_wild.simulate.placement import (
    CompositeConfig,
    cut_patches,
    local_colours,
    natural_heights,
    place_cutouts,
    scene_spread,
    solve_heights,
    visible_points,
)
from ambiguous_wild.simulate.truth_records import summary


@dataclass(frozen=True)
class _PastePlan:
    cutouts: list[Cutout]
    heights: np.ndarray  # [K] scene units
    placements: list[tuple[CutoutPlacement, ...]]  # for each train photo


def composite(
    source: Path | str,
    output: Path | str,
    config: CompositeConfig,
    cutouts: Path | str | None = None,
    progress: Progress = iter,
) -> Facts:
    """Make the scene, and return truth/composite.json.

    Poses and points come from the clean photos, so they are better than from photos with distractors.

    Args:
        source: a scene folder, ours or a plain COLMAP scene.
        output: the folder to write; it appears complete or not at all.
        config: see `CompositeConfig`.
        cutouts: folder of PNG files with alpha; may be None with ``config.patches``.
        progress: wraps the train views, for a bar.

    Raises:
        AwError: a bad scene, bad cut-outs, a coverage that cannot be reached, or an output that exists.
    """
    root, target = Path(source), Path(output)
    name = check_name("scene name (the folder's)", target.resolve().name)
    check_request(root, target, config, cutouts)
    if config.path:
        raise AwError(
            f"--path is for plain photos in the order of their names, and {root} is a scene; give the folder "
            "of its original photos"
        )
    if config.fixed is not None:
        raise AwError(
            f"--fixed is for plain photos, and {root} is a scene, whose poses were found without; give "
            "the folder of its original photos"
        )
    shape_rng, place_rng, patch_rng = (
        np.random.default_rng(s) for s in np.random.SeedSequence(config.seed).spawn(3)
    )
    shapes = blobs(shape_rng) if cutouts is None else read_cutouts(cutouts)
    scene = load_scene(root)
    _check_scene(scene)
    plan = _plan(scene, shapes, config, place_rng, patch_rng)
    with atomic_dir(target, replace=False) as folder:
        photos = _write_photos(scene, plan, config, folder, progress)
        _copy_rest(scene, folder)
        facts = _facts(scene, plan, config, photos)
        write_json(folder / "truth" / "composite.json", facts)
        _write_scene_json(scene, folder, name, facts, config.patches)
    return facts


def check_request(root: Path, target: Path, config: CompositeConfig, cutouts: Path | str | None) -> None:
    """Raise AwError for bad settings, no distractors, folders inside each other, or an output that exists."""
    config.check()
    if target.resolve().is_relative_to(root.resolve()) or root.resolve().is_relative_to(target.resolve()):
        raise AwError(f"{target} and {root} lie inside each other; choose another folder for -o")
    if target.exists() and (not target.is_dir() or any(target.iterdir())):
        raise AwError(f"{target} exists; remove it or choose another folder for -o")
    if cutouts is None and not config.patches and config.fixed is None:
        raise AwError(
            "no distractors are given: pass --cutouts FOLDER of PNG files with alpha, --patches, or (plain "
            "photos) --fixed"
        )
    if config.path and cutouts is None and not config.patches:
        raise AwError("--path moves cut-outs, and none are given: pass --cutouts FOLDER or --patches")


def _check_scene(scene: Scene) -> None:
    """Raise AwError if the scene has distractors already."""
    for view in scene.train:
        mask = scene.truth_file("distractor", view)
        if mask.is_file() and read_gray(mask).any():
            raise AwError(
                f"{scene.root} has distractors already ({mask.name} is not empty); choose a scene without any"
            )


def _plan(
    scene: Scene,
    shapes: list[Cutout],
    config: CompositeConfig,
    place_rng: np.random.Generator,
    patch_rng: np.random.Generator,
) -> _PastePlan:
    sites = visible_points(scene)
    if config.patches:
        largest = _folders(scene.root)[0]  # images, or the smallest factor there is
        shown, colours, origins = cut_patches(shapes, sites, _pictures(scene, largest), config, patch_rng)
        backgrounds = [local_colours(read_png_rgb(s.view.image_path)) for s in sites]
        chosen = {"colours": colours, "backgrounds": backgrounds, "origins": origins}
    else:
        shown, chosen = shapes, {}
    natural = natural_heights(shown, place_rng)
    placements = place_cutouts(sites, scene_spread(scene), config, place_rng, len(shown), **chosen)  # type: ignore[arg-type]
    heights = solve_heights(shown, natural, sites, placements, config)
    return _PastePlan(shown, heights, placements)


def _folders(root: Path) -> list[str]:
    """Return images, then every images_N by its factor."""
    names = [p.name for p in root.iterdir() if p.is_dir() and p.name.removeprefix("images_").isdigit()]
    names.sort(key=lambda name: int(name.removeprefix("images_")))
    return (["images"] if (root / "images").is_dir() else []) + names


def _write_photos(
    scene: Scene, plan: _PastePlan, config: CompositeConfig, folder: Path, progress: Progress
) -> dict[str, Facts]:
    """Write the photos of all sizes, and the truth at the size of training."""
    kinds = [(f, _pictures(scene, f)) for f in _folders(scene.root)]
    placements = dict(zip((v.name for v in scene.train), plan.placements, strict=True))
    photos: dict[str, Facts] = {}
    for _, pictures in kinds:
        for view in scene.test:
            _copy(pictures[view.name], scene.root, folder)
    with ThreadPoolExecutor(2) as writers:
        for view in progress(scene.train):
            sizes = [image_size(pictures[view.name]) for _, pictures in kinds]
            full = view.camera.resized(*max(sizes))
            over = draw_layer(plan.cutouts, list(plan.heights), placements[view.name], full, config.shadow)
            jobs = []
            for (_, pictures), (width, height) in zip(kinds, sizes, strict=True):
                path = pictures[view.name]
                photo = read_png_rgb(path)
                changed = blend_layer(photo, resized(over, width, height))
                # Changed photos become PNG, to avoid a second JPEG compression.
                out = (folder / path.relative_to(scene.root)).with_suffix(".png")
                jobs.append(writers.submit(write_png, out, changed))
                if path == view.image_path:
                    mask = layer_mask(resized(over, width, height))
                    own = Path(view.name).with_suffix(".png")
                    for part, pixels in (("clean", photo), ("distractor", mask)):
                        jobs.append(writers.submit(write_png, folder / "truth" / part / own, pixels))
                    placed = [
                        {"cutout": plan.cutouts[p.which].name, **asdict(p)} for p in placements[view.name]
                    ]
                    occlusion = round(float((mask > 0).mean()), 6)
                    photos[view.name] = {"occlusion": occlusion, "distractors": placed}
            for job in jobs:
                job.result()
    return photos


def _pictures(scene: Scene, folder: str) -> dict[str, Path]:
    factor = 1 if folder == "images" else int(folder.removeprefix("images_"))
    views = load_scene(scene.root, factor=factor, verify=False, check=False).views
    return {view.name: view.image_path for view in views}


def _copy(path: Path, root: Path, folder: Path) -> None:
    target = folder / path.relative_to(root)
    target.parent.mkdir(parents=True, exist_ok=True)
    shutil.copyfile(path, target)


def _copy_rest(scene: Scene, folder: Path) -> None:
    """Copy the model and the user's keep masks; write the lists."""
    for part in ("sparse", "colmap/sparse", "masks"):
        for path in sorted(p for p in (scene.root / part).rglob("*") if p.is_file()):
            _copy(path, scene.root, folder)
    if (scene.root / "nb-info.json").is_file():
        _copy(scene.root / "nb-info.json", scene.root, folder)
    for side, views in (("train", scene.train), ("test", scene.test)):
        text = "".join(f"{v.name}\n" for v in views)
        (folder / f"{side}_list.txt").write_text(text, encoding="utf-8", errors="surrogateescape")


def _facts(scene: Scene, plan: _PastePlan, config: CompositeConfig, photos: dict[str, Facts]) -> Facts:
    shares = [cast(float, photo["occlusion"]) for photo in photos.values()]
    record = scene.root / "scene.json"
    return {
        "schema": 1,
        "version": __version__,
        "source": {"name": scene.name, "scene_json": sha256_file(record) if record.is_file() else None},
        "config": to_plain(config),
        "mask": "255 where a cut-out or its shadow covers at least a quarter of the pixel",
        "poses": "structure from motion of the photos before anything was put in",
        "cutouts": [
            {"name": c.name, "sha256": c.source, "height": float(h)}
            for c, h in zip(plan.cutouts, plan.heights, strict=True)
        ],
        "occlusion": summary(shares),
        "photos": photos,
    }


def _write_scene_json(scene: Scene, folder: Path, name: str, facts: Facts, patches: bool) -> None:
    """Write the source's scene.json without the keys by which 'aw build-scene' recognises its own scenes."""
    before: SceneInfo = read_scene_json(scene.root) or {"license": "not stated"}
    license_ = before.get("license", "not stated")
    kept = {k: v for k, v in before.items() if k not in ("build_key", "inputs", "seconds", "files")}
    factor = scene.info["loaded_factor"]
    content: dict[str, object] = {
        **kept,
        "schema": "ambiguous_wild.scene",
        "schema_version": SCENE_SCHEMA,
        "name": name,
        "factor": factor,
        "images": "images" if factor == 1 else f"images_{factor}",
        "license": license_ if patches else f"{license_}; cut-outs: not stated",
        "truth": {"distractor": len(scene.train), "clean": len(scene.train)},
        "composite": {k: facts[k] for k in ("source", "config", "cutouts", "occlusion", "poses")},
    }
    paths = sorted(p for p in folder.rglob("*") if p.is_file())
    content["files"] = {
        p.relative_to(folder).as_posix(): {"sha256": sha256_file(p), "bytes": p.stat().st_size} for p in paths
    }
    write_json(folder / "scene.json", content)
