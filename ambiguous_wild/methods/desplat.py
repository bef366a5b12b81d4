"""DeSplat: every photo has a few Gaussians of its own in front of its camera; test views do not show them.

Source: DeSplat (CVPR 2025, arXiv 2411.19756) and its released code. Ours: the layer covers the photo's
frame (the released box spans 53 degrees), lies at 0.02 of the scene's extent, is drawn from iteration
`min_start` on, and keeps its number of Gaussians. Left out: growth of the layers, the background model and
the embeddings. The static Gaussians follow 3DGS.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import torch
from torch import Tensor

from ambiguous_wild.core import Camera
from ambiguous_wild.core.config import check_limits
from ambiguous_wild.splat.density import DensityConfig
from ambiguous_wild.splat.field import Rates
from ambiguous_wild.splat.fields import STATIC, ComposeVjp, Fields, FieldStart, frames_of, over
from ambiguous_wild.splat.gaussians import SH_C0, Gaussians
from ambiguous_wild.splat.method_hooks import MaskPolicy, MethodHooks
from ambiguous_wild.splat.rendered import Cotangents, Frame
from ambiguous_wild.splat.step import Step, TrainData, ViewContext

_NEAREST = 0.02  # least distance of a layer; the renderer draws nothing nearer than 0.01


@dataclass(frozen=True)
class DeSplatConfig:
    """Options of the layer in front of each camera."""

    density: DensityConfig = field(default_factory=DensityConfig)  # for the static Gaussians
    points: int = 1000  # Gaussians of each photo
    distance: float = 0.02  # from the camera, as a share of the scene's extent
    start_opacity: float = 0.1
    # iterations of the run before the layers are drawn: in a short run they take the brightness of all photos
    # before the static Gaussians have learnt it
    min_start: int = 300
    # times the released rates of the layers (1): short runs visit a photo rarely. Simulated courtyard, 30
    # photos, 1500 iterations: 25.8 dB at 4, 24.9 at 2 with alpha_own 0.1 (3dgs 23.1)
    speed: float = 4.0
    alpha_static: float = 0.01  # weight of mean(1 - A) of the static picture
    alpha_own: float = 0.01  # weight of mean(A) of the layer

    def __post_init__(self) -> None:
        check_limits(
            self,
            "desplat",
            points=(4, 1e7),
            distance=(1e-9, 1e9),
            start_opacity=(1e-4, 0.999),
            min_start=(0, 1e9),
        )


def build(options: DeSplatConfig) -> MethodHooks:
    """Return 3DGS with one field for each photo; its mask is what the layer leaves uncovered."""
    return MethodHooks(fields=ViewLayers(options), mask=ViewLayerMask(), density_config=options.density)


class ViewLayerMask(MaskPolicy):
    """1 - A of the photo's layer, for pictures and metrics: the loss uses the composite instead."""

    def composed_keep(self, step: Step) -> Tensor | None:
        return self.predict(step)

    def predict(self, step: Step) -> Tensor | None:
        layer = frames_of(step.rendered).get(str(step.view))
        return None if layer is None else 1.0 - layer.alpha


class ViewLayers(Fields):
    """One field for each train photo."""

    layers = True

    def __init__(self, config: DeSplatConfig) -> None:
        self.config = config

    def setup(self, data: TrainData, static: Gaussians, rates: Rates) -> Mapping[str, FieldStart]:
        def own(progress: float) -> dict[str, float]:
            rates_of_layer = {"quats": 0.01, "log_scales": 0.05, "opacity_logits": 0.05, "sh_rest": 0.0}
            # 0.025 is the rate of a colour, which is SH_C0 times its coefficient
            rates_of_layer |= {"means": rates(progress)["means"], "sh0": 0.025 / SH_C0}
            return {name: self.config.speed * rate for name, rate in rates_of_layer.items()}

        rng = np.random.default_rng([data.seed, 0xDE])
        depth = max(self.config.distance * data.scene.extent, _NEAREST)
        starts = [self._start(camera, depth, rng).to(data.device) for camera in data.cameras]
        return {str(view): FieldStart(start, own) for view, start in enumerate(starts)}

    def _start(self, camera: Camera, depth: float, rng: np.random.Generator) -> Gaussians:
        n = self.config.points
        u, v = rng.uniform(0, camera.width, n), rng.uniform(0, camera.height, n)
        rays = np.column_stack([(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, np.ones(n)])
        world = (rays * depth - camera.cam_from_world[:3, 3]) @ camera.cam_from_world[:3, :3]
        colours = rng.integers(0, 256, (n, 3)).astype(np.uint8)
        gaussians = Gaussians.from_points(world, colours, sh_degree=0, opacity=self.config.start_opacity)
        return replace(gaussians, quats=torch.from_numpy(rng.standard_normal((n, 4)).astype(np.float32)))

    def drawn(self, context: ViewContext) -> Sequence[str]:
        return (
            () if context.view is None or context.iteration < self.config.min_start else (str(context.view),)
        )

    def compose(self, frames: Mapping[str, Frame], context: ViewContext) -> tuple[Frame, ComposeVjp]:
        front = next(iter(self.drawn(context)), None)
        if front is None:
            return frames[STATIC], lambda given: {STATIC: given}
        frame, vjp = over(frames[front], frames[STATIC])
        return frame, lambda given: dict(zip((front, STATIC), vjp(given)))

    def regularise(self, frames: Mapping[str, Frame], context: ViewContext) -> Mapping[str, Cotangents]:
        weights = dict.fromkeys(frames, self.config.alpha_own) | {STATIC: -self.config.alpha_static}
        alphas = {name: frame.alpha for name, frame in frames.items()}
        return {k: Cotangents(alpha=torch.full_like(a, weights[k] / a.numel())) for k, a in alphas.items()}
