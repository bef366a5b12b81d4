"""The training loop. Methods fill its places (`method_hooks.py`); nothing here knows a method by name."""

from __future__ import annotations

import math
from dataclasses import fields, replace
from pathlib import Path

import torch
from torch import Tensor

from ambiguous_wild.core import AwError, Camera
from ambiguous_wild.core.config import State
from ambiguous_wild.splat.calibration import warm_backward
from ambiguous_wild.splat.data import Pyramid, shrink_keep
from ambiguous_wild.splat.density import DensityControl
from ambiguous_wild.splat.drawing import SceneRenderer
from ambiguous_wild.splat.effects.effect_pipeline import EffectPipeline
from ambiguous_wild.splat.field import Field, rates_with
from ambiguous_wild.splat.gaussians import Gaussians
from ambiguous_wild.splat.losses import PhotometricLoss, photometric
from ambiguous_wild.splat.method_hooks import MethodHooks
from ambiguous_wild.splat.optim import SplatAdam
from ambiguous_wild.splat.pace import Pace, TrainConfig
from ambiguous_wild.splat.rendered import (
    Cotangents,
    Gradients,
    Rendered,
    as_cotangents,
    check_needs,
    with_visible,
)
from ambiguous_wild.splat.run import Probe, Run
from ambiguous_wild.splat.step import NOMINAL_ITERATIONS, Step, TrainData, ViewContext
from ambiguous_wild.splat.watchdog import DeviceFiniteCheck


