"""Per-device checks that a training step stayed finite, without making the host wait.

On an accelerator the host does not know the result of a step until it waits for it. So the device keeps a
flag that stays set, the number of finite steps before it, and the weights of the broken step's loss. While
the flag is set the optimiser changes nothing: when the host looks, the parameters are still those of the
broken step, and it can be computed again.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from ambiguous_wild.splat.rendered import Cotangents


@dataclass(frozen=True)
class Broken:
    """A step with values that are not finite, and what weighed its loss."""

    iteration: int
    keep: Tensor | None
    extra: Cotangents | None  # the method's own losses on the render


class Sentinel:
    """The checks of one training run."""

    def __init__(self, device: torch.device, views: int) -> None:
        """
        Args:
            device: where the run is.
            views: number of train photos.
        """
        self._broken = torch.zeros(1, device=device)
        self._sound = torch.zeros(1, device=device)  # steps since the last look
        self._empty = torch.zeros(views, device=device)  # steps at which a photo was all masked
        self._one = torch.ones(1, device=device)
        # steps since the last look: iteration, and shapes of their weights
        self._watched: list[tuple[int, dict[str, torch.Size]]] = []
        # Keep map and own losses of the latest step, or of the broken one; flat, as large as the largest so
        # far. A policy that learns would return others when the host looks.
        self._weights: dict[str, Tensor] = {}

    def watch(
        self,
        iteration: int,
        view: int,
        loss: Tensor,
        gradients: Sequence[Tensor],
        keep: Tensor | None,
        extra: Cotangents | Tensor | None = None,
    ) -> Tensor:
        """Check one step.

        Args:
            iteration: of the run.
            view: index of its photo.
            loss: 0-d.
            gradients: float32; unchanged.
            keep: keep map of the loss, or None.
            extra: the method's own losses on the render, or None.

        Returns:
            [1] float32, 1 = the optimiser must change nothing: a value is not finite, now or since the last
            look; or nothing of the photo is kept, and momentum alone would drift away from the scene.
        """
        given = _named(keep, extra)
        self._watched.append((iteration, {name: value.shape for name, value in given.items()}))
        before = self._broken.clone()
        # torch's check for mixed precision: one launch for all tensors; it divides them by one
        torch._amp_foreach_non_finite_check_and_unscale_(
            [loss.detach().reshape(1), *(g.detach() for g in gradients)], self._broken, self._one
        )
        self._remember(before, given)
        nothing = None if keep is None else (keep.amax() <= 0).to(torch.float32).reshape(1)
        if nothing is not None:
            self._empty[view : view + 1] += nothing
        self._sound += 1.0 - self._broken
        return self._broken.clone() if nothing is None else torch.maximum(self._broken, nothing)

    def _remember(self, before: Tensor, given: Mapping[str, Tensor]) -> None:
        """Copy the weights of the step, unless an earlier one was broken."""
        for name, value in given.items():
            flat = value.detach().reshape(-1)
            known = self._weights.get(name)
            if known is None or len(known) < len(flat):
                known = flat.new_zeros(len(flat)) if known is None else _longer(known, len(flat))
                self._weights[name] = known
            known[: len(flat)] = torch.where(before > 0, known[: len(flat)], flat)

    def first_broken(self) -> Broken | None:
        """The first step since the last look at which something was not finite. The host waits."""
        broken, sound = torch.cat([self._broken, self._sound]).tolist()
        watched, self._watched = self._watched, []
        self._sound.zero_()
        if not broken:
            return None
        iteration, shapes = watched[int(sound)]
        weights: dict[str, Any] = {
            name: self._weights[name][: shape.numel()].reshape(shape) for name, shape in shapes.items()
        }
        keep = weights.pop("keep", None)
        return Broken(iteration, keep, Cotangents(**weights) if weights else None)

    def empty_views(self) -> set[int]:
        """Photos that were masked completely at some step. The host waits."""
        return {view for view, times in enumerate(self._empty.tolist()) if times}

    def reset(self) -> None:
        """After going back to a checkpoint."""
        for tensor in (self._broken, self._sound):
            tensor.zero_()
        self._watched = []


def _named(keep: Tensor | None, extra: Cotangents | Tensor | None) -> dict[str, Tensor]:
    """All that are given, by the names of `Broken` and `Cotangents`."""
    own = Cotangents(extra=extra) if isinstance(extra, Tensor) else extra or Cotangents()
    given = {"keep": keep, "image": own.image, "extra": own.extra, "alpha": own.alpha, "depth": own.depth}
    return {name: value for name, value in given.items() if value is not None}


def _longer(flat: Tensor, size: int) -> Tensor:
    return torch.cat([flat, flat.new_zeros(size - len(flat))])
