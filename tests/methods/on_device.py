"""What the tests of masks share: numbers as tensors, and a small scene visited in turn.

The accelerator's path runs here on the CPU, with numbers; and on torch's `meta` device, where reading a
value, choosing rows by a mask and mixing devices all raise.
"""

from __future__ import annotations

import dataclasses
from types import SimpleNamespace

import cv2
import numpy as np
import torch

from ambiguous_wild.methods.refinesplat.hyperparameters import MaskConfig, RefineSplatConfig
from ambiguous_wild.splat import backend
from tests.methods.test_refinesplat_policy import (
    FAST,
    VIEWS,
    background,
    blurred,
    distracted,
    make_data,
    sparse_wall,
    step_of,
)


def noise(seed: int, *shape: int) -> np.ndarray:
    return np.random.default_rng(seed).random(shape).astype(np.float32)


def tensor(array) -> torch.Tensor:
    return torch.from_numpy(np.ascontiguousarray(array))


def number(x: float) -> torch.Tensor:
    return torch.tensor(x, dtype=torch.float64)


def capture(folder) -> SimpleNamespace:
    """Photos of a wall with a distractor in each, the same photos without, and the masks."""
    clean = [background(12 * v) for v in range(VIEWS)]
    photos, truths = zip(*[distracted(image, 40 + v) for v, image in enumerate(clean)])
    data = make_data(folder, list(photos), list(truths))
    return SimpleNamespace(clean=clean, truths=truths, data=sparse_wall(SimpleNamespace(data=data)))


LOOK = dataclasses.replace(FAST.first_look, least=0.0, threshold=0.1, normal=1.0, known_by=1)
PLAIN = RefineSplatConfig(min_mask_start=1, mask_every=1, mask=MaskConfig(least=6.0), first_look=LOOK)
MOST = 1e-3  # of a photo's pixels: what lies within rounding of the threshold, and what hangs on it


def visit(scene, number: int):
    """A step of every view in turn, sharper at later visits; at first some surfaces have a wrong depth."""
    view, rounds = number % VIEWS, number // VIEWS
    image = cv2.GaussianBlur(scene.clean[view], (0, 0), 1.6 - 0.3 * rounds).astype(np.float32)
    step = step_of(scene.data, view, blurred(image, number), 100 + number)
    step.rendered.alpha[:, :5] = 0.25 * rounds
    step.rendered.depth *= step.rendered.alpha
    if rounds < 2:
        step.rendered.depth[20:40] *= 2.5
    step.rendered.visible = None
    return step


def differing(a: torch.Tensor, b: torch.Tensor) -> float:
    return float((a != b).double().mean())


def on(monkeypatch, accelerated: bool) -> None:
    """Take an accelerator's path, or the CPU's, from now on."""
    monkeypatch.setattr(backend, "accelerated", lambda device: accelerated)
