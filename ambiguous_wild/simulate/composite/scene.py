"""A scene of real photographs with distractors in its train photos: a whole scene folder, with the truth.

SCENE2/images* sparse masks lists     as in the scene it is made from; train photos changed, test photos not
SCENE2/truth/distractor/<stem>.png    255 where a cut-out or its shadow covers a quarter of the pixel or more
SCENE2/truth/clean/<stem>.png         the train photo as it was
SCENE2/truth/composite.json           config, cut-outs with sha256, who is where, coverage per photo
"""

from __future__ import annotations

import shutil
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ambiguous_wild import __version__
from ambiguous_wild.core.config import to_plain
from ambiguous_wild.core.errors import AwError, shortlist
from ambiguous_wild.core.names import check_name
from ambiguous_wild.core.scene import Scene, View
from ambiguous_wild.io.atomic import atomic_dir, write_json
from ambiguous_wild.io.hashing import sha256_file
from ambiguous_wild.io.images import image_size, read_gray, read_png_rgb, write_png
from ambiguous_wild.io.scene_folder import SCENE_SCHEMA, load_scene, read_scene_json
from ambiguous_wild.simulate.composite.cutouts import Cutout, blobs, read_cutouts
from ambiguous_wild.simulate.composite.layers import Stand, composed, layer, resized, truth
from ambiguous_wild.simulate.composite.patches import cut_patches
from ambiguous_wild.simulate.composite.placing import (
    CompositeConfig,
    local_colours,
    natural_heights,
    place,
    scene_spread,
    sites,
    solve_heights,
)

Progress = Callable[[Sequence[View]], Iterable[View]]


@dataclass(frozen=True)
class _Plan:
    cutouts: list[Cutout]
    heights: np.ndarray  # [K] scene units
    stands: list[tuple[Stand, ...]]  # of every train photo


def composite(
    source: Path | str,
    output: Path | str,
    config: CompositeConfig,
    cutouts: Path | str | None = None,
    progress: Progress = iter,
) -> dict[str, Any]:
    """Make the scene; returns what ``truth/composite.json`` says.

    Poses and points stay those of the clean photos: what a method gets is that much better than a
    capture with people in it would give.

    Args:
        source: a scene folder, with `scene.json` or a plain COLMAP scene.
        output: the folder to write; whole or not at all.
        config: what to put where.
        cutouts: folder of PNG files with alpha; with ``config.patches`` it may be left out.
        progress: wraps the train views, for a bar.

    Raises:
        AwError: a bad scene, bad cut-outs, a coverage out of reach, or an output that is taken.
    """
    config.check()
    root, target = Path(source), Path(output)
    name = check_name("scene name (the folder's)", target.resolve().name)
    _check_output(root, target)
    if cutouts is None and not config.patches:
        raise AwError("say what to put in: --cutouts FOLDER of PNG files with alpha, or --patches")
    drawn, stood, patched = (np.random.default_rng(s) for s in np.random.SeedSequence(config.seed).spawn(3))
    shapes = blobs(drawn) if cutouts is None else read_cutouts(cutouts)
    scene = load_scene(root)
    _check_scene(scene)
    plan = _plan(scene, shapes, config, stood, patched)
    with atomic_dir(target) as folder:
        photos = _write_photos(scene, plan, config, folder, progress)
        _copy_rest(scene, folder)
        facts = _facts(scene, plan, config, photos)
        write_json(folder / "truth" / "composite.json", facts)
        _write_scene_json(scene, folder, name, facts)
    return facts


def _check_output(root: Path, target: Path) -> None:
    if target.resolve().is_relative_to(root.resolve()) or root.resolve().is_relative_to(target.resolve()):
        raise AwError(f"{target} and the scene {root} lie in one another; choose another folder for -o")
    if target.exists() and (not target.is_dir() or any(target.iterdir())):
        raise AwError(f"{target} exists; remove it or choose another folder for -o")


def _check_scene(scene: Scene) -> None:
    """Raise AwError where the scene's truth, names or pictures could not be carried over."""
    stems = [Path(v.name).stem for v in scene.views]
    twice = sorted({s for s in stems if stems.count(s) > 1})
    if twice:
        raise AwError(f"{scene.root}: photos of one name in two folders: {shortlist(twice)}; rename them")
    for view in scene.train:
        mask = scene.root / "truth" / "distractor" / f"{Path(view.name).stem}.png"
        if mask.is_file() and read_gray(mask).any():
            raise AwError(
                f"{scene.root} has distractors already ({mask.name} is not empty); choose a scene without any"
            )


def _plan(
    scene: Scene,
    shapes: list[Cutout],
    config: CompositeConfig,
    stood: np.random.Generator,
    patched: np.random.Generator,
) -> _Plan:
    places = sites(scene)
    if config.patches:
        largest = _folders(scene.root)[0]  # images, or the smallest factor there is
        things, colours, origins = cut_patches(shapes, places, _pictures(scene, largest), config, patched)
        around = [local_colours(read_png_rgb(s.view.image_path)) for s in places]
        chosen = {"colours": colours, "backgrounds": around, "origins": origins}
    else:
        things, chosen = shapes, {}
    natural = natural_heights(things, stood)
    stands = place(places, scene_spread(scene), config, stood, len(things), **chosen)  # type: ignore[arg-type]
    heights = solve_heights(things, natural, places, stands, config)
    return _Plan(things, heights, stands)


