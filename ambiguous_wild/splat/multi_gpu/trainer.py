"""The training loop of a model that several ranks share.

An iteration is a photo, as on one GPU. A step takes one photo a rank. So a run of N iterations sees N photos,
and schedules act at the same photos, on any number of GPUs.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Collection
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from ambiguous_wild.core import AwError, Camera
from ambiguous_wild.splat import device as devices
from ambiguous_wild.splat.gaussians import Gaussians
from ambiguous_wild.splat.multi_gpu import shards
from ambiguous_wild.splat.multi_gpu.exchange import gather
from ambiguous_wild.splat.multi_gpu.ranks import Ranks
from ambiguous_wild.splat.multi_gpu.refuse import refuse
from ambiguous_wild.splat.multi_gpu.render import SharedRendered, render_shared
from ambiguous_wild.splat.multi_gpu.sentinel import SharedSentinel
from ambiguous_wild.splat.optim import SplatAdam
from ambiguous_wild.splat.pace import TrainConfig
from ambiguous_wild.splat.parts import Parts
from ambiguous_wild.splat.rendered import Gradients, Rendered, as_cotangents
from ambiguous_wild.splat.step import NOMINAL_ITERATIONS, Shot, Step, TrainData
from ambiguous_wild.splat.trainer import Trainer
from ambiguous_wild.splat.watchdog import NonFinite


def batch_adam(batch: int) -> tuple[tuple[float, float], float]:
    """Adam's betas and eps for `batch` photos a step; learning rates grow with its square root.

    Source: gsplat's examples/simple_trainer.py; the square root is Malladi et al. 2022 (arXiv 2205.10287).
    """
    return (1 - batch * (1 - 0.9), 1 - batch * (1 - 0.999)), 1e-15 / math.sqrt(batch)


def _refuse_to_draw(gaussians: Gaussians, shot: Shot, without: Collection[str]) -> Rendered:
    raise AwError(
        "the mask policy draws pictures of its own, and each GPU holds a share of the Gaussians: "
        "leave --gpus out"
    )


class SharedTrainer(Trainer):
    """Trains one rank's share. Every method below is called by all ranks at once."""

    def __init__(
        self,
        data: TrainData,
        parts: Parts,
        config: TrainConfig,
        *,
        folder: Path,
        ranks: Ranks,
        probe: Callable[[Callable[[Camera], Tensor]], float] | None = None,
    ) -> None:
        """
        Args:
            data: the training side, the same on all ranks.
            parts: the method.
            config: length and bookkeeping; iterations count photos.
            folder: where shards and timeline go.
            ranks: that share the model.
            probe: as of `Trainer`; given to all ranks, called on rank 0.

        Raises:
            AwError: something of the run cannot be shared.
        """
        refuse(parts, config, ranks.size)
        if not devices.accelerated(data.device):
            raise AwError(f"--gpus {ranks.size} is of GPUs: leave it out, or give --device cuda")
        super().__init__(data, parts, config, folder=folder, probe=probe)
        self.ranks = ranks
        rows = torch.arange(ranks.rank, len(self.gaussians), ranks.size, device=self.gaussians.device)
        self.gaussians = self.gaussians.select(rows)
        self.field.rates = self._rates
        self.optimiser = SplatAdam(self.gaussians, self._rates(0.0), *batch_adam(ranks.size))
        self.density.rng = np.random.default_rng([config.seed, 0xD3, ranks.rank])
        self.sentinel: SharedSentinel = SharedSentinel(data.device, len(data.photos), ranks)
        self.counts = ranks.counts(len(self.gaussians))  # Gaussians of each rank

    def _rates(self, progress: float) -> dict[str, float]:
        root = math.sqrt(self.ranks.size)
        return {name: root * rate for name, rate in self.pace.learning_rates(progress).items()}

    def render(self, camera: Camera) -> Rendered:
        """Refused: a rank holds a share of the model. See `make_step` and `gather`."""
        raise RuntimeError("a rank cannot draw alone: it holds a share of the Gaussians")

    def make_step(self, iteration: int, view: int, divisor: int | None = None) -> Step:
        """The step that ends with this iteration, of this rank's photo; `view` is found here."""
        progress = self.progress(iteration)
        divisor = self.pace.divisor(progress) if divisor is None else divisor
        view = self._views(iteration)[self.ranks.rank]
        shot = Shot(
            iteration=iteration,
            nominal=progress * NOMINAL_ITERATIONS,
            progress=progress,
            view=view,
            divisor=divisor,
            photo=self.pyramid.photo(view, divisor),
            camera=self.pyramid.camera(view, divisor),
        )
        with self.clock.part("render"):
            rendered = render_shared(
                self.gaussians,
                self._step_cameras(iteration, divisor),
                self.ranks,
                self.counts,
                sh_degree=min(int(shot.nominal // self.parts.schedule.sh_every), self.parts.sh_degree),
                background=self.parts.background,
                antialias=self.parts.antialias,
                blur=self.parts.blur,
            )
        step = self._step_of(shot, rendered, self._own_ceiling(self.pace.ceiling(divisor, progress)))
        return replace(step, drawer=_refuse_to_draw)

    def _views(self, iteration: int) -> list[int]:
        """Of the step that ends with this iteration, by rank; no rank has to send its camera."""
        first = iteration - self.ranks.size + 1
        return [self.pace.view(i) for i in range(first, iteration + 1)]

    def _step_cameras(self, iteration: int, divisor: int) -> list[Camera]:
        return [self.pyramid.camera(view, divisor) for view in self._views(iteration)]

    def _own_ceiling(self, ceiling: int) -> int:
        """This rank's: the room that is left, shared out by what each has."""
        own, total = len(self.gaussians), sum(self.counts)
        return own + max(ceiling - total, 0) * own // max(total, 1)

    def step(self) -> float | Tensor:
        """One photo of every rank; returns the loss of this rank's.

        Raises:
            AwError: something is not finite; the same on every rank.
        """
        iteration = self.iteration + self.ranks.size
        part = self.clock.part
        step = self.make_step(iteration, -1)
        rendered = step.rendered
        assert isinstance(rendered, SharedRendered)
        with part("mask"):
            keep = self.combine_user_keep(step, self.parts.mask.keep(step))
        with part("loss"):
            loss = self._photometric(step, keep)
        with part("backward"):
            gradients = self._mean(rendered.backward(loss.d_image))
        with part("watchdog"):
            looked_at = list(self.watchdog.looked_at(gradients).values())
            called_off = self.sentinel.watch(
                iteration, step.view, torch.as_tensor(loss.value), looked_at, keep
            )
        with part("optimiser"):
            rates = self._rates(self.progress(iteration))
            self.optimiser.step(gradients, rendered.visible, rates, called_off=called_off)
        with part("density"):
            events = self._change_density(step, rendered, gradients, called_off)
        if "reset" in events:
            self.parts.mask.on_opacity_reset(step)
        if self.pyramid.prefetch is not None:
            self.pyramid.prefetch(self._views(iteration + self.ranks.size)[self.ranks.rank])
        self.iteration = iteration
        if events or self._look_due():
            with part("watchdog"):
                self.check_parameters()
        return loss.value

    def _mean(self, gradients: Gradients) -> Gradients:
        """Over the photos of the step; `screen` stays what it is."""
        names = [name for name, _ in self.gaussians.items()]
        return replace(gradients, **{n: getattr(gradients, n) / self.ranks.size for n in names})

    def _change_density(
        self, step: Step, rendered: SharedRendered, gradients: Gradients, called_off: Tensor
    ) -> list[str]:
        """Observe each photo of the step as one GPU would have; grow where it is time, as all ranks do.

        A step that was called off is not observed: neither its zeros nor its NaN are added.
        """
        if self.density.due(step) and bool(called_off):  # the same on all ranks; as one GPU does
            return []
        screens, going = rendered.screens, called_off == 0
        for q, camera in enumerate(self._step_cameras(step.iteration, step.divisor)):
            one = rendered.seen_by(q)
            one.visible = one.visible & going
            seen = replace(step, camera=camera, rendered=one)
            self.density.observe(seen, replace(gradients, screen=screens[q], visible=one.visible))
        self.gaussians, events = self.density.refine(step, self.gaussians, self.optimiser)
        self.optimiser.bind(self.gaussians)
        if "grow" in events:
            self.counts = self.ranks.counts(len(self.gaussians))
        return events

    def _look_due(self) -> bool:
        return (self.iteration // self.ranks.size) % self.watchdog.every == 0

    def check_parameters(self) -> None:
        """Raise AwError, the same on every rank, where something is or was not finite on any."""
        self._look_back()
        view = self._views(max(self.iteration, self.ranks.size))[self.ranks.rank]
        self._raise_together(lambda: self.watchdog.look_at_parameters(self.iteration, view, self.gaussians))

    def _look_back(self) -> None:
        broken = self.sentinel.first_broken()  # of the same step on all ranks
        if broken is None:
            return
        iteration, keep = broken.iteration, broken.keep
        step = self.make_step(iteration, -1)
        loss = self._photometric(step, keep)
        gradients = step.rendered.backward(as_cotangents(loss.d_image, broken.extra))
        self._raise_together(lambda: self.watchdog.look_at_loss(step, keep, loss))
        self._raise_together(lambda: self.watchdog.look_at_gradients(step, keep, loss, gradients))
        raise AwError(f"a gradient was not finite at iteration {iteration}, and is when it is made again")

    def _raise_together(self, look: Callable[[], None]) -> None:
        found = None
        try:
            look()
        except NonFinite as error:
            found = str(error)
        said = [text for text in self.ranks.everyone(found) if text]
        if said:
            raise AwError(f"{said[0]}; to see what the step saw train without --gpus: one GPU keeps it")

    def train(self, *, tick: Callable[[Trainer], None] | None = None) -> None:
        """Run to the end; saves as it goes, probes on schedule.

        Args:
            tick: called after every step with the clock stopped.

        Raises:
            AwError: something is not finite; the same on every rank.
        """
        last_save = time.monotonic()
        while not self.done:
            self._advance(tick)
            if self._look_due() and not self.done and self._save_is_due(last_save):
                self.save()  # looked at just now
                last_save = time.monotonic()
        self.check_parameters()
        self.save()

    def _save_is_due(self, last_save: float) -> bool:
        """Rank 0's clock decides for all."""
        return self.ranks.first_says(time.monotonic() - last_save > self.config.checkpoint_every_s)

    def _log(self, probing: bool) -> None:
        own = [float(self.timeline.loss_sum), float(self.timeline.loss_count)]
        loss, count = self.ranks.sum(torch.tensor(own, device=self.ranks.device)).tolist()
        self.timeline.loss_sum, self.timeline.loss_count = loss, int(count)
        row = self.timeline.add(self.iteration, sum(self.counts), self.clock)
        if probing and self.probe is not None:
            whole = self.gather()
            if whole is not None:
                row["psnr_probe"] = self.probe(lambda camera: self._draw_whole(whole, camera))

    @torch.no_grad()
    def _draw_whole(self, whole: Gaussians, camera: Camera) -> Tensor:
        return self.drawing(whole, self.shot(camera)).image

    def gather(self, device: torch.device | str | None = None) -> Gaussians | None:
        """The whole model on rank 0, on its GPU or where `device` says; None on the others."""
        return gather(self.gaussians, self.ranks, self.counts, device)

    def save(self) -> None:
        """Write every rank's shard, and the timeline."""
        shards.save(self)
        if self.ranks.rank == 0:
            self.timeline.write(self.folder / "timeline.csv")

    def resume(self) -> bool:
        """Go on from the last shards that all ranks have; returns whether there are any."""
        if not shards.restore(self):
            return False
        self.optimiser.betas, self.optimiser.eps = batch_adam(self.ranks.size)
        self.sentinel.reset()
        self.counts = self.ranks.counts(len(self.gaussians))
        return True
