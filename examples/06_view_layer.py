"""A layer per photo: Gaussians in front of each camera explain what only that photo shows.

    aw bench --method 3dgs --method examples/06_view_layer.py:view_layers --scene SCENE -o runs
    aw table runs

Each train photo has a small field of its own, drawn over the static one (the idea of DeSplat). Covering
pixels costs a little, so a layer keeps to what the static field cannot explain. Test views show the
static field alone.
"""

import numpy as np
import torch

from ambiguous_wild.splat.fields import STATIC, Fields, FieldStart, over
from ambiguous_wild.splat.gaussians import Gaussians
from ambiguous_wild.splat.method_hooks import MethodHooks
from ambiguous_wild.splat.rendered import Cotangents

SIDE, DEPTH, COVER = 24, 0.1, 0.1  # grid of Gaussians; distance from the camera; price of a covered pixel
RATES = {"means": 1e-4, "quats": 1e-3, "log_scales": 0.01, "opacity_logits": 0.1, "sh0": 0.02, "sh_rest": 0.0}


class ViewLayers(Fields):
    def setup(self, data, static, rates):
        """A grid of faint grey Gaussians that fills each photo."""
        starts = [FieldStart(self.grid(camera), lambda progress: RATES) for camera in data.cameras]
        return {str(view): start for view, start in enumerate(starts)}

    def grid(self, camera) -> Gaussians:
        at = (np.stack(np.meshgrid(*[np.arange(SIDE)] * 2), -1).reshape(-1, 2) + 0.5) / SIDE
        ray = (at * [camera.width, camera.height] - [camera.cx, camera.cy]) / [camera.fx, camera.fy]
        local = DEPTH * np.column_stack([ray, np.ones(len(ray))])
        pose = camera.cam_from_world
        world = (local - pose[:3, 3]) @ pose[:3, :3]
        grey = np.full((len(world), 3), 128, np.uint8)
        return Gaussians.from_points(world, grey, sh_degree=0, opacity=0.006)

    def drawn(self, context):
        return [str(context.view)]

    def compose(self, frames, context):
        frame, vjp = over(frames[str(context.view)], frames[STATIC])
        return frame, lambda cotangents: dict(zip([str(context.view), STATIC], vjp(cotangents)))

    def regularise(self, frames, context):
        alpha = frames[str(context.view)].alpha
        return {str(context.view): Cotangents(alpha=torch.full_like(alpha, COVER / alpha.numel()))}


def view_layers() -> MethodHooks:
    """The rest of the loop is that of 3DGS."""
    return MethodHooks(fields=ViewLayers())
