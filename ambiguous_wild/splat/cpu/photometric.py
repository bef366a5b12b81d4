"""Tensors in, tensors out, around the kernels of `ssim.py`."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from ambiguous_wild.splat.cpu import ssim
from ambiguous_wild.splat.cpu.buffers import Pool
from ambiguous_wild.splat.cpu.compile import threads

_pool = Pool()
_taps = ssim.window()


def _plain(tensor: Tensor) -> np.ndarray:
    return tensor.detach().to(torch.float32).contiguous().numpy()


def _packed(name: str, image: Tensor, keep: np.ndarray | None) -> np.ndarray:
    rows = _pool.take(name, (image.shape[0], ssim.stride(image.shape[1])))
    ssim.pack(_plain(image), keep, rows)
    return rows


def photometric_cpu(
    render: Tensor, photo: Tensor, keep: Tensor | None, lambda_dssim: float, weighting: str
) -> tuple[float, float, Tensor]:
    """L1, 1 - SSIM and the gradient of their mix; arguments as `losses.photometric`."""
    height, width = render.shape[:2]
    mask = None if keep is None else _plain(keep)
    inside = mask if weighting == "images" else None
    outside = None if weighting == "images" else mask
    x_rows = _packed("render", render, inside)
    y_rows = _packed("photo", photo, inside)
    maps = _pool.take("maps", (3, *x_rows.shape))
    totals = np.empty((height, 2), np.float64)
    out = np.empty((height, width, 3), np.float32)
    ssim.photometric(
        x_rows, y_rows, width, _taps, outside, inside, float(lambda_dssim), min(height, threads()), maps,
        None, totals, out,
    )  # fmt: skip
    # One serial sum over rows: the order, and so the bits, do not depend on the threads.
    l1, dssim = (totals.cumsum(axis=0)[-1] / (3 * height * width)).tolist()
    return l1, dssim, torch.from_numpy(out)


def ssim_map_cpu(a: Tensor, b: Tensor) -> Tensor:
    """SSIM of every pixel and channel, [H, W, 3]."""
    height, width = a.shape[:2]
    x_rows = _packed("render", a, None)
    y_rows = _packed("photo", b, None)
    maps = _pool.take("maps", (3, *x_rows.shape))
    out = np.empty(x_rows.shape, np.float32)
    totals = np.empty((height, 2), np.float64)
    parts = min(height, threads())
    ssim.photometric(x_rows, y_rows, width, _taps, None, None, 0.0, parts, maps, out, totals, None)
    return torch.from_numpy(out[:, : 3 * width].reshape(height, width, 3))
