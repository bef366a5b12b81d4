"""Several photos a step on one device: their mean gradient, one step of the optimiser.

The optimiser's traffic is paid once for all photos of a step. Schedules, growth and learning rates are those
of several GPUs with a photo each, so an iteration is still a photo. For runs that several GPUs can share.
"""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from ambiguous_wild.core import AwError
from ambiguous_wild.splat import device as devices
from ambiguous_wild.splat.multi_gpu.refuse import refuse
from ambiguous_wild.splat.multi_gpu.trainer import batch_adam
from ambiguous_wild.splat.optim import SplatAdam
from ambiguous_wild.splat.pace import TrainConfig
from ambiguous_wild.splat.parts import Parts
from ambiguous_wild.splat.rendered import Gradients
from ambiguous_wild.splat.run import Probe
from ambiguous_wild.splat.step import Step, TrainData
from ambiguous_wild.splat.trainer import Trainer


class BatchTrainer(Trainer):
    """Trains with `views` photos a step."""

    def __init__(
        self,
        data: TrainData,
        parts: Parts,
        config: TrainConfig,
        *,
        views: int,
        folder: Path,
        probe: Probe | None = None,
    ) -> None:
        """
        Args:
            data, parts, config, folder, probe: as of `Trainer`; iterations count photos.
            views: photos a step, 2 to 4.

        Raises:
            AwError: the run cannot be trained so; the conditions are those of `--gpus`.
        """
        if not 2 <= views <= 4:
            raise AwError(f"views a step: 2 to 4, got {views}")
        try:
            refuse(parts, config, views)
        except AwError as error:
            raise AwError(f"{views} views a step, as {error}") from None
        if not devices.accelerated(data.device):
            raise AwError("several views a step are of a GPU")
        super().__init__(data, parts, config, folder=folder, probe=probe)
        self.views = views
        self.field.rates = self._rates
        self.optimiser = SplatAdam(self.gaussians, self._rates(0.0), *batch_adam(views))

    def _rates(self, progress: float) -> dict[str, float]:
        root = math.sqrt(self.views)
        return {name: root * rate for name, rate in self.pace.learning_rates(progress).items()}

    def resume(self) -> bool:
        """As `Trainer.resume`; the optimiser goes on with the batch's betas."""
        found = super().resume()
        self.optimiser.betas, self.optimiser.eps = batch_adam(self.views)
        return found

    def step(self) -> Tensor:
        """One step of `views` photos; returns their mean loss, on the device.

        Raises:
            NonFinite: names view, iteration and parameters.
        """
        assert self.sentinel is not None
        part, first, last = self.clock.part, self.iteration + 1, self.iteration + self.views
        seen: list[tuple[Step, Tensor | None, Gradients]] = []
        losses, off = [], []
        for iteration in range(first, last + 1):
            step = self.make_step(iteration, self.pace.view(iteration))
            with part("mask"):
                keep = self.combine_user_keep(step, self.parts.mask.keep(step))
            with part("loss"):
                loss = self._photometric(step, keep)
            with part("backward"):
                gradients = step.rendered.backward(loss.d_image, self.density.needs)
            with part("watchdog"):
                off.append(self._watch(step, keep, None, loss, gradients))
            losses.append(torch.as_tensor(loss.value))
            seen.append((step, keep, gradients))
        # broken stays broken; a photo without anything to learn from does not stop the others
        self._learn_all(seen, torch.stack(off))
        if self.pyramid.prefetch is not None:
            self.pyramid.prefetch(self.pace.view(last + 1))
        self.iteration = last
        return torch.stack(losses).mean()

    def _learn_all(self, seen: list[tuple[Step, Tensor | None, Gradients]], off: Tensor) -> None:
        assert self.sentinel is not None
        part, (step, _, _) = self.clock.part, seen[-1]
        progress = self.progress(step.iteration)
        called_off = torch.maximum(off.amin(0), self.sentinel.broken)
        names = [name for name, _ in self.gaussians.items()]
        total: dict[str, Any] = {n: torch.stack([getattr(g, n) for _, _, g in seen]).mean(0) for n in names}
        mean = replace(seen[-1][2], **total)
        assert mean.visible is not None  # kernels on a GPU always tell
        with part("optimiser"):
            self.optimiser.step(mean, mean.visible, self._rates(progress), called_off=called_off)
        with part("density"):
            for one, keep, gradients in seen:
                self.density.observe(one, gradients, keep)
            events: list[str] = []
            if not (self.density.due(step) and bool(called_off)):
                self.gaussians, events = self.density.refine(step, self.gaussians, self.optimiser)
                self.optimiser.bind(self.gaussians)
        if "reset" in events:
            self.parts.mask.on_opacity_reset(step)
        if events or step.iteration // self.views % self.watchdog.every == 0:
            with part("watchdog"):
                self._look_back()
                self.watchdog.look_at_parameters(step.iteration, step.view, self.gaussians)
