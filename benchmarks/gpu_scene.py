"""A simulated scene for a machine without COLMAP: true poses, and points from the true depth.

    python benchmarks/gpu_scene.py SCENE [--preset courtyard-colour] [--train 150] [--test 20] [--width 582]

The default has as many pixels a photo as NeRF On-the-go at factor 8 (504x378), in the simulator's 16:9.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import shutil
import tempfile
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from ambiguous_wild.io.atomic import atomic_dir, write_text
from ambiguous_wild.io.colmap_binary import write_cameras, write_images, write_points
from ambiguous_wild.io.colmap_records import ModelCamera, ModelImage, ModelPoints
from ambiguous_wild.io.images import read_png_rgb, write_png
from ambiguous_wild.simulate.capture import simulate
from ambiguous_wild.simulate.presets import preset

SAMPLES = 2  # rays a pixel; it is the time of training that is measured
EVERY_PX_SMALL = 48  # of a scene to be carried
MOST_VIEWS = 12  # of a point in such a scene
EVERY_PX = 24  # a point for so many px along rows and columns of every train photo
SAME_DEPTH = 0.02  # relative: another photo shows a point whose depth there is its own


def make_scene(
    out: Path,
    *,
    name: str,
    train: int,
    test: int,
    width: int,
    seed: int = 0,
    to_train_on: bool = False,
    every: int | None = None,
) -> Path:
    """Write a scene folder with photos, model, lists and truth; returns it. An existing one is kept.

    Args:
        out: the folder.
        name: of the simulator's preset.
        train, test: number of photos.
        width: of a photo in px.
        seed: of the simulation.
        to_train_on: small, to be carried elsewhere: photos as the simulator's JPEG, no truth, fewer points.
        every: a point for so many px along rows and columns of every train photo; None = EVERY_PX.
    """
    if (out / "sparse" / "0" / "points3D.bin").is_file():
        return out
    spec = preset(name)
    height = round(spec.height * width / spec.width)
    size = {"width": width, "height": height, "samples": SAMPLES}
    spec = dataclasses.replace(spec, train_views=train, test_views=test, **size)
    with tempfile.TemporaryDirectory() as raw_name, atomic_dir(out) as folder:
        raw = Path(raw_name) / "raw"
        simulate(spec, raw, seed=seed, depth=True)
        cameras = json.loads((raw / "truth" / "cameras.json").read_text())
        for part in ("images", "sparse/0", *(() if to_train_on else ("truth/distractor", "truth/clean"))):
            (folder / part).mkdir(parents=True)
        lists: dict[str, list[str]] = {"train": [], "test": []}
        for split, found in lists.items():
            for photo in sorted((raw / split).iterdir()):
                png = photo.with_suffix(".png").name
                if to_train_on:
                    shutil.copyfile(photo, folder / "images" / photo.name)
                    found.append(photo.name)
                    continue
                pixels = cv2.imread(str(photo), cv2.IMREAD_COLOR)
                write_png(folder / "images" / png, np.ascontiguousarray(pixels[:, :, ::-1]))
                found.append(png)
        for kind in () if to_train_on else ("distractor", "clean"):
            for path in (raw / "truth" / kind).iterdir():
                (folder / "truth" / kind / path.name).write_bytes(path.read_bytes())
        for split, found in lists.items():
            write_text(folder / f"{split}_list.txt", "\n".join(found) + "\n")
        if every is None:
            every = EVERY_PX_SMALL if to_train_on else EVERY_PX
        _write_model(folder, raw, cameras, lists, every, MOST_VIEWS if to_train_on else None)
    return out


def _write_model(
    folder: Path,
    raw: Path,
    cameras: dict[str, Any],
    lists: dict[str, list[str]],
    every: int,
    most: int | None,
) -> None:
    """Every photo's pose; points on a grid of every train photo, with the train photos that show them."""
    order = sorted(cameras)
    first = cameras[order[0]]
    poses = {name: np.array(cameras[name]["cam_from_world"]) for name in order}
    stems = [Path(name).stem for name in order]
    names = {Path(name).stem: name for found in lists.values() for name in found}
    train = {Path(name).stem for name in lists["train"]}
    views = [k for k, stem in enumerate(stems) if stem in train]
    depths = {k: _depth_m(raw, stems[k]) for k in views}
    xyz, rgb = _points(raw, cameras, order, views, depths, every)
    observed: dict[int, tuple[np.ndarray, np.ndarray]] = {}
    for k in views:
        c = cameras[order[k]]
        local = xyz @ poses[order[k]][:3, :3].T + poses[order[k]][:3, 3]
        ahead = np.maximum(local[:, 2], 1e-6)
        uv = local[:, :2] / ahead[:, None] * [c["fx"], c["fy"]] + [c["cx"], c["cy"]]
        inside = (local[:, 2] > 0) & (uv >= 0).all(1) & (uv < [c["width"], c["height"]]).all(1)
        at = np.where(inside[:, None], uv, 0).astype(int)
        same = np.abs(depths[k][at[:, 1], at[:, 0]] - local[:, 2]) < SAME_DEPTH * local[:, 2]
        rows = np.flatnonzero(inside & same)
        observed[k] = rows, uv[rows]
    if most is not None:
        observed = thinned(observed, most)
    images = []
    for k, name in enumerate(order):
        rows, uv = observed.get(k, (np.zeros(0, np.int64), np.zeros((0, 2))))
        pose = poses[name]
        q = _quaternion(pose[:3, :3])
        images.append(ModelImage(k + 1, q, pose[:3, 3], 1, names[stems[k]], uv, rows.astype(np.int64) + 1))
    size = (first["width"], first["height"], tuple(first[key] for key in ("fx", "fy", "cx", "cy")))
    sparse = folder / "sparse" / "0"
    write_cameras(sparse / "cameras.bin", [ModelCamera(1, "PINHOLE", *size)])
    write_images(sparse / "images.bin", images)
    write_points(sparse / "points3D.bin", _tracked(xyz, rgb, observed))


