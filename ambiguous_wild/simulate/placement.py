"""Place cut-outs at the scene's points, with one size in all photos."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import cv2
import numpy as np

from ambiguous_wild.core.camera import Camera
from ambiguous_wild.core.errors import AwError
from ambiguous_wild.core.scene import Scene, SparsePoints, View
from ambiguous_wild.io.images import read_png_rgb
from ambiguous_wild.simulate.cutouts import (
    TRUTH_COVER,
    Cutout,
    CutoutPlacement,
    cut_patch,
    draw_layer,
)
from ambiguous_wild.simulate.spec import FixedThing

_DRAWS = 24  # positions drawn for a cut-out, of which the best is taken
_NEARER = (0.90, 0.98)  # depth of the cut-out relative to that of the point behind it
_SAME_PLACE = 0.08  # distance relative to the scene's spread below which positions are the same place
_SAME_PLACE_SHARE = 0.15  # of the photos; a cut-out that stays longer would be part of the scene
_APART = 0.3  # distance of two cut-outs, if possible, relative to the photo's shorter side
PREVIEW_PX = 160
LONGEST = 1.2  # largest cut-out, relative to the photo's longer side


@dataclass(frozen=True)
class CompositeConfig:
    """Settings of a composite. The same scene, cut-outs and settings give the same bytes."""

    coverage: float = 0.15  # mean share of a train photo's pixels that distractors cover
    presence: float = 0.8  # share of the train photos that show each cut-out
    pose: Literal["standing", "lying"] = "standing"  # upright; or seen from above, at any angle
    shadow: float = 0.0  # 0 (none) to 1 (black)
    patches: bool = False  # fill the shapes with the scene's own texture
    path: bool = False  # pieces cross the picture from photo to photo; plain photos only
    fixed: FixedThing | None = None  # fixed to the camera, in all photos, test photos too; plain photos only
    seed: int = 0

    def check(self) -> None:
        """Raise AwError for a value out of its range."""
        for name, low, high in (("coverage", 0.005, 0.6), ("presence", 0.1, 1.0), ("shadow", 0.0, 1.0)):
            value = getattr(self, name)
            if not low <= value <= high:
                raise AwError(f"--{name} {value:g}: it lies between {low:g} and {high:g}")


@dataclass(frozen=True)
class VisiblePoints:
    """Scene points that one photo sees."""

    view: View
    xyz: np.ndarray  # [K, 3] float64, world
    uv: np.ndarray  # [K, 2] float64, px of the view's camera


def visible_points(scene: Scene) -> list[VisiblePoints]:
    """Return the points that each train photo sees, by tracks, or by projection if it has fewer than 10.

    Raises:
        AwError: the scene has no points, or a photo sees fewer than three.
    """
    if not len(scene.points):
        raise AwError(
            f"{scene.root} has no points, so the depth of a cut-out is unknown; build it with COLMAP"
        )
    owner = scene.points.owners
    sites = []
    for view in scene.train:
        index = scene.views.index(view)
        sites.append(_visible_points(view, scene.points, np.unique(owner[scene.points.track_views == index])))
    bare = [s.view.name for s in sites if len(s.xyz) < 3]
    if bare:
        raise AwError(f"{scene.root}: {len(bare)} train photos see fewer than 3 points, e.g. {bare[0]}")
    return sites


def _visible_points(view: View, points: SparsePoints, tracked: np.ndarray) -> VisiblePoints:
    xyz = points.xyz[tracked] if len(tracked) >= 10 else points.xyz
    camera = view.camera
    uv, _ = camera.project(xyz)
    inside = (uv > 0).all(1) & (uv < [camera.width, camera.height]).all(1)
    return VisiblePoints(view, xyz[inside], uv[inside])


def scene_spread(scene: Scene) -> float:
    """Return the median distance of the points from their median, scene units."""
    xyz = scene.points.xyz
    return float(np.median(np.linalg.norm(xyz - np.median(xyz, axis=0), axis=1)))


def place_cutouts(
    sites: Sequence[VisiblePoints],
    spread: float,
    config: CompositeConfig,
    rng: np.random.Generator,
    count: int,
    colours: Mapping[int, np.ndarray] | None = None,
    backgrounds: Sequence[np.ndarray] | None = None,
    origins: Mapping[int, np.ndarray] | None = None,
) -> list[tuple[CutoutPlacement, ...]]:
    """Place the cut-outs in every train photo.

    Args:
        sites: from `visible_points`, one per photo.
        spread: from `scene_spread`.
        config: presence and pose.
        rng: source of randomness.
        count: number of cut-outs.
        colours: index of a patch -> its colour, [3] CIELAB; it is placed where the photo is most similar.
        backgrounds: local mean colour of each photo, [h, w, 3] CIELAB, needed with `colours`.
        origins: index of a patch -> world position that it was cut from, where it is not put back.
    """
    chosen: list[tuple[CutoutPlacement, ...]] = []
    earlier: dict[int, list[np.ndarray]] = {k: [] for k in range(count)}
    limit = max(1, int(_SAME_PLACE_SHARE * len(sites)))
    near = _SAME_PLACE * spread
    for number, site in enumerate(sites):
        placements: list[CutoutPlacement] = []
        taken: list[np.ndarray] = []
        for which in range(count):
            if rng.random() > config.presence:
                continue
            best: tuple[float, int] | None = None
            for point in rng.integers(0, len(site.xyz), _DRAWS):
                xyz, uv = site.xyz[point], site.uv[point]
                often = sum(np.linalg.norm(xyz - p) < near for p in earlier[which]) >= limit
                if often or (origins and np.linalg.norm(xyz - origins[which]) < near):
                    continue
                side = min(site.view.camera.width, site.view.camera.height)
                crowded = any(np.linalg.norm(uv - t) < _APART * side for t in taken)
                cost = 1000.0 * crowded
                if colours is not None and backgrounds is not None:
                    cost += _colour_gap(colours[which], backgrounds[number], uv, site.view)
                if best is None or cost < best[0]:
                    best = cost, int(point)
                if cost == 0:
                    break
            if best is None:
                continue  # all drawn positions were used too often, so it is left out of this photo
            xyz, uv = site.xyz[best[1]], site.uv[best[1]]
            earlier[which].append(xyz)
            taken.append(uv)
            placements.append(_placement(which, site, xyz, config, rng))
        chosen.append(tuple(placements))
    return chosen


def _placement(
    which: int, site: VisiblePoints, xyz: np.ndarray, config: CompositeConfig, rng: np.random.Generator
) -> CutoutPlacement:
    center = site.view.camera.center
    x, y, z = (float(c) for c in center + rng.uniform(*_NEARER) * (xyz - center))
    standing = config.pose == "standing"
    turn = rng.normal(0, 2.5) if standing else rng.uniform(-180, 180)
    return CutoutPlacement(which, (x, y, z), float(turn), standing)


def _colour_gap(colour: np.ndarray, background: np.ndarray, uv: np.ndarray, view: View) -> float:
    h, w = background.shape[:2]
    row, column = int(uv[1] / view.camera.height * h), int(uv[0] / view.camera.width * w)
    return float(np.linalg.norm(colour - background[min(row, h - 1), min(column, w - 1)]))


def natural_heights(cutouts: Sequence[Cutout], rng: np.random.Generator) -> np.ndarray:
    """Draw heights [K] that give every cut-out about the same area, up to a fifth; in any unit."""
    return np.array([rng.uniform(0.8, 1.25) / np.sqrt(c.aspect * c.filled) for c in cutouts])


def solve_heights(
    cutouts: Sequence[Cutout],
    natural: np.ndarray,
    sites: Sequence[VisiblePoints],
    placements: Sequence[tuple[CutoutPlacement, ...]],
    config: CompositeConfig,
) -> np.ndarray:
    """Find heights in scene units that give the configured mean coverage, by bisection over previews.

    Raises:
        AwError: even the largest size covers less.
    """
    small = [c.reduced(PREVIEW_PX) for c in cutouts]
    cameras = [_preview(s.view) for s in sites]
    natural = natural / natural.max()

    def share(scale: float) -> float:
        shares = [
            covered_share(small, natural * scale, s, c) for s, c in zip(placements, cameras, strict=True)
        ]
        return float(np.mean(shares))

    depths = [
        c.to_camera(np.array(s.position))[2]
        for group, c in zip(placements, cameras, strict=True)
        for s in group
    ]
    if not depths:
        raise AwError("no photo shows a cut-out; raise --presence")
    focal = float(np.median([c.fy for c in cameras]))
    high = LONGEST * PREVIEW_PX * float(np.median(depths)) / focal / longest_side(natural, cutouts)
    if share(high) < config.coverage:
        raise AwError(
            f"--coverage {config.coverage:g} is more than {len(cutouts)} cut-outs can cover "
            f"({share(high):.2f} at their largest); lower it, raise --presence or add cut-outs"
        )
    return natural * bisect_scale(share, high, config.coverage)


def longest_side(heights: np.ndarray, cutouts: Sequence[Cutout]) -> float:
    """Return the longest side of the cut-outs at these heights [K]."""
    return float(max(h * max(1.0, c.aspect) for h, c in zip(heights, cutouts, strict=True)))


def bisect_scale(share: Callable[[float], float], high: float, wanted: float) -> float:
    """Return the scale up to `high` at which `share`, which grows with it, is the wanted one."""
    low = 0.0
    for _ in range(14):
        middle = (low + high) / 2
        low, high = (middle, high) if share(middle) < wanted else (low, middle)
    return (low + high) / 2


def _preview(view: View) -> Camera:
    camera = view.camera
    scale = PREVIEW_PX / max(camera.width, camera.height)
    return camera.resized(max(1, round(camera.width * scale)), max(1, round(camera.height * scale)))


def covered_share(
    cutouts: Sequence[Cutout], heights: np.ndarray, placements: Sequence[CutoutPlacement], camera: Camera
) -> float:
    """Return the share of a photo's pixels that cut-outs of these heights mark as distractor."""
    over = draw_layer(cutouts, list(heights), placements, camera)
    return float((over[..., 3] >= TRUTH_COVER).mean())


