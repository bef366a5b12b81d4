"""`render_cpu`: from raw parameters to pictures and back, with the kernels of this package."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from ambiguous_wild.core import AwError, Camera
from ambiguous_wild.splat.cpu import bins, blend, project, reverse
from ambiguous_wild.splat.cpu.buffers import BufferPool
from ambiguous_wild.splat.cpu.compile import threads
from ambiguous_wild.splat.gaussians import Gaussians
from ambiguous_wild.splat.rendered import (
    NO_STATISTICS,
    Cotangents,
    Gradients,
    Shade,
    ShadeGradients,
    ShadeVjp,
    as_cotangents,
    check_needs,
    scatter_gradients,
    sum_effect_grads,
)

_pool = BufferPool()


def camera_vector(camera: Camera, blur: float = project.BLUR) -> np.ndarray:
    """Return pose, intrinsics, size, limits of x/z and y/z, blur and its square, [24] float64."""
    out = np.empty(24)
    out[:12] = camera.cam_from_world[:3].ravel()
    out[12:18] = camera.fx, camera.fy, camera.cx, camera.cy, camera.width, camera.height
    for k, (size, f, c) in enumerate(
        ((camera.width, camera.fx, camera.cx), (camera.height, camera.fy, camera.cy))
    ):
        margin = 0.3 * 0.5 * size / f
        out[18 + 2 * k] = -c / f - margin
        out[19 + 2 * k] = (size - c) / f + margin
    out[22:] = blur, blur * blur
    return out


@dataclass
class _Lists:
    """What the backward pass needs from the forward pass."""

    cam: np.ndarray
    centre: np.ndarray
    degree: int
    antialias: bool
    background: np.ndarray
    records: np.ndarray
    ids: np.ndarray
    counts: np.ndarray
    offsets: np.ndarray
    instances: np.ndarray
    starts: np.ndarray
    tile_order: np.ndarray
    tile_slots: np.ndarray
    tile_instances: np.ndarray
    kept: np.ndarray
    touched: np.ndarray
    shaded: _ShadedRender | None


@dataclass
class _ShadedRender:
    """State of a render whose colours came from a shading function."""

    rows: Tensor  # [M] int64, the shaded Gaussians
    slots: np.ndarray  # [M] slots of their records
    vjp: ShadeVjp


class RenderedCpu:
    """Pictures of one camera and the backward pass to the parameters; see `rendered.Rendered`."""

    def __init__(
        self, gaussians: Gaussians, camera: Camera, arrays: tuple[np.ndarray, ...], lists: _Lists
    ) -> None:
        self.image, self.alpha, self.depth, self.visible, self.radii = (torch.from_numpy(a) for a in arrays)
        self._gaussians = gaussians
        self._camera = camera
        self._lists = lists

    def backward(self, cotangents: Cotangents | Tensor, needs: frozenset[str] = NO_STATISTICS) -> Gradients:
        """Return the gradients of sum(cotangent * picture); may be called more than once.

        The Gaussians must still hold the values that were rendered.

        Raises:
            AwError: a cotangent and its picture differ in shape, or a statistic is unknown.
        """
        check_needs(needs)
        c = as_cotangents(cotangents)
        shape = (self._camera.height, self._camera.width, 3)
        image = torch.zeros(shape) if c.image is None else c.image
        sums = self._sums(
            _cotangent("d_image", image, shape),
            _optional("d_alpha", c.alpha, shape[:2]),
            _optional("d_depth", c.depth, shape[:2]),
            _optional("d_image_extra", c.extra, shape),
            True if "absolute" in needs else None,
            True if needs & {"squared", "count"} else None,
        )
        gradients = self._chain(sums, c.extra is not None, needs)
        gradients.effect_grads = sum_effect_grads(c.effect_grads, gradients.effect_grads)
        return gradients

    def _sums(
        self, d_image: Any, d_alpha: Any, d_depth: Any, d_extra: Any, absolute: Any, tally: Any
    ) -> np.ndarray:
        s = self._lists
        sums = _pool.take("sums", (int(s.starts[-1]) * blend.ROW,), slack=0.25)
        blend.backward(
            s.records, s.tile_slots, s.tile_instances, s.starts, s.tile_order, threads(),
            self._camera.width, self._camera.height, s.background, s.kept, s.touched,
            d_image, d_alpha, d_depth, d_extra, absolute, tally, sums,
        )  # fmt: skip
        return sums

    def _chain(self, sums: np.ndarray, extra: bool, needs: frozenset[str]) -> Gradients:
        s, g = self._lists, self._gaussians
        n = len(g)
        out = {name: _pool.take(f"d_{name}", tuple(t.shape)) for name, t in g.items() if name != "sh_rest"}
        rest, dirty = _pool.take_rows("d_sh_rest", tuple(g.sh_rest.shape))
        screen = _pool.take("screen", (n, 2))
        screen_extra = np.empty((n, 2), np.float32) if extra else None
        screen_abs = np.empty((n, 2), np.float32) if "absolute" in needs else None
        tally = np.empty((n, 2), np.float32) if needs & {"squared", "count"} else None
        through = None if s.shaded is None else self._through_shading(sums, s.shaded)
        reverse.reverse(
            *(_array(t) for t in (g.means, g.quats, g.log_scales, g.opacity_logits, g.sh_rest)),
            s.degree, s.cam, s.centre, s.antialias, s.records, s.ids, s.counts, s.offsets, s.instances, sums,
            out["means"], out["quats"], out["log_scales"], out["opacity_logits"], out["sh0"], rest,
            dirty, screen, screen_extra, screen_abs, tally, None if through is None else through[0],
        )  # fmt: skip
        gradients = Gradients(
            *(torch.from_numpy(values) for values in (*out.values(), rest)),
            screen=torch.from_numpy(screen),
            screen_extra=None if screen_extra is None else torch.from_numpy(screen_extra),
            screen_abs=None if screen_abs is None else torch.from_numpy(screen_abs),
            squared=torch.from_numpy(tally[:, 0]) if tally is not None and "squared" in needs else None,
            count=torch.from_numpy(tally[:, 1]) if tally is not None and "count" in needs else None,
            visible=self.visible,
        )
        return (
            gradients if through is None else scatter_gradients(gradients, through[1], self._shaded_rows, g)
        )

    @property
    def _shaded_rows(self) -> Tensor:
        assert self._lists.shaded is not None
        return self._lists.shaded.rows

    def _through_shading(self, sums: np.ndarray, shaded: _ShadedRender) -> tuple[np.ndarray, ShadeGradients]:
        """Return dL/d(SH colour) [slots, 3] of every record, and the gradients of the shading function."""
        s = self._lists
        colours = np.zeros((len(s.ids), 3), np.float32)
        reverse.colour_sums(s.records, s.ids, s.counts, s.offsets, s.instances, sums, colours)
        gradients = shaded.vjp(torch.from_numpy(colours[shaded.slots]))
        colours[shaded.slots] = _array(gradients.base)
        return colours, gradients


def _array(tensor: Tensor) -> np.ndarray:
    if tensor.dtype != torch.float32 or not tensor.is_contiguous():
        tensor = tensor.to(torch.float32).contiguous()
    return tensor.detach().numpy()


def _cotangent(name: str, value: Tensor, shape: tuple[int, ...]) -> np.ndarray:
    if tuple(value.shape) != shape:
        raise AwError(f"{name} must be {list(shape)} as the picture, got {list(value.shape)}")
    return _array(value)


def _optional(name: str, value: Tensor | None, shape: tuple[int, ...]) -> np.ndarray | None:
    return None if value is None else _cotangent(name, value, shape)


def render_cpu(
    gaussians: Gaussians,
    camera: Camera,
    *,
    sh_degree: int = 3,
    background: tuple[float, float, float] = (0.0, 0.0, 0.0),
    antialias: bool = False,
    blur: float = project.BLUR,
    shade: Shade | None = None,
) -> RenderedCpu:
    """Render on the CPU; arguments and conventions as in `splat.render.render`.

    After the projection the optimiser brings the harmonics of the visible rows up to date, see
    `Gaussians.pending_steps`.

    Raises:
        AwError: `sh_degree` is negative or above that of the Gaussians.
    """
    if not 0 <= sh_degree <= gaussians.sh_degree:
        raise AwError(
            f"sh_degree must be 0 to {gaussians.sh_degree}, which the Gaussians hold; got {sh_degree}"
        )
    n = len(gaussians)
    width, height = camera.width, camera.height
    cam = camera_vector(camera, blur)
    centre = camera.center
    means, quats, log_scales, logits, sh0, sh_rest = (_array(t) for _, t in gaussians.items())
    chunks = -(-n // project.CHUNK)
    records = _pool.take("records", (n, project.RECORD))
    ids = _pool.take("ids", (n,), np.int32)
    counts = np.zeros(chunks, np.int32)
    radii = _pool.take("radii", (n,))
    project.project(means, quats, log_scales, logits, cam, antialias, records, ids, counts, radii)
    slots = bins.visible_slots(ids, counts)
    if gaussians.pending_steps is not None:
        gaussians.pending_steps.make(ids[slots])
    base = None if shade is None else np.empty((n, 3), np.float32)
    project.colours(means, sh0, sh_rest, sh_degree, centre, records, ids, counts, radii, base)
    slots = bins.visible_slots(ids, counts)
    shaded = None if shade is None or base is None else _shade(shade, base, ids, slots, records)
    order = bins.depth_order(slots, records.view(np.uint32))

    columns, rows = -(-width // bins.TILE), -(-height // bins.TILE)
    instances = _pool.take("instances", (n,), np.int32)
    histogram = np.empty((bins.PARTS, columns * rows), np.int32)
    spans = _pool.take("spans", (len(order), bins.SPANS), np.int16, slack=0.25)
    bins.count_tiles(order, records, width, height, columns, instances, histogram, spans)
    offsets = _pool.take("offsets", (n,), np.int64)
    starts = np.empty(columns * rows + 1, np.int64)
    bins.prefix(slots, instances, offsets, histogram, starts)
    tile_slots = _pool.take("tile_slots", (int(starts[-1]),), np.int32, slack=0.25)
    tile_instances = _pool.take("tile_instances", (int(starts[-1]),), np.int32, slack=0.25)
    bins.scatter(order, records, width, columns, spans, offsets, histogram, tile_slots, tile_instances)

    tile_order = np.argsort(-np.diff(starts), kind="stable").astype(np.int32)
    image = _pool.take("image", (height, width, 3))
    alpha = _pool.take("alpha", (height, width))
    depth = _pool.take("depth", (height, width))
    kept = _pool.take("kept", (columns * rows, 2, blend.PIXELS))
    behind = np.asarray(background, np.float32)
    touched = _pool.take("touched", (int(starts[-1]),), np.uint16, slack=0.25)
    blend.forward(
        records, tile_slots, starts, tile_order, threads(), width, height, behind, image, alpha, depth, kept,
        touched,
    )  # fmt: skip
    lists = _Lists(
        cam, centre, sh_degree, antialias, behind, records, ids, counts, offsets, instances, starts,
        tile_order, tile_slots, tile_instances, kept, touched, shaded,
    )  # fmt: skip
    return RenderedCpu(gaussians, camera, (image, alpha, depth, radii > 0, radii), lists)


def _shade(
    shade: Shade, base: np.ndarray, ids: np.ndarray, slots: np.ndarray, records: np.ndarray
) -> _ShadedRender:
    """Put the function's colours into the records of the visible Gaussians."""
    rows = torch.from_numpy(ids[slots].astype(np.int64))
    colours, vjp = shade(torch.from_numpy(base[slots]), rows)
    if tuple(colours.shape) != (len(rows), 3):
        raise AwError(f"a shading function must give colours [{len(rows)}, 3], got {list(colours.shape)}")
    records[slots, project.RED : project.BLUE + 1] = _array(colours).clip(min=0.0)
    return _ShadedRender(rows, slots, vjp)
