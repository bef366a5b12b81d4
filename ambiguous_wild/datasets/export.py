"""`aw export-scene`: write a scene in the layout of another tool."""

from __future__ import annotations

import shutil
from collections import Counter
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path, PurePosixPath
from typing import Any, Literal

import numpy as np

from ambiguous_wild.builder.scene_package import nerfbaselines_info
from ambiguous_wild.core import Scene, View
from ambiguous_wild.core.errors import AwError, unknown
from ambiguous_wild.datasets.imported_photos import link_file
from ambiguous_wild.io import motion_points
from ambiguous_wild.io.colmap_model import read_model, write_model
from ambiguous_wild.io.colmap_records import ColmapModel, ModelCamera
from ambiguous_wild.io.files import atomic_dir, check_output, write_json
from ambiguous_wild.io.images import image_size, read_mask, write_png
from ambiguous_wild.io.ply import write_point_ply
from ambiguous_wild.io.scene_folder import load_scene, model_folder, without_suffix

Form = Literal["nerfstudio", "nerfbaselines", "colmap", "on-the-go"]
_OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])


@dataclass(frozen=True)
class ExportedScene:
    """Folder, numbers of photos, and what was left out."""

    folder: Path
    photos: int
    train: int
    test: int
    left_out: tuple[str, ...]  # parts of the scene that the layout cannot hold


def export_scene(
    path: Path, form: str, output: Path, *, copy: bool = False, masks: Mapping[str, Path] | None = None
) -> ExportedScene:
    """Write a scene in another layout, at the size that it is trained at (On-the-go: full size).

    Args:
        path: a scene folder.
        form: "nerfstudio", "nerfbaselines", "colmap" or "on-the-go".
        output: the folder to make; it must not exist, or be empty.
        copy: copy photos instead of linking them, for a folder that is to be moved.
        masks: keep masks of train photos by name, at their size in training, in place of the scene's.

    Raises:
        AwError: no scene, an unknown layout, masks for one that holds none, or an output that exists.
    """
    if form not in WRITERS:
        raise unknown("layout", form, WRITERS)
    scene = load_scene(path, raw=True)
    if masks is not None:
        if form == "on-the-go":
            raise AwError(f"{form} holds no masks: leave them out, or choose another layout")
        views = tuple(replace(v, keep_path=masks.get(v.name, v.keep_path)) for v in scene.views)
        scene = replace(scene, views=views)
        _check_sizes(scene.train)
    check_output(output, outside={f"the scene {path}": scene.root}, new=True)
    with atomic_dir(output, replace=False) as folder:
        put = _copy if copy else link_file
        left_out = [*WRITERS[form](scene, folder, put)]
    if (scene.root / motion_points.FILE).is_file():
        left_out.append("features that move (motion.npz)")
    return ExportedScene(output, len(scene.views), len(scene.train), len(scene.test), tuple(left_out))


def _check_sizes(views: Iterable[View]) -> None:
    for view in views:
        size = (view.camera.width, view.camera.height)
        if view.keep_path is not None and image_size(view.keep_path) != size:
            raise AwError(
                f"the mask {view.keep_path} is not of its photo's size, {size[0]}x{size[1]}: the run was "
                "trained with another --factor than the scene was built for; train one with the scene's"
            )


CopyOrLink = Callable[[Path, Path], None]


def _copy(source: Path, target: Path) -> None:
    target.parent.mkdir(parents=True, exist_ok=True)
    shutil.copyfile(source, target)


def _stored(view: View) -> str:
    """Return the photo's name with the extension of the file that is trained on."""
    return without_suffix(view.name) + view.image_path.suffix


def _sized_model(scene: Scene) -> ColmapModel:
    """Return the model of the listed photos at the size of the loaded files, with equal cameras merged."""
    model = read_model(model_folder(scene.root, scene.info.get("files", {})))
    by_name = {view.name: view for view in scene.views}
    cameras: dict[tuple[Any, ...], ModelCamera] = {}
    images = {}
    for number, image in model.images.items():
        view = by_name.get(image.name)
        if view is None:
            continue
        c, full = view.camera, model.cameras[image.camera_id]
        params = (c.fx, c.fy, c.cx, c.cy)
        key = (c.width, c.height, *params)
        if key not in cameras:
            cameras[key] = ModelCamera(len(cameras) + 1, "PINHOLE", c.width, c.height, params)
        scale = np.array([c.width / full.width, c.height / full.height])
        images[number] = replace(
            image, camera_id=cameras[key].camera_id, name=_stored(view), xys=image.xys * scale
        )
    return ColmapModel({c.camera_id: c for c in cameras.values()}, images, model.points.seen_in(images))


def _write_lists(scene: Scene, folder: Path) -> None:
    for side, views in (("train", scene.train), ("test", scene.test)):
        text = "".join(f"{_stored(view)}\n" for view in views)
        (folder / f"{side}_list.txt").write_text(text, encoding="utf-8")


def _colmap(scene: Scene, folder: Path, put: CopyOrLink, masks: bool = True) -> list[str]:
    """Write images/, sparse/0, lists that some readers know, and keep masks under COLMAP's names."""
    for view in scene.views:
        put(view.image_path, folder / "images" / _stored(view))
    write_model(folder / "sparse" / "0", _sized_model(scene))
    _write_lists(scene, folder)
    for view in scene.views if masks else ():
        if view.keep_path is not None:
            _write_mask(view, folder / "masks" / f"{_stored(view)}.png")
    return []