def local_colours(photo: np.ndarray) -> np.ndarray:
    """Return the local mean colour of a photo, [h, w, 3] CIELAB, 64 px wide.

    Args:
        photo: [H, W, 3] uint8, sRGB.
    """
    h, w = photo.shape[:2]
    small = cv2.resize(photo, (64, max(1, round(64 * h / w))), interpolation=cv2.INTER_AREA)
    lab = cv2.cvtColor(small.astype(np.float32) / 255, cv2.COLOR_RGB2LAB)
    return cv2.blur(lab, (9, 9))


def cut_patches(
    shapes: Sequence[Cutout],
    sites: Sequence[VisiblePoints],
    pictures: Mapping[str, Path],
    config: CompositeConfig,
    rng: np.random.Generator,
) -> tuple[list[Cutout], dict[int, np.ndarray], dict[int, np.ndarray]]:
    """Fill every shape from a window of a train photo, about as large as the shape will appear.

    Args:
        shapes: cut-outs; only their alpha is used.
        sites: from `visible_points`; windows are cut from their photos.
        pictures: view name -> its largest image file.
        config: coverage and presence, which give the size.
        rng: source of randomness.

    Returns:
        The patches; index -> mean CIELAB colour [3]; index -> world position [3] of the window.
    """
    patches, colours, origins = [], {}, {}
    for k, shape in enumerate(shapes):
        site = sites[int(rng.integers(len(sites)))]
        photo = read_png_rgb(pictures[site.view.name])
        rows, columns = photo.shape[:2]
        area = config.coverage * rows * columns / (len(shapes) * config.presence)
        patch, window = cut_patch(shape, photo, area, rng)
        patches.append(patch)
        cut = photo[window].astype(np.float32) / 255
        colours[k] = cv2.cvtColor(cut, cv2.COLOR_RGB2LAB).reshape(-1, 3).mean(0)
        camera = site.view.camera
        scale = np.array([camera.width / columns, camera.height / rows])
        middle = np.array([w.start + (w.stop - w.start) / 2 for w in window[::-1]]) * scale
        origins[k] = site.xyz[np.linalg.norm(site.uv - middle, axis=1).argmin()]
    return patches, colours, origins