class Trainer(Run):
    """Trains one model on one scene; stops and resumes at any iteration with the same bits."""

    def __init__(
        self,
        data: TrainData,
        parts: MethodHooks,
        config: TrainConfig,
        *,
        folder: Path,
        probe: Probe | None = None,
    ) -> None:
        """
        Args:
            data: the training side.
            parts: the method.
            config: length and bookkeeping.
            folder: folder for checkpoint and timeline.
            probe: takes a function that renders a camera; returns PSNR in dB of the test views.
        """
        data.backend.use_threads(config.torch_threads)
        if parts.train_data is not None:
            data = replace(parts.train_data(data.for_method()), scene=data.scene)
        super().__init__(data, config, folder, probe)
        data = data.for_method()
        self.parts = parts
        self.pyramid = Pyramid(data)
        self._compiled: set[frozenset[str]] = set()  # cotangents for which the backward pass is compiled
        self._divisors: dict[int, int] = {}  # divisors of the steps since the sentinel was last read
        # where reading a value makes the host wait, checks stay on the device and are read later
        views = len(data.photos)
        self.sentinel = None if data.backend.reads_at_once else DeviceFiniteCheck(data.device, views)
        check_needs(parts.density.needs, data.backend.statistics)
        most = parts.density_config.max_gaussians
        room = Pace(config, parts.schedule, data, start=0, most=most).most
        gaussians = parts.first_gaussians(data, room)
        self.pace = Pace(config, parts.schedule, data, start=len(gaussians), most=most)
        sizes = self.pyramid.sizes(self.pace.divisors)
        data.backend.prepare_loss(data.device, sizes, parts.lambda_dssim, parts.weighting)
        self.effects = EffectPipeline(parts.effects, data)
        attributes = self.effects.rows(gaussians)
        if attributes:
            gaussians = gaussians.carrying({name: a.values for name, a in attributes.items()})
        density = parts.density(parts.density_config, data.scene.extent, config.seed)
        density.setup(data)
        density.protected = self.effects.protected()
        self.field = Field(gaussians, rates_with(attributes, self.pace.learning_rates), density)
        self.drawing = SceneRenderer(data, parts, self.field, self.effects)
        parts.mask.setup(data)

    # The static field is the result of the run.
    @property
    def gaussians(self) -> Gaussians:
        return self.field.gaussians

    @property
    def optimiser(self) -> SplatAdam:
        return self.field.optimiser

    @property
    def density(self) -> DensityControl:
        assert self.field.density is not None
        return self.field.density

    def state(self) -> State:
        others, effects = self.drawing.state_dict(), self.effects.state_dict()
        return {
            **super().state(),
            **self.field.state_dict(),
            **({"fields": others} if others else {}),
            "mask": self.parts.mask.state_dict(),
            **({"effects": effects} if effects else {}),
        }

    def load_state(self, state: State) -> None:
        self.field.load_state_dict(state, self.data.device)
        if self.drawing.others:
            self.drawing.load_state_dict(state["fields"], self.data.device)
        self.parts.mask.load_state_dict(state["mask"])
        self.effects.load_state_dict(state.get("effects", {}))
        super().load_state(state)

    def context(self, camera: Camera, *, fitting: bool = False) -> ViewContext:
        """Return the view context, at the present time of the run, of a camera without a train photo."""
        progress = self.progress(self.iteration)
        nominal = progress * NOMINAL_ITERATIONS
        return ViewContext(
            iteration=0 if fitting else self.iteration,
            nominal=nominal,
            progress=progress,
            view=None,
            camera=camera,
            fitting=fitting,
        )

    def render(self, camera: Camera) -> Rendered:
        """Draw the static field for any camera, in its present state, without the light of a photo."""
        return self.drawing(self.gaussians, self.context(camera))

    def neutral_model(self) -> Gaussians:
        """Return the Gaussians for viewers, changed as the effects change them for every camera."""
        return self.drawing.neutral_model(self.gaussians, self.iteration)

    def render_fitted(self, camera: Camera, photo: Tensor, keep: Tensor) -> Tensor:
        """Draw a test view [H, W, 3] after fitting the colour effects to a part of its photo.

        Args:
            camera: camera of the test view.
            photo: [H, W, 3] in [0, 1], on any device.
            keep: [H, W], 1 where the fit may read the photo, on any device.
        """
        self.optimiser.flush()
        photo, keep = photo.to(self.data.device), keep.to(self.data.device)
        return self.drawing.fit(self.gaussians, self.context(camera, fitting=True), photo, keep)

    def make_step(self, iteration: int, view: int, divisor: int | None = None) -> Step:
        """Draw a train view as the loop does; also used to predict masks after the training."""
        progress = self.progress(iteration)
        divisor = self.pace.divisor(progress) if divisor is None else divisor
        context = ViewContext(
            iteration=iteration,
            nominal=progress * NOMINAL_ITERATIONS,
            progress=progress,
            view=view,
            divisor=divisor,
            photo=self.pyramid.photo(view, divisor),
            camera=self.pyramid.camera(view, divisor),
        )
        context = replace(context, camera=self.effects.camera(context))
        with self.clock.part("render"):
            rendered = self.drawing(self.gaussians, context)
        of_context = {f.name: getattr(context, f.name) for f in fields(ViewContext)}
        return Step(
            **of_context,
            ceiling=self.pace.ceiling(divisor, progress),
            rendered=rendered,
            gaussians=self.gaussians,
            drawer=self.drawing.again,
        )

    def _photometric(self, step: Step, keep: Tensor | None) -> PhotometricLoss:
        return photometric(
            step.rendered.image,
            step.photo,
            keep,
            lambda_dssim=self.parts.lambda_dssim,
            weighting=self.parts.weighting,
        )

    def combine_user_keep(self, step: Step, keep: Tensor | None) -> Tensor | None:
        """Multiply the policy's keep map by the capture's own mask, if there is one.

        Raises:
            AwError: the policy's map is no tensor, or its values are out of range.
        """
        if keep is not None and not isinstance(keep, Tensor):
            raise AwError(
                f"keep(step) of the method's mask policy gave a {type(keep).__name__}; it must give a torch "
                "tensor [H, W], or None (docs/extend.md)"
            )
        if self.sentinel is None and keep is not None:  # on the CPU, where reading costs nothing
            low, high = keep.min().item(), keep.max().item()
            if low < -0.01 or high > 1.01:  # rounding may leave the range
                raise AwError(
                    f"keep(step) of the method's mask policy gave values from {low:.3g} to {high:.3g}: "
                    "weights of pixels lie between 0, masked, and 1, kept"
                )
        user = self.data.user_keep[step.view]
        if user is None:
            return keep
        user = shrink_keep(user, step.divisor)
        return user if keep is None else keep * user

    def step(self) -> float | Tensor:
        """Run one iteration; returns the photometric loss, NaN if a rollback left the photo out.

        On an accelerator the loss is a tensor, and the host waits only for the number of tiles.

        Raises:
            NonFinite: a value is not finite; the message names view, iteration and parameters.
        """
        iteration = self.iteration + 1
        part = self.clock.part
        view = self.pace.view(iteration)
        if self.watchdog.skips(self.pace.epoch(iteration), view):
            self.iteration = iteration
            return math.nan
        step = self.make_step(iteration, view)
        shown = (step.photo, step.rendered.image)
        changes = [picture._version for picture in shown]  # torch counts changes in place
        with part("mask"):
            keep = self.combine_user_keep(step, self.parts.mask.keep(step))
        with part("loss"):
            loss = self._photometric(step, keep)
        if self.sentinel is None:
            self.watchdog.check_loss(step, keep, loss)
        with part("mask loss"):
            method_cotangents = self.parts.mask.cotangent(step, keep)
            _refuse_a_loss(method_cotangents, step)
            if changes != [picture._version for picture in shown]:
                raise AwError(
                    f"keep or cotangent of {type(self.parts.mask).__name__} changed step.photo or "
                    "step.rendered.image in place, which training reads: change a copy, .clone()"
                )
        if self.sentinel is None and keep is not None and not bool(keep.any()):
            # Nothing to learn: steps by Adam's momentum alone would drift away from the scene.
            self._skipped.add(step.view)
            self.iteration = iteration
            return loss.value
        cotangents = as_cotangents(loss.d_image, method_cotangents)
        self._compile_backward(cotangents.pictures())
        with part("backward"):
            gradients = self._gradients(step, keep, cotangents)
        skip_step = None
        with part("watchdog"):
            if self.sentinel is None:
                self.watchdog.check_gradients(step, keep, loss, gradients)
            else:
                skip_step = self._watch(step, keep, method_cotangents, loss, gradients)
                step, gradients = _for_statistics(step, gradients, skip_step)
        events = self._learn(step, keep, gradients, skip_step)
        if "reset" in events:
            self.parts.mask.on_opacity_reset(step)
        if self.pyramid.prefetch is not None:
            self.pyramid.prefetch(self.pace.view(iteration + 1))
        if events or self.watchdog.due(iteration):
            with part("watchdog"):
                self._look_back()
                self.watchdog.check_parameters(iteration, view, self.gaussians)
        self.iteration = iteration
        return loss.value

    def _compile_backward(self, pictures: frozenset[str]) -> None:
        """Compile the backward pass with such cotangents, outside of the training time."""
        if self.data.backend.kernels and pictures not in self._compiled:
            with self.clock.paused():
                warm_backward(pictures, self.density.needs)
            self._compiled.add(pictures)

    def _gradients(self, step: Step, keep: Tensor | None, cotangents: Cotangents) -> Gradients:
        """Backpropagate the step's render and the further pictures that the method drew."""
        gradients = step.rendered.backward(cotangents, self.density.needs)
        more = self.parts.mask.gradients(step, keep)
        if more is not None:
            gradients = gradients + more
        gradients = self.drawing.with_other_pictures(step, keep, gradients)
        return self.density.before_step(step, gradients)

    def _watch(
        self,
        step: Step,
        keep: Tensor | None,
        method_cotangents: Cotangents | Tensor | None,
        loss: PhotometricLoss,
        gradients: Gradients,
    ) -> Tensor:
        """Let the sentinel check the step; returns [1] on the device, 1 = skip the optimiser's step."""
        assert self.sentinel is not None
        checked = list(self.watchdog.checked_gradients(gradients).values())
        value = torch.as_tensor(loss.value)
        self._divisors[step.iteration] = step.divisor
        return self.sentinel.watch(step.iteration, step.view, value, checked, keep, method_cotangents)

    def _learn(
        self, step: Step, keep: Tensor | None, gradients: Gradients, skip_step: Tensor | None
    ) -> list[str]:
        """Run the optimiser, density control and effects; returns the events of density control."""
        part, progress = self.clock.part, self.progress(step.iteration)
        events: list[str] = []
        density_keep = keep
        if self.density.reads_keep and (composed := self.parts.mask.composed_keep(step)) is not None:
            density_keep = self.combine_user_keep(step, composed)
        # as on the CPU, a fully masked photo changes nothing; only before growth does the host read the flag
        if skip_step is not None and keep is not None and self.density.due(step) and bool(skip_step):
            return events
        if self.density.before_optimiser:
            with part("density"):
                events = self.field.refine(step, gradients, density_keep)
        if not events:  # rows that have just changed have no gradients
            with part("optimiser"):
                self.field.learn(gradients, progress, skip_step)
        if not self.density.before_optimiser:
            with part("density"):
                events = self.field.refine(step, gradients, density_keep)
        if gradients.fields:
            with part("fields"):
                self.drawing.learn(step, gradients.fields, progress, skip_step)
        if self.parts.effects:
            with part("effects"):
                self.effects.step(gradients, replace(step, progress=progress), skip_step)
                if events:
                    self.effects.rows_changed()
                self.effects.after_step(step, self.gaussians)
        return events

    def _look_back(self) -> None:
        """Read the sentinel; if a step since the last look was not finite, repeat it to find the values.

        Raises:
            NonFinite: the finding that the step itself would have raised on the CPU.
        """
        broken = None if self.sentinel is None else self.sentinel.first_broken()
        divisors, self._divisors = self._divisors, {}
        if broken is None:
            return
        # repeat at the step's own size: under a budget the schedule has moved on with the clock
        view, divisor = self.pace.view(broken.iteration), divisors.get(broken.iteration)
        step = self.make_step(broken.iteration, view, divisor)
        keep = broken.keep
        loss = self._photometric(step, keep)
        self.watchdog.check_loss(step, keep, loss)
        gradients = step.rendered.backward(as_cotangents(loss.d_image, broken.method_cotangents))
        self.watchdog.check_gradients(step, keep, loss, gradients)
        raise self.watchdog.nonreproducible(step, keep, loss)

    def check_parameters(self) -> None:
        """Raise NonFinite for the last step if a parameter is not finite."""
        self._look_back()
        view = self.pace.view(max(self.iteration, 1))
        self.watchdog.check_parameters(self.iteration, view, self.gaussians)


