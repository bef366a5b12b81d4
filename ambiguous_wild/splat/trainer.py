"""The state of a training and its step; the loop is in `training_loop.py`.

Methods implement hooks (`method_hooks.py`); nothing here knows a method by name.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import fields, replace
from pathlib import Path
from typing import NoReturn

import torch
from torch import Tensor

from ambiguous_wild.core import AwError, Camera
from ambiguous_wild.core.config import State
from ambiguous_wild.splat import checkpoint
from ambiguous_wild.splat.calibration import warm_backward
from ambiguous_wild.splat.data import PhotoPyramid, shrink_keep
from ambiguous_wild.splat.density import DensityControl
from ambiguous_wild.splat.drawing import SceneRenderer
from ambiguous_wild.splat.effects.effect_pipeline import EffectPipeline
from ambiguous_wild.splat.field import Field, rates_with_attributes
from ambiguous_wild.splat.gaussians import Gaussians
from ambiguous_wild.splat.losses import PhotometricLoss, photometric
from ambiguous_wild.splat.method_hooks import MethodHooks, check_cotangents, check_keep
from ambiguous_wild.splat.optim import SplatAdam
from ambiguous_wild.splat.rendered import (
    Cotangents,
    Gradients,
    Rendered,
    as_cotangents,
    check_needs,
    with_visible,
)
from ambiguous_wild.splat.run_schedule import RunSchedule
from ambiguous_wild.splat.step import Step, TrainData, ViewContext
from ambiguous_wild.splat.train_config import NOMINAL_ITERATIONS, TrainConfig
from ambiguous_wild.splat.training_records import Clock, RunObserver, Timeline, clock_for
from ambiguous_wild.splat.watchdog import DeviceFiniteCheck, Watchdog

Probe = Callable[[Callable[[Camera], Tensor]], float]


class Trainer:
    """Trains one model on one scene; stops and resumes at any iteration with the same bits."""

    def __init__(
        self,
        data: TrainData,
        hooks: MethodHooks,
        config: TrainConfig,
        *,
        folder: Path,
        probe: Probe | None = None,
    ) -> None:
        """
        Args:
            data: the training side.
            hooks: the method.
            config: length and bookkeeping.
            folder: folder for checkpoint and timeline.
            probe: takes a function that renders a camera; returns PSNR in dB of the test views.
        """
        data.backend.use_threads(config.torch_threads)
        if hooks.train_data is not None:
            data = replace(hooks.train_data(data.for_method()), scene=data.scene)
        self.data, self.config, self.folder, self.probe = data, config, folder, probe
        names = [view.name for view in data.scene.train]
        self.watchdog = Watchdog(folder, config.on_nonfinite, config.seed, names)
        self.clock: Clock = clock_for(data.device)
        self.meter: RunObserver | None = None
        self.marks: tuple[int, int] | None = None  # probes and timeline rows due after the last step
        self.setup_s = 0.0  # seconds before the first step, in the process that began the run
        # "hash" of the run's configuration and "about", its name; empty = unknown
        self.run_identity: dict[str, str] = {}
        self.continues: frozenset[str] = frozenset()  # hashes of shorter runs whose checkpoint may be resumed
        self.iteration = 0
        self.timeline = Timeline()
        self._skipped: set[int] = set()  # views that were fully masked at some step
        data = data.for_method()
        if any(data.scene.background):
            hooks = replace(hooks, background=data.scene.background)
        self.hooks = hooks
        self.pyramid = PhotoPyramid(data)
        self._compiled: set[frozenset[str]] = set()  # cotangents for which the backward pass is compiled
        self._downsampling: dict[int, int] = {}  # factors of the steps since the device's check was last read
        # where reading a value makes the host wait, checks stay on the device and are read later
        views = len(data.photos)
        self.device_check = None if data.backend.reads_at_once else DeviceFiniteCheck(data.device, views)
        check_needs(hooks.density.needs, data.backend.statistics)
        needed = hooks.density.needs_effect
        if needed and needed not in {effect.name for effect in hooks.effects}:
            raise AwError(f"this method's density control needs the effect {needed}: add --effects {needed}")
        most = hooks.density_config.max_gaussians
        room = RunSchedule(config, hooks.schedule, data, start=0, most=most).max_gaussians
        gaussians = hooks.first_gaussians(data, room)
        self.run_schedule = RunSchedule(config, hooks.schedule, data, start=len(gaussians), most=most)
        sizes = self.pyramid.sizes(self.run_schedule.factors)
        data.backend.prepare_loss(data.device, sizes, hooks.lambda_dssim, hooks.weighting)
        self.effects = EffectPipeline(hooks.effects, data)
        attributes = self.effects.rows(gaussians)
        if attributes:
            gaussians = gaussians.with_attributes({name: a.values for name, a in attributes.items()})
        density = hooks.density(hooks.density_config, data.scene.extent, config.seed)
        density.setup(data)
        density.protected = self.effects.protected()
        self.field = Field(
            gaussians, rates_with_attributes(attributes, self.run_schedule.learning_rates), density
        )
        self.drawing = SceneRenderer(data, hooks, self.field, self.effects)
        hooks.mask.setup(data)

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

    @property
    def parts(self) -> NoReturn:
        raise AwError("trainer.parts is trainer.hooks now")

    def state(self) -> State:
        """Return everything that decides how the run goes on; parts that are absent have no key."""
        rollbacks = self.watchdog.state_dict()
        others, effects = self.drawing.state_dict(), self.effects.state_dict()
        return {
            **({"run": dict(self.run_identity)} if self.run_identity else {}),
            "iteration": self.iteration,
            "elapsed_s": self.clock.now(),
            "setup_s": self.setup_s,
            "parts_s": self.clock.parts_s,
            "cpu_s": self.clock.cpu_s,
            **({} if self.meter is None else {"meter": self.meter.state_dict()}),
            "timeline": self.timeline.rows,
            "loss": [float(self.timeline.loss_sum), self.timeline.loss_count],
            "skipped": sorted(self.skipped),
            **({"rollbacks": rollbacks} if rollbacks else {}),
            **self.field.state_dict(),
            **({"fields": others} if others else {}),
            "mask": self.hooks.mask.state_dict(),
            **({"effects": effects} if effects else {}),
        }

    def load_state(self, state: State) -> None:
        """Restore what `state` returned; exact, so that a resumed run gives the same bits.

        Raises:
            KeyError: a key is missing.
        """
        self.field.load_state_dict(state, self.data.device)
        if self.drawing.others:
            self.drawing.load_state_dict(state["fields"], self.data.device)
        self.hooks.mask.load_state_dict(state["mask"])
        self.effects.load_state_dict(state.get("effects", {}))
        self.iteration = state["iteration"]
        self.setup_s = state["setup_s"]
        self.clock = clock_for(self.data.device, state["elapsed_s"], dict(state["parts_s"]))
        self.clock.cpu_s = state.get("cpu_s", 0.0)
        if self.meter is not None and "meter" in state:
            self.meter.load_state_dict(state["meter"])
        self.marks = None  # counted again from the new state
        self.timeline.rows = list(state["timeline"])
        self.timeline.loss_sum, self.timeline.loss_count = state["loss"]
        self._skipped = set(state["skipped"])
        self.watchdog.load_state_dict(state.get("rollbacks", []))

    @property
    def checkpoint_path(self) -> Path:
        return self.folder / "checkpoint" / "last.safetensors"

    def save(self) -> None:
        """Write the state and the timeline, each atomically."""
        checkpoint.save(self.checkpoint_path, self.state())
        self.timeline.write(self.folder / "timeline.csv")

    def resume(self) -> bool:
        """Load the last checkpoint, if there is one; returns whether there was.

        Raises:
            AwError: the checkpoint is incomplete, or belongs to another run; the message names the file.
        """
        path = self.checkpoint_path
        if not path.exists():
            return False
        state = checkpoint.load(path)
        other = state.get("run", self.run_identity)  # checkpoints of earlier versions do not hold it
        if self.run_identity and other != self.run_identity and other.get("hash") not in self.continues:
            raise AwError(
                f"checkpoint {path} is of another run ({other.get('about')}, configuration "
                f"{str(other.get('hash'))[:12]}), this one is {self.run_identity['about']}, configuration "
                f"{self.run_identity['hash'][:12]}; delete it, or train again with --overwrite always"
            )
        try:
            self.load_state(state)
        except (KeyError, TypeError) as error:
            raise AwError(f"checkpoint {path} lacks {error}; train again with --overwrite always") from None
        if self.device_check is not None:
            self.device_check.reset()
        return True

    def progress(self, iteration: int) -> float:
        """Return the share of the run done after `iteration` steps, in [0, 1]."""
        return self.config.share_done(iteration, self.clock.now())

    @property
    def done(self) -> bool:
        return self.progress(self.iteration) >= 1.0

    @property
    def ms_per_iteration(self) -> float:
        return 1e3 * self.clock.now() / max(self.iteration, 1)

    @property
    def skipped_views(self) -> list[str]:
        """Names of train photos that were fully masked at some step, which was then skipped."""
        return sorted(self.data.scene.train[i].name for i in self.skipped)

    @property
    def skipped(self) -> set[int]:
        """Indices of train photos that were fully masked at some step."""
        return self._skipped | (self.device_check.empty_views() if self.device_check is not None else set())

    def check_photos_used(self) -> None:
        """Raise AwError if nothing was learnt: the loss was 0 in every row of the timeline."""
        rows = self.timeline.rows
        if rows and all(row["loss"] == 0.0 for row in rows):
            masked = len(self.skipped)
            why = (
                f"{masked} of {len(self.data.scene.train)} train photos are masked all over: mask less, or "
                "mend masks/train (white is kept)"
                if masked
                else "check the masks, poses, focal lengths and points of the scene"
            )
            raise AwError(f"the loss stayed 0 over {self.iteration} iterations, so nothing was learnt; {why}")

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

    @torch.no_grad()
    def picture(self, camera: Camera) -> Tensor:
        """Draw a picture [H, W, 3] between two steps; the run has the same bits as without it.

        Rows that are pending in the optimiser are brought up to date, as a later step would have done.
        """
        return self.render(camera).image

    def neutral_model(self) -> Gaussians:
        """Return the Gaussians for viewers, changed as the effects change them for every camera."""
        return self.effects.neutral_model(self.gaussians, self.iteration)

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

    def make_step(self, iteration: int, view: int, downsampling: int | None = None) -> Step:
        """Draw a train view as the loop does; also used to predict masks after the training."""
        progress = self.progress(iteration)
        downsampling = self.run_schedule.downsampling(progress) if downsampling is None else downsampling
        context = ViewContext(
            iteration=iteration,
            nominal=progress * NOMINAL_ITERATIONS,
            progress=progress,
            view=view,
            downsampling=downsampling,
            photo=self.pyramid.photo(view, downsampling),
            camera=self.pyramid.camera(view, downsampling),
        )
        context = replace(context, camera=self.effects.camera(context))
        with self.clock.part("render"):
            rendered = self.drawing(self.gaussians, context)
        of_context = {f.name: getattr(context, f.name) for f in fields(ViewContext)}
        return Step(
            **of_context,
            growth_cap=self.run_schedule.growth_cap(downsampling, progress),
            rendered=rendered,
            gaussians=self.gaussians,
            drawer=self.drawing.draw_again,
        )

    def _photometric(self, step: Step, keep: Tensor | None) -> PhotometricLoss:
        return photometric(
            step.rendered.image,
            step.photo,
            keep,
            lambda_dssim=self.hooks.lambda_dssim,
            weighting=self.hooks.weighting,
        )

    def combine_user_keep(self, step: Step, keep: Tensor | None) -> Tensor | None:
        """Multiply the policy's keep map by the capture's own mask, and keep what a person marked as static.

        Raises:
            AwError: the policy's map is no tensor, or its values are out of range.
        """
        check_keep(keep, read=self.device_check is None)
        by_hand = self.data.by_hand[step.view] if self.data.by_hand else None
        if keep is not None and by_hand is not None:
            static = shrink_keep((by_hand > 0).float(), step.downsampling) > 0.5
            keep = torch.where(static, torch.ones_like(keep), keep)
        user = self.data.user_keep[step.view]
        if user is None:
            return keep
        user = shrink_keep(user, step.downsampling)
        return user if keep is None else keep * user

    def step(self) -> float | Tensor:
        """Run one iteration; returns the photometric loss, NaN if a rollback left the photo out.

        On an accelerator the loss is a tensor, and the host waits only for the number of tiles.

        Raises:
            NonFinite: a value is not finite; the message names view, iteration and parameters.
        """
        iteration = self.iteration + 1
        part = self.clock.part
        view = self.run_schedule.view(iteration)
        if self.watchdog.skips(self.run_schedule.epoch(iteration), view):
            self.iteration = iteration
            return math.nan
        step = self.make_step(iteration, view)
        if self.pyramid.prefetch is not None:
            self.pyramid.prefetch(self.run_schedule.view(iteration + 1))
        shown = (step.photo, step.rendered.image)
        changes = [picture._version for picture in shown]  # torch counts changes in place
        with part("mask"):
            keep = self.combine_user_keep(step, self.hooks.mask.keep(step))
        with part("loss"):
            loss = self._photometric(step, keep)
        if self.device_check is None:
            self.watchdog.check_loss(step, keep, loss)
        with part("mask loss"):
            method_cotangents = self.hooks.mask.cotangent(step, keep)
            check_cotangents(method_cotangents, step)
            if changes != [picture._version for picture in shown]:
                raise AwError(
                    f"keep, loss or cotangent of {type(self.hooks.mask).__name__} changed step.photo or "
                    "step.rendered.image in place, which training reads: change a copy, .clone()"
                )
        if self.device_check is None and keep is not None and not bool(keep.any()):
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
            if self.device_check is None:
                self.watchdog.check_gradients(step, keep, loss, gradients)
            else:
                skip_step = self._watch(step, keep, method_cotangents, loss, gradients)
                step, gradients = _for_statistics(step, gradients, skip_step)
        events = self._learn(step, keep, gradients, skip_step)
        if "reset" in events:
            self.hooks.mask.on_opacity_reset(step)
        if events or self.watchdog.due(iteration):
            with part("watchdog"):
                self._read_device_check()
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
        more = self.hooks.mask.gradients(step, keep)
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
        """Check the step on the device; returns [1] on the device, 1 = skip the optimiser's step."""
        assert self.device_check is not None
        checked = self.watchdog.checked_gradients(gradients)
        value = torch.as_tensor(loss.value)
        self._downsampling[step.iteration] = step.downsampling
        return self.device_check.watch(step.iteration, step.view, value, checked, keep, method_cotangents)

    def _learn(
        self, step: Step, keep: Tensor | None, gradients: Gradients, skip_step: Tensor | None
    ) -> list[str]:
        """Run the optimiser, density control and effects; returns the events of density control."""
        part, progress = self.clock.part, self.progress(step.iteration)
        density_keep = keep
        if self.density.reads_keep and (composed := self.hooks.mask.composed_keep(step)) is not None:
            density_keep = self.combine_user_keep(step, composed)
        # as on the CPU, a fully masked photo changes nothing; only before growth does the host read the flag
        if skip_step is not None and keep is not None and self.density.due(step) and bool(skip_step):
            return []
        with part("optimiser"):
            self.field.learn(gradients, progress, skip_step)
        with part("density"):
            events = self.field.refine(step, gradients, density_keep)
        if gradients.fields:
            with part("fields"):
                self.drawing.learn(step, gradients.fields, progress, skip_step)
        if self.hooks.effects:
            with part("effects"):
                self.effects.step(gradients, replace(step, progress=progress), skip_step)
                if events:
                    self.effects.rows_changed()
                self.effects.after_step(step, self.gaussians)
        return events

    def _read_device_check(self) -> None:
        """Read the device's check; if a step was not finite since the last one, repeat it to find the values.

        Raises:
            NonFinite: the finding that the step itself would have raised on the CPU.
        """
        broken = None if self.device_check is None else self.device_check.first_broken()
        factors, self._downsampling = self._downsampling, {}
        if broken is None:
            return
        # repeat at the step's own size: under a budget the schedule has moved on with the clock
        view, downsampling = self.run_schedule.view(broken.iteration), factors.get(broken.iteration)
        step = self.make_step(broken.iteration, view, downsampling)
        keep = broken.keep
        loss = self._photometric(step, keep)
        self.watchdog.check_loss(step, keep, loss)
        gradients = step.rendered.backward(as_cotangents(loss.d_image, broken.method_cotangents))
        self.watchdog.check_gradients(step, keep, loss, gradients)
        raise self.watchdog.nonreproducible(step, keep, loss)

    def check_parameters(self) -> None:
        """Raise NonFinite for the last step if a parameter is not finite."""
        self._read_device_check()
        view = self.run_schedule.view(max(self.iteration, 1))
        for field in (self.field, *self.drawing.others.values()):
            self.watchdog.check_parameters(self.iteration, view, field.gaussians)


def _for_statistics(step: Step, gradients: Gradients, skip_step: Tensor) -> tuple[Step, Gradients]:
    """Return step and gradients for the densification statistics: a skipped step must not enter them.

    So it marks every Gaussian invisible.
    """
    going = skip_step == 0
    step = replace(step, rendered=with_visible(step.rendered, step.rendered.visible & going))
    if gradients.visible is not None:
        gradients = replace(gradients, visible=gradients.visible & going)
    return step, gradients