def _points(
    raw: Path,
    cameras: dict[str, Any],
    order: list[str],
    views: list[int],
    depths: dict[int, np.ndarray],
    every: int,
) -> tuple[np.ndarray, np.ndarray]:
    """World points [M, 3] on a grid of every train photo, and their colours [M, 3] uint8."""
    xyz, rgb = [], []
    for k in views:
        c = cameras[order[k]]
        rows, columns = np.mgrid[every // 2 : c["height"] : every, every // 2 : c["width"] : every]
        z = depths[k][rows, columns]
        known = z > 0
        rows, columns, z = rows[known], columns[known], z[known]
        local = np.stack(
            [(columns + 0.5 - c["cx"]) / c["fx"] * z, (rows + 0.5 - c["cy"]) / c["fy"] * z, z], 1
        )
        world = np.linalg.inv(np.array(c["cam_from_world"]))
        xyz.append(local @ world[:3, :3].T + world[:3, 3])
        clean = read_png_rgb(raw / "truth" / "clean" / f"{Path(order[k]).stem}.png")
        rgb.append(clean[rows, columns])
    return np.concatenate(xyz), np.concatenate(rgb)


def thinned(
    observed: dict[int, tuple[np.ndarray, np.ndarray]], most: int
) -> dict[int, tuple[np.ndarray, np.ndarray]]:
    """At most so many views of each point, evenly among those that show it."""
    point = np.concatenate([rows for rows, _ in observed.values()])
    view = np.repeat(list(observed), [len(rows) for rows, _ in observed.values()])
    order = np.lexsort((view, point))
    counts = np.bincount(point)
    first = np.r_[0, np.cumsum(counts)[:-1]]
    rank = np.arange(len(point)) - first[point[order]]
    count = counts[point[order]]
    kept = np.zeros(len(point), bool)
    kept[order] = (count <= most) | (rank * most // count != (rank - 1) * most // count)
    found, at = {}, 0
    for k, (rows, uv) in observed.items():
        here = kept[at : at + len(rows)]
        found[k] = rows[here], uv[here]
        at += len(rows)
    return found


def _tracked(
    xyz: np.ndarray, rgb: np.ndarray, observed: dict[int, tuple[np.ndarray, np.ndarray]]
) -> ModelPoints:
    point = np.concatenate([rows for rows, _ in observed.values()])
    image = np.concatenate([np.full(len(rows), k + 1) for k, (rows, _) in observed.items()])
    number = np.concatenate([np.arange(len(rows)) for rows, _ in observed.values()])
    sort = np.argsort(point, kind="stable")
    offsets = np.r_[0, np.cumsum(np.bincount(point, minlength=len(xyz)))]
    ids = np.arange(1, len(xyz) + 1)
    return ModelPoints(ids, xyz, rgb, np.full(len(xyz), 0.5), offsets, image[sort], number[sort])


def _depth_m(raw: Path, stem: str) -> np.ndarray:
    """Depth [H, W] in m; 0 where it exceeds 16 bits of millimetres."""
    codes = cv2.imread(str(raw / "truth" / "depth" / f"{stem}.png"), cv2.IMREAD_UNCHANGED)
    return np.where(codes < 65535, codes, 0).astype(np.float64) / 1000.0


def _quaternion(rotation: np.ndarray) -> np.ndarray:
    """(w, x, y, z) of a rotation matrix, by the eigenvector of Bar-Itzhack's symmetric matrix."""
    r = rotation
    k = np.array(
        [
            [r[0, 0] - r[1, 1] - r[2, 2], 0, 0, 0],
            [r[0, 1] + r[1, 0], r[1, 1] - r[0, 0] - r[2, 2], 0, 0],
            [r[0, 2] + r[2, 0], r[1, 2] + r[2, 1], r[2, 2] - r[0, 0] - r[1, 1], 0],
            [r[2, 1] - r[1, 2], r[0, 2] - r[2, 0], r[1, 0] - r[0, 1], r.trace()],
        ]
    )
    x, y, z, w = np.linalg.eigh(k)[1][:, -1]
    return np.array([w, x, y, z]) * (1.0 if w >= 0 else -1.0)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("scene", type=Path)
    parser.add_argument("--preset", default="courtyard-colour")
    parser.add_argument("--train", type=int, default=150)
    parser.add_argument("--test", type=int, default=20)
    parser.add_argument("--width", type=int, default=582)
    parser.add_argument("--seed", type=int, default=0)
    a = parser.parse_args()
    print(make_scene(a.scene, name=a.preset, train=a.train, test=a.test, width=a.width, seed=a.seed))


if __name__ == "__main__":
    main()