def _folders(root: Path) -> list[str]:
    """images, then every images_N by its factor."""
    found = [p.name for p in root.iterdir() if p.is_dir() and p.name.removeprefix("images_").isdigit()]
    found.sort(key=lambda name: int(name.removeprefix("images_")))
    return (["images"] if (root / "images").is_dir() else []) + found


def _write_photos(
    scene: Scene, plan: _Plan, config: CompositeConfig, folder: Path, progress: Progress
) -> dict[str, Any]:
    """All pictures of all sizes, and the truth at the size that is trained on."""
    kinds = [(f, _pictures(scene, f)) for f in _folders(scene.root)]
    stands = dict(zip((v.name for v in scene.train), plan.stands, strict=True))
    photos: dict[str, Any] = {}
    for _, pictures in kinds:
        for view in scene.test:
            _copy(pictures[view.name], scene.root, folder)
    with ThreadPoolExecutor(2) as writers:
        for view in progress(scene.train):
            sizes = [image_size(pictures[view.name]) for _, pictures in kinds]
            full = view.camera.resized(*max(sizes))
            over = layer(plan.cutouts, list(plan.heights), stands[view.name], full, config.shadow)
            jobs = []
            for (_, pictures), (width, height) in zip(kinds, sizes, strict=True):
                path = pictures[view.name]
                photo = read_png_rgb(path)
                changed = composed(photo, resized(over, width, height))
                # Changed photos are PNG, whatever they were: what is measured is not compressed twice.
                out = (folder / path.relative_to(scene.root)).with_suffix(".png")
                jobs.append(writers.submit(write_png, out, changed))
                if path == view.image_path:
                    mask = truth(resized(over, width, height))
                    stem = Path(view.name).stem
                    jobs.append(writers.submit(write_png, folder / "truth" / "clean" / f"{stem}.png", photo))
                    jobs.append(
                        writers.submit(write_png, folder / "truth" / "distractor" / f"{stem}.png", mask)
                    )
                    photos[view.name] = _photo_facts(plan, stands[view.name], mask)
            for job in jobs:
                job.result()
    return photos


def _pictures(scene: Scene, folder: str) -> dict[str, Path]:
    factor = 1 if folder == "images" else int(folder.removeprefix("images_"))
    return {v.name: v.image_path for v in load_scene(scene.root, factor=factor, verify=False).views}


def _photo_facts(plan: _Plan, stands: tuple[Stand, ...], mask: np.ndarray) -> dict[str, Any]:
    standing = [{"cutout": plan.cutouts[s.which].name, **asdict(s)} for s in stands]
    return {"occlusion": round(float((mask > 0).mean()), 6), "distractors": standing}


def _copy(path: Path, root: Path, folder: Path) -> None:
    target = folder / path.relative_to(root)
    target.parent.mkdir(parents=True, exist_ok=True)
    shutil.copyfile(path, target)


def _copy_rest(scene: Scene, folder: Path) -> None:
    """The model, the user's keep masks, the lists."""
    for part in ("sparse", "colmap/sparse", "masks"):
        for path in sorted(p for p in (scene.root / part).rglob("*") if p.is_file()):
            _copy(path, scene.root, folder)
    if (scene.root / "nb-info.json").is_file():
        _copy(scene.root / "nb-info.json", scene.root, folder)
    for side, views in (("train", scene.train), ("test", scene.test)):
        text = "".join(f"{v.name}\n" for v in views)
        (folder / f"{side}_list.txt").write_text(text, encoding="utf-8", errors="surrogateescape")


def _facts(scene: Scene, plan: _Plan, config: CompositeConfig, photos: dict[str, Any]) -> dict[str, Any]:
    shares = [p["occlusion"] for p in photos.values()]
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
        "occlusion": {"mean": float(np.mean(shares)), "min": min(shares), "max": max(shares)},
        "photos": photos,
    }


def _write_scene_json(scene: Scene, folder: Path, name: str, facts: dict[str, Any]) -> None:
    """The source's account, less what would let 'aw build-scene' take this for its own work."""
    before = read_scene_json(scene.root) or {"license": "not stated"}
    kept = {k: v for k, v in before.items() if k not in ("build_key", "inputs", "seconds", "files")}
    factor = scene.info["loaded_factor"]
    licence = f"{before.get('license', 'not stated')}; cut-outs: not stated"
    account = {
        **kept,
        "schema": "ambiguous_wild.scene",
        "schema_version": SCENE_SCHEMA,
        "name": name,
        "factor": factor,
        "images": "images" if factor == 1 else f"images_{factor}",
        "license": before.get("license", "not stated") if facts["config"]["patches"] else licence,
        "truth": {"distractor": len(scene.train), "clean": len(scene.train)},
        "composite": {k: facts[k] for k in ("source", "config", "cutouts", "occlusion", "poses")},
    }
    paths = sorted(p for p in folder.rglob("*") if p.is_file())
    account["files"] = {
        p.relative_to(folder).as_posix(): {"sha256": sha256_file(p), "bytes": p.stat().st_size} for p in paths
    }
    write_json(folder / "scene.json", account)