def _refuse_a_loss(value: object, step: Step) -> None:
    """Raise AwError if `cotangent` of a mask policy returned a loss, or a gradient of another shape."""
    if value is None:
        return
    shape = list(step.rendered.image.shape)
    if isinstance(value, Cotangents):
        for name, size in {"image": shape, "extra": shape, "alpha": shape[:2], "depth": shape[:2]}.items():
            tensor = getattr(value, name)
            if tensor is not None and list(tensor.shape) != size:
                raise AwError(
                    f"cotangent(step, keep) of the method's mask policy gave {name} {list(tensor.shape)}; it "
                    f"must be {size}"
                )
        return
    if not isinstance(value, Tensor) or list(value.shape) != shape:
        what = f"a tensor {list(value.shape)}" if isinstance(value, Tensor) else f"a {type(value).__name__}"
        raise AwError(
            f"cotangent(step, keep) of the method's mask policy gave {what}; it must give a gradient, "
            f"{shape}; return a loss from loss(render, step, keep) instead (docs/extend.md)"
        )


def _for_statistics(step: Step, gradients: Gradients, skip_step: Tensor) -> tuple[Step, Gradients]:
    """Return step and gradients for the densification statistics: a skipped step must not enter them.

    So it marks every Gaussian invisible.
    """
    going = skip_step == 0
    step = replace(step, rendered=with_visible(step.rendered, step.rendered.visible & going))
    if gradients.visible is not None:
        gradients = replace(gradients, visible=gradients.visible & going)
    return step, gradients