def _nerfbaselines(scene: Scene, folder: Path, put: CopyOrLink) -> list[str]:
    """Write the COLMAP layout with nb-info.json and with keep masks where NerfBaselines looks for them.

    Its scores blacken what a test photo's mask hides, in the photo and in the render.
    """
    _colmap(scene, folder, put, masks=False)
    if any(view.keep_path for view in scene.views):  # NerfBaselines needs a mask for every photo, or none
        for view in scene.views:
            _write_mask(view, folder / "masks" / f"{without_suffix(view.name)}.png")
    write_json(folder / "nb-info.json", nerfbaselines_info(1, scene.name, half=_half(scene)))
    return []


def _half(scene: Scene) -> bool:
    evaluation = scene.info.get("evaluation")
    return isinstance(evaluation, dict) and evaluation.get("protocol") == "half"


def _nerfstudio(scene: Scene, folder: Path, put: CopyOrLink) -> list[str]:
    """Write transforms.json with lists, points and masks, for `--data FOLDER nerfstudio-data`."""
    frames = []
    masked = any(view.keep_path for view in scene.views)
    for view in scene.views:
        name = f"images/{_stored(view)}"
        put(view.image_path, folder / name)
        frame = {"file_path": name, **_intrinsics(view), "transform_matrix": _camera_to_world(view)}
        if masked:  # nerfstudio needs a mask for every photo, or none
            mask = f"masks/{without_suffix(view.name)}.png"
            _write_mask(view, folder / mask)
            frame["mask_path"] = mask
        frames.append(frame)
    write_point_ply(folder / "sparse_pc.ply", scene.points.xyz, scene.points.rgb)
    data = {
        "camera_model": "OPENCV",
        "ply_file_path": "sparse_pc.ply",
        "frames": frames,
        "train_filenames": [f"images/{_stored(v)}" for v in scene.train],
        "val_filenames": [f"images/{_stored(v)}" for v in scene.test],
        "test_filenames": [f"images/{_stored(v)}" for v in scene.test],
    }
    write_json(folder / "transforms.json", data)
    return [*_protocol_lost(scene), "tracks of the points"]


def _on_the_go(scene: Scene, folder: Path, put: CopyOrLink) -> list[str]:
    """Write images/, transforms.json, and split.json with positions among the names sorted by base name.

    Readers of this layout reduce photos themselves, so they are written at full size if the scene has them.
    """
    bases = Counter(PurePosixPath(v.name).stem for v in scene.views)

    def flat(view: View) -> str:
        """Return the base name, with its folders if another photo has the same."""
        name = PurePosixPath(_stored(view))
        return name.name if bases[name.stem] == 1 else "_".join(name.parts)

    factor = int(scene.info["loaded_factor"])
    if factor > 1 and (scene.root / "images").is_dir():
        for view in scene.views:
            put(view.image_path, folder / f"images_{factor}" / flat(view))
        scene = load_scene(scene.root, factor=1, verify=False, raw=True, check=False)
    if len({flat(v) for v in scene.views}) < len(scene.views):
        raise AwError(f"{scene.root}: two photos have one name, which On-the-go's layout cannot tell apart")
    views = sorted(scene.views, key=flat)
    lenses = {
        (v.camera.width, v.camera.height, v.camera.fx, v.camera.fy, v.camera.cx, v.camera.cy) for v in views
    }
    frames = []
    for view in views:
        name = f"images/{flat(view)}"
        put(view.image_path, folder / name)
        own = {} if len(lenses) == 1 else _intrinsics(view)
        frames.append({"file_path": name, **own, "transform_matrix": _camera_to_world(view)})
    shared = _intrinsics(views[0]) if len(lenses) == 1 else {}
    write_json(folder / "transforms.json", {**shared, "frames": frames})
    sides = {"clutter": "train", "extra": "test"}
    split = {word: [i for i, v in enumerate(views) if v.split == side] for word, side in sides.items()}
    write_json(folder / "split.json", {**split, "clean": []})
    masks = ["keep masks"] if any(v.keep_path for v in scene.views) else []
    return [*_protocol_lost(scene), "points", *masks]


def _protocol_lost(scene: Scene) -> list[str]:
    return ["the half-photo protocol"] if _half(scene) else []


def _intrinsics(view: View) -> dict[str, object]:
    c = view.camera
    lens = dict.fromkeys(("k1", "k2", "p1", "p2"), 0.0)
    return {"w": c.width, "h": c.height, "fl_x": c.fx, "fl_y": c.fy, "cx": c.cx, "cy": c.cy, **lens}


def _camera_to_world(view: View) -> list[list[float]]:
    """Return the camera-to-world matrix [4, 4] with OpenGL axes."""
    return (np.linalg.inv(view.camera.cam_from_world) @ _OPENGL).tolist()


def _write_mask(view: View, target: Path) -> None:
    """Write the keep mask of a photo, white if it has none: all of the photo is used."""
    if view.keep_path is None:
        pixels = np.full((view.camera.height, view.camera.width), 255, np.uint8)
    else:
        pixels = read_mask(view.keep_path)
    write_png(target, pixels)


WRITERS: dict[str, Callable[[Scene, Path, CopyOrLink], list[str]]] = {
    "nerfstudio": _nerfstudio,
    "nerfbaselines": _nerfbaselines,
    "colmap": _colmap,
    "on-the-go": _on_the_go,
}
