"""A tiny exact COLMAP model: points in front of cameras on a line, tracks by projection."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np

from ambiguous_wild.io.colmap_model import write_model
from ambiguous_wild.io.colmap_records import ColmapModel, ModelCamera, ModelImage, ModelPoints
from ambiguous_wild.io.images import write_png

WIDTH, HEIGHT, FX, FY = 64, 48, 60.0, 62.0


def tracked(
    cameras: dict[int, ModelCamera], lens: tuple[float, ...], poses: list, xyz: np.ndarray, first: int, rng
) -> ColmapModel:
    """A model whose observations are exact projections by `lens` (fx, fy, cx, cy).

    `poses`: (image id, qvec, tvec, camera id, name, rows of its points); point ids count from `first`.
    """
    images, tracks = {}, [[] for _ in xyz]
    for number, qvec, tvec, camera, name, seen in poses:
        image = ModelImage(number, qvec, tvec, camera, name, np.zeros((0, 2)), seen + first)
        pose = image.cam_from_world()
        local = xyz[seen] @ pose[:3, :3].T + tvec
        images[number] = replace(image, xys=local[:, :2] / local[:, 2:] * lens[:2] + lens[2:])
        for row, point in enumerate(seen):
            tracks[point].append((number, row))
    offsets = np.concatenate([[0], np.cumsum([len(t) for t in tracks])]).astype(np.int64)
    flat = np.array([pair for t in tracks for pair in t], np.int64).reshape(-1, 2)
    rgb = rng.integers(0, 256, xyz.shape, dtype=np.uint8)
    ids = np.arange(len(xyz), dtype=np.int64) + first
    points = ModelPoints(ids, xyz, rgb, rng.random(len(xyz)), offsets, flat[:, 0], flat[:, 1])
    return ColmapModel(cameras, images, points)


def make_model(names: list[str], points: int = 20, seed: int = 0, camera: str = "PINHOLE") -> ColmapModel:
    rng = np.random.default_rng(seed)
    xyz = np.column_stack([rng.uniform(*ends, points) for ends in ((-1, 1), (-0.5, 0.5), (4, 6))])
    params = {"PINHOLE": (FX, FY, 33.0, 23.0), "SIMPLE_RADIAL": (FX, 32.0, 24.0, -0.05)}[camera]
    identity, poses = np.array([1.0, 0, 0, 0]), []
    for k, name in enumerate(names):
        seen = np.flatnonzero(rng.random(points) < 0.8)
        poses.append((10 + k, identity, np.array([-0.1 * k, 0.02 * k, 0.0]), 7, name, seen))
    cameras = {7: ModelCamera(7, camera, WIDTH, HEIGHT, params)}
    return tracked(cameras, (FX, FY, 33.0, 23.0), poses, xyz, 100, rng)


def write_text(folder: Path, model: ColmapModel) -> None:
    folder.mkdir(parents=True)

    def line(*values) -> str:
        return " ".join(str(v) for value in values for v in np.atleast_1d(value)) + "\n"

    cameras = [line(c.camera_id, c.model, c.width, c.height, c.params) for c in model.cameras.values()]
    (folder / "cameras.txt").write_text("".join(cameras))
    rows = []
    for i in model.images.values():
        seen = [v for xy, point in zip(i.xys, i.point_ids) for v in (*xy, point)]
        rows += [line(i.image_id, i.qvec, i.tvec, i.camera_id, i.name), line(*seen)]
    (folder / "images.txt").write_text("".join(rows))
    p, rows = model.points, []
    for k in range(len(p.ids)):
        track = slice(p.track_offsets[k], p.track_offsets[k + 1])
        pairs = np.stack([p.track_image_ids[track], p.track_point2d[track]], axis=1).ravel()
        rows.append(line(p.ids[k], p.xyz[k], p.rgb[k], p.error_px[k], pairs))
    (folder / "points3D.txt").write_text("".join(rows))


def write_scene(root: Path, names: list[str], factor: int = 2, **kwargs) -> ColmapModel:
    """A plain COLMAP scene: images/, images_<factor>/, sparse/0; no lists, no scene.json."""
    model = make_model(names, **kwargs)
    write_model(root / "sparse" / "0", model)
    rng = np.random.default_rng(1)
    for name in names:
        photo = rng.integers(0, 256, (HEIGHT, WIDTH, 3), dtype=np.uint8)
        write_png(root / "images" / name, photo)
        small = cv2.resize(photo, (WIDTH // factor, HEIGHT // factor), interpolation=cv2.INTER_AREA)
        write_png(root / f"images_{factor}" / name, small)
    return model
