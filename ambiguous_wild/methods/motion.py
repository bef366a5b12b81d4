"""3DGS with masks of what moves, from geometry alone and from the first step on (elsewhere `--mask motion`).

No colour and no appearance is compared. A pixel is masked if more photos show that the features around it,
and in its segment, follow another rigid motion than the scene than show the opposite. It is kept if no photo
tells.
"""

from __future__ import annotations

import warnings
from dataclasses import dataclass

import cv2
import numpy as np
import torch

from ambiguous_wild.core import AwError
from ambiguous_wild.core.config import check_limits
from ambiguous_wild.io.motion_points import read_motion_points
from ambiguous_wild.io.palette import MASKED, faded, tint
from ambiguous_wild.methods.mask_policies import FixedMasks
from ambiguous_wild.splat.method_hooks import MethodHooks
from ambiguous_wild.splat.step import Step, TrainData
from ambiguous_wild.vision.backends import check_instances, make_instances
from ambiguous_wild.vision.motion_maps import MOVES, POINTS, draw_points, moving_labels, moving_map
from ambiguous_wild.vision.precompute import instance_labels
from ambiguous_wild.vision.sparse_surface import map_size


@dataclass(frozen=True)
class MotionConfig:
    """Options of `3dgs+motion`."""

    threshold: float = MOVES  # value of `moving_map` above which a pixel is masked
    instances: str = "graph"  # back end of segments, see docs/foundation-models.md

    def __post_init__(self) -> None:
        check_limits(self, "motion", threshold=(0.5, 1))
        check_instances(self.instances)


def build(options: MotionConfig) -> MethodHooks:
    """Return 3DGS with these masks."""
    return MethodHooks(mask=MotionMask(options))


class MotionMask(FixedMasks):
    """Masks what moves; the masks are the same in every step."""

    def __init__(self, config: MotionConfig) -> None:
        super().__init__([])
        self.config = config

    def setup(self, data: TrainData) -> None:
        self.data = data
        points = self.points = read_motion_points(data.scene.root)
        names = [view.name for view in data.scene.train]
        with_points = [name for name in names if name in points and points[name].informative]
        if not with_points:
            raise AwError(
                f"scene {data.scene.name} does not say what moves (motion.npz has none of its train photos): "
                "build it from its photos with this version of 'aw build-scene', or import the data set "
                "again with 'aw import ... --motion'"
            )
        if len(with_points) < len(names):
            warnings.warn(
                f"scene {data.scene.name}: nothing tells what moves in {len(names) - len(with_points)} of "
                f"{len(names)} train photos; they are not masked",
                stacklevel=2,
            )
        config, self.keeps = self.config, []
        instances = make_instances(config.instances)
        segments = instance_labels(instances, data.photos, names, data.cache_dir).labels
        for name, photo, labels, camera in zip(names, data.photos, segments, data.cameras, strict=True):
            moves = np.zeros(labels.shape, bool)
            if name in points:
                labels = moving_labels(instances, photo, labels, points[name], data.cache_dir)
                moves = moving_map(points[name], labels, map_size(camera)) > config.threshold
                moves = cv2.resize(moves.astype(np.uint8), labels.shape[::-1]) > 0
            self.keeps.append(torch.from_numpy((~moves).astype(np.float32)))
        super().setup(data)

    def panels(self, step: Step) -> dict[str, np.ndarray]:
        assert step.view is not None
        photo = (self.data.photos[step.view].cpu().numpy() * 255 + 0.5).astype(np.uint8)
        masked = self.keeps[step.view].cpu().numpy() < 0.5
        pictures = {f"masked {100 * masked.mean():.0f} %": tint(faded(photo), masked, MASKED)}
        points = self.points.get(self.data.scene.train[step.view].name)
        return pictures if points is None else {POINTS: draw_points(photo, points), **pictures}
