"""Mask policies that recipes share: fixed keep maps, and the mask of one method with the loss of another."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from ambiguous_wild.core.config import Facts, State
from ambiguous_wild.io.mask_reasons import MaskReasons
from ambiguous_wild.splat.data import shrink_keep
from ambiguous_wild.splat.effects.base import Effect
from ambiguous_wild.splat.method_hooks import MaskPolicy, MethodHooks
from ambiguous_wild.splat.rendered import Cotangents, Gradients, as_cotangents
from ambiguous_wild.splat.step import Step, TrainData


class FixedMasks(MaskPolicy):
    """The same keep map in every step of a photo."""

    def __init__(self, keeps: Sequence[Tensor]) -> None:
        """
        Args:
            keeps: keep maps of the train views, [H, W] in [0, 1] at the photos' size, 1 = static.
        """
        self.keeps = list(keeps)

    def setup(self, data: TrainData) -> None:
        self.keeps = [keep.to(data.device, torch.float32) for keep in self.keeps]

    def keep(self, step: Step) -> Tensor:
        return shrink_keep(self.keeps[step.view], step.downsampling)

    def facts(self) -> Facts:
        shares = [1.0 - float(keep.mean()) for keep in self.keeps]
        return {"masked_share": sum(shares) / max(len(shares), 1)}


class GraftedMaskPolicy(MaskPolicy):
    """Keep maps, pictures and facts of `mask`; cotangents of `regulariser`, if there is one."""

    def __init__(self, mask: MaskPolicy, regulariser: MaskPolicy | None) -> None:
        self.mask, self.regulariser = mask, regulariser

    def setup(self, data: TrainData) -> None:
        self.mask.setup(data)
        if self.regulariser is not None:
            self.regulariser.setup(data)

    def required_effect(self) -> Effect | None:
        return self.mask.required_effect()

    def loss_effect(self) -> Effect | None:
        return None if self.regulariser is None else self.regulariser.loss_effect()

    def keep(self, step: Step) -> Tensor | None:
        return self.mask.keep(step)

    def cotangent(self, step: Step, keep: Tensor | None) -> Cotangents | Tensor | None:
        mine = self.mask.cotangent(step, keep) if self.mask.learns_by_gradients else None
        other = None if self.regulariser is None else self.regulariser.cotangent(step, keep)
        return other if mine is None else mine if other is None else as_cotangents(mine, other)

    def gradients(self, step: Step, keep: Tensor | None) -> Gradients | None:
        mine = self.mask.gradients(step, keep) if self.mask.learns_by_gradients else None
        other = None if self.regulariser is None else self.regulariser.gradients(step, keep)
        return other if mine is None else mine if other is None else mine + other

    def composed_keep(self, step: Step) -> Tensor | None:
        return self.mask.composed_keep(step)

    def predict(self, step: Step) -> Tensor | None:
        return self.mask.predict(step)

    def on_opacity_reset(self, step: Step) -> None:
        self.mask.on_opacity_reset(step)
        if self.regulariser is not None:
            self.regulariser.on_opacity_reset(step)

    def facts(self) -> Facts:
        return self.mask.facts()

    def panels(self, step: Step) -> dict[str, np.ndarray]:
        return self.mask.panels(step)

    def predict_with_reasons(self, step: Step) -> tuple[Tensor | None, MaskReasons | None]:
        return self.mask.predict_with_reasons(step)

    def explain(self, step: Step, x: int, y: int) -> list[str]:
        return self.mask.explain(step, x, y)

    def draw(self, folder: Path) -> list[Path]:
        return self.mask.draw(folder)

    def state_dict(self) -> State:
        other = None if self.regulariser is None else self.regulariser.state_dict()
        return {"mask": self.mask.state_dict(), "regulariser": other}

    def load_state_dict(self, state: State) -> None:
        self.mask.load_state_dict(state["mask"])
        if self.regulariser is not None:
            self.regulariser.load_state_dict(state["regulariser"])


def makes_masks(hooks: MethodHooks) -> bool:
    """Return whether the method's mask policy, without a grafted regulariser, masks anything."""
    policy = hooks.mask.mask if isinstance(hooks.mask, GraftedMaskPolicy) else hooks.mask
    kind = type(policy)
    return kind.keep is not MaskPolicy.keep or kind.predict is not MaskPolicy.predict
