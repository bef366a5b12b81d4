"""Looks for values that are not finite where looking must not make the host wait.

On an accelerator nobody knows what a step gave until somebody waits for it. So what is wrong is written down
there: one flag that stays up once it is up, and how many steps were sound before. While it is up the
optimiser is called off, on the device, step after step: when the host looks, the parameters are still those
that the bad step saw.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor


class Sentinel:
    """Of one training run on one device."""

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
        self._watched: list[int] = []  # iterations since the last look

    def watch(
        self, iteration: int, view: int, loss: Tensor, gradients: Sequence[Tensor], keep: Tensor | None
    ) -> Tensor:
        """Take note of one step.

        Args:
            iteration: of the run.
            view: index of its photo.
            loss: 0-d.
            gradients: float32; unchanged.
            keep: what weighed the loss, or None.

        Returns:
            [1] float32, 1 where the optimiser is not to move: something is broken, now or since the last
            look, or nothing of the photo is kept and moving on momentum alone would drift from the scene.
        """
        self._watched.append(iteration)
        # torch's tool for mixed precision: one launch for all tensors; it divides them by one
        torch._amp_foreach_non_finite_check_and_unscale_(
            [loss.detach().reshape(1), *(g.detach() for g in gradients)], self._broken, self._one
        )
        nothing = None if keep is None else (keep.amax() <= 0).to(torch.float32).reshape(1)
        if nothing is not None:
            self._empty[view : view + 1] += nothing
        return self._called_off(nothing)

    def _called_off(self, nothing: Tensor | None) -> Tensor:
        """[1] of what `watch` returns, from the flag and whether nothing is kept (None: something is)."""
        self._sound += 1.0 - self._broken
        return self._broken.clone() if nothing is None else torch.maximum(self._broken, nothing)

    def first_broken(self) -> int | None:
        """The first iteration since the last look at which something was not finite. The host waits."""
        broken, sound = torch.cat([self._broken, self._sound]).tolist()
        watched, self._watched = self._watched, []
        self._sound.zero_()
        return watched[int(sound)] if broken else None

    def empty_views(self) -> set[int]:
        """Photos that were all masked at some step. The host waits."""
        return {view for view, times in enumerate(self._empty.tolist()) if times}

    def reset(self) -> None:
        """After going back to a checkpoint."""
        for tensor in (self._broken, self._sound):
            tensor.zero_()
        self._watched = []
