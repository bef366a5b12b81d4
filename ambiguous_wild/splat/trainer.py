"""The one training loop. Methods fill its places (`parts.py`); nothing here knows a method by name."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterable
from functools import partial
from pathlib import Path

import torch
from torch import Tensor

from ambiguous_wild.core import AwError, Camera
from ambiguous_wild.splat import checkpoint, device, snapshot
from ambiguous_wild.splat.clock import clock_for
from ambiguous_wild.splat.data import shrink, shrink_camera, shrink_keep
from ambiguous_wild.splat.effects.chain import Chain
from ambiguous_wild.splat.gaussians import Gaussians
from ambiguous_wild.splat.losses import PhotometricLoss, photometric
from ambiguous_wild.splat.optim import SplatAdam
from ambiguous_wild.splat.pace import Pace, TrainConfig
from ambiguous_wild.splat.parts import Parts
from ambiguous_wild.splat.render import render
from ambiguous_wild.splat.rendered import Rendered
from ambiguous_wild.splat.sentinel import Sentinel
from ambiguous_wild.splat.step import NOMINAL_ITERATIONS, Step, TrainData
from ambiguous_wild.splat.timeline import ROWS, Timeline
from ambiguous_wild.splat.watchdog import NonFinite, Watchdog


class Trainer:
    """Trains one model on one scene; stops and resumes at any iteration with the same bits."""

    def __init__(
        self,
        data: TrainData,
        parts: Parts,
        config: TrainConfig,
        *,
        folder: Path,
        probe: Callable[[Callable[[Camera], Tensor]], float] | None = None,
    ) -> None:
        """
        Args:
            data: the training side.
            parts: the method.
            config: length and bookkeeping.
            folder: where checkpoint and timeline go.
            probe: gets a function that renders a camera, returns PSNR in dB of the test views.
        """
        torch.set_num_threads(config.torch_threads)
        if parts.train_data is not None:
            data = parts.train_data(data)
        self.data, self.parts, self.config, self.folder = data, parts, config, folder
        self.probe = probe
        names = [view.name for view in data.scene.train]
        self.watchdog = Watchdog(folder, config.on_nonfinite, config.seed, names)
        self.clock = clock_for(data.device)
        self.setup_s = 0.0  # seconds before the first step, of the process that began the run
        self.iteration = 0
        self.timeline = Timeline()
        self._skipped: set[int] = set()  # views that were all masked at some step
        self._pyramid: dict[tuple[int, int], Tensor] = {}
        self._cameras: dict[tuple[int, int], Camera] = {}
        # where the host must not wait, what would make it wait is written down there and looked at later
        on = device.accelerated(data.device)
        self.sentinel = Sentinel(data.device, len(data.photos)) if on else None
        if on:
            from ambiguous_wild.splat import fused_loss

            size = data.photos[0].shape[:2]
            fused_loss.prepare(data.device, *size, parts.lambda_dssim, parts.weighting)
        self._prefetch = getattr(data.photos, "prefetch", None)

        points = data.scene.points
        self.gaussians = Gaussians.from_points(
            points.xyz, points.rgb, sh_degree=parts.sh_degree, opacity=parts.start_opacity, device=data.device
        )
        start, most = len(self.gaussians), parts.density_config.max_gaussians
        self.pace = Pace(config, parts.schedule, data, start=start, most=most)
        self.optimiser = SplatAdam(self.gaussians, self.pace.learning_rates(0.0))
        self.density = parts.density(parts.density_config, data.scene.extent, config.seed)
        parts.mask.setup(data)
        self.effects = Chain(parts.effects, data) if parts.effects else None

    def progress(self, iteration: int) -> float:
        """Share of the run that lies behind after `iteration` steps, in [0, 1]."""
        return self.pace.progress(iteration, self.clock.now())

    @property
    def done(self) -> bool:
        return self.progress(self.iteration) >= 1.0

    def _photo(self, view: int, divisor: int) -> Tensor:
        if divisor == 1:
            return self.data.photos[view]
        key = (view, divisor)
        if self._prefetch is not None:  # photos do not fit on the device: neither would smaller ones beside
            return shrink(self.data.photos[view], divisor)
        if key not in self._pyramid:
            self._pyramid[key] = shrink(self.data.photos[view], divisor)
        return self._pyramid[key]

    def _camera(self, view: int, divisor: int) -> Camera:
        """Made once: what a back end keeps of a camera it finds again by the object."""
        if (view, divisor) not in self._cameras:
            self._cameras[view, divisor] = shrink_camera(self.data.cameras[view], divisor)
        return self._cameras[view, divisor]

    def render(self, camera: Camera, nominal: float | None = None, view: int | None = None) -> Rendered:
        """The model as it stands, for one camera; `view` says which train photo's effects apply."""
        nominal = self.progress(self.iteration) * NOMINAL_ITERATIONS if nominal is None else nominal
        if self.effects is None:
            return self._draw(nominal)(self.gaussians, camera)
        return self.effects.render(self.gaussians, camera, view, self.iteration, self._draw(nominal))

    def _draw(self, nominal: float) -> Callable[[Gaussians, Camera], Rendered]:
        return partial(
            render,
            sh_degree=min(int(nominal // self.parts.schedule.sh_every), self.parts.sh_degree),
            background=self.parts.background,
            antialias=self.parts.antialias,
        )

    def neutral_model(self) -> Gaussians:
        """The Gaussians for any viewer: what effects do to them for every camera is part of them."""
        if self.effects is None:
            return self.gaussians
        return self.effects.model(self.gaussians, None, self.iteration)

    def render_fitted(self, camera: Camera, photo: Tensor, keep: Tensor) -> Tensor:
        """A test view after its colour effects were fitted to the part of its photo that `keep` shows."""
        self.optimiser.flush()
        if self.effects is None:
            return self.render(camera).image
        draw = self._draw(self.progress(self.iteration) * NOMINAL_ITERATIONS)
        return self.effects.fit_view(self.gaussians, camera, photo, keep, draw)

    def make_step(self, iteration: int, view: int, divisor: int | None = None) -> Step:
        """Render a train view as the loop does; also used to predict masks afterwards."""
        progress = self.progress(iteration)
        divisor = self.pace.divisor(progress) if divisor is None else divisor
        camera = self._camera(view, divisor)
        if self.effects is not None:
            camera = self.effects.camera(view, camera)
        nominal = progress * NOMINAL_ITERATIONS
        with self.clock.part("render"):
            self.optimiser.prepare(camera)
            rendered = self.render(camera, nominal, view)
        return Step(
            iteration=iteration,
            nominal=nominal,
            view=view,
            divisor=divisor,
            ceiling=self.pace.ceiling(divisor, progress),
            photo=self._photo(view, divisor),
            camera=camera,
            rendered=rendered,
            gaussians=self.gaussians,
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
        """The policy's keep map times the capture's own mask, where there is one.

        Raises:
            AwError: the policy's is no tensor.
        """
        if keep is not None and not isinstance(keep, Tensor):
            raise AwError(
                f"keep(step) of the method's mask policy gave a {type(keep).__name__}; it must give a torch "
                "tensor [H, W], or None (docs/add-a-method.md)"
            )
        user = self.data.user_keep[step.view]
        if user is None:
            return keep
        user = shrink_keep(user, step.divisor)
        return user if keep is None else keep * user

    def step(self) -> float | Tensor:
        """One iteration; returns the photometric loss, NaN where the photo is left out after a rollback.

        On an accelerator the loss is a tensor there, and nothing is waited for but the number of tiles.

        Raises:
            NonFinite: names view, iteration and parameters.
        """
        iteration = self.iteration + 1
        part = self.clock.part
        view = self.pace.view(iteration)
        if self.watchdog.skips(self.pace.epoch(iteration), view):
            self.iteration = iteration
            return math.nan
        step = self.make_step(iteration, view)
        with part("mask"):
            keep = self.combine_user_keep(step, self.parts.mask.keep(step))
        with part("loss"):
            loss = self._photometric(step, keep)
        if self.sentinel is None:
            self.watchdog.look_at_loss(step, keep, loss)
        with part("mask loss"):
            extra = self.parts.mask.cotangent(step, keep)
        if self.sentinel is None and keep is not None and not bool(keep.any()):
            # Nothing to learn from: moving on Adam's momentum alone would drift away from the scene.
            self._skipped.add(step.view)
            self.iteration = iteration
            return loss.value
        with part("backward"):
            gradients = step.rendered.backward(loss.d_image, d_image_extra=extra)
        called_off = None
        with part("watchdog"):
            if self.sentinel is None:
                self.watchdog.look_at_gradients(step, keep, loss, gradients)
            else:
                looked_at = list(self.watchdog.looked_at(gradients).values())
                called_off = self.sentinel.watch(
                    iteration, view, torch.as_tensor(loss.value), looked_at, keep
                )
                # such a step counts for nobody: statistics of growth take neither its zeros nor its NaN
                step.rendered.visible = step.rendered.visible & (called_off == 0)
        with part("optimiser"):
            rates = self.pace.learning_rates(self.progress(iteration))
            self.optimiser.step(gradients, step.rendered.visible, rates, called_off=called_off)
        with part("density"):
            self.density.observe(step, gradients, keep)
            self.gaussians, events = self.density.refine(step, self.gaussians, self.optimiser)
            self.optimiser.bind(self.gaussians)
        if self.effects is not None:
            with part("effects"):
                self.effects.step(step.view, self.progress(iteration), called_off)
                if events:
                    self.effects.rows_changed()
        if "reset" in events:
            self.parts.mask.on_opacity_reset(step)
        if self._prefetch is not None:
            self._prefetch(self.pace.view(iteration + 1))
        if events or self.watchdog.due(iteration):
            with part("watchdog"):
                self._look_back()
                self.watchdog.look_at_parameters(iteration, view, self.gaussians)
        self.iteration = iteration
        return loss.value

    def _look_back(self) -> None:
        """What the sentinel wrote down since the last look: the step is made again, to show what was wrong.

        Raises:
            NonFinite: as the step would have raised it, had anybody waited for it.
        """
        iteration = None if self.sentinel is None else self.sentinel.first_broken()
        if iteration is None:
            return
        step = self.make_step(iteration, self.pace.view(iteration))
        keep = self.combine_user_keep(step, self.parts.mask.predict(step))
        loss = self._photometric(step, keep)
        self.watchdog.look_at_loss(step, keep, loss)
        extra = self.parts.mask.cotangent(step, keep)
        gradients = step.rendered.backward(loss.d_image, d_image_extra=extra)
        self.watchdog.look_at_gradients(step, keep, loss, gradients)
        raise self.watchdog.not_seen_again(step, keep, loss)

    def train(self, *, tick: Callable[[Trainer], None] | None = None) -> None:
        """Run to the end; saves as it goes, probes on schedule.

        Args:
            tick: called after every iteration with the clock stopped (progress bars).

        Raises:
            NonFinite: names view, iteration and parameters.
        """
        if self.config.on_nonfinite == "rollback" and not self.checkpoint_path.exists():
            self.save()  # something to go back to, from the first iteration on
        last_save = time.monotonic()
        while True:
            if self.done:
                if self._save_if_sound():
                    return
                continue  # rolled back: there is more to do
            self._advance(tick)
            if time.monotonic() - last_save > self.config.checkpoint_every_s and not self.done:
                self._save_if_sound()
                last_save = time.monotonic()

    def _advance(self, tick: Callable[[Trainer], None] | None) -> None:
        """One iteration with its bookkeeping, or one step back."""
        before = self.progress(self.iteration)
        self.clock.start()
        try:
            loss = self.step()
        except NonFinite as error:
            self.clock.stop()
            self.watchdog.handle(self, error)
            return
        after = self.progress(self.iteration)
        due = int(after * ROWS) > int(before * ROWS)
        if due:
            self.clock.settle()
        self.clock.stop()
        self.timeline.loss(loss)
        if due:
            probes = self.config.probes
            self._log(probing=probes > 0 and int(after * probes) > int(before * probes))
        if tick is not None:
            tick(self)

    def check_parameters(self) -> None:
        """Raise NonFinite, as of the last step, where a parameter is not finite."""
        self._look_back()
        view = self.pace.view(max(self.iteration, 1))
        self.watchdog.look_at_parameters(self.iteration, view, self.gaussians)

    def _save_if_sound(self) -> bool:
        """Save, unless a parameter is not finite: then it is as if the last step had found that."""
        try:
            self.check_parameters()
        except NonFinite as error:
            self.watchdog.handle(self, error)
            return False
        self.save()
        return True

    def _log(self, probing: bool) -> None:
        row = self.timeline.add(self.iteration, len(self.gaussians), self.clock)
        if probing and self.probe is not None:
            spent = dict(self.clock.parts_s)
            row["psnr_probe"] = self.probe(self._probe_image)
            self.clock.parts_s = spent

    @torch.no_grad()
    def _probe_image(self, camera: Camera) -> Tensor:
        # Rows the optimiser has put off are brought up to date first; it computes what a later step
        # would have computed, so that probing changes nothing (a test compares the bits).
        self.optimiser.prepare(camera)
        return self.render(camera).image

    @property
    def ms_per_iteration(self) -> float:
        return 1e3 * self.clock.now() / max(self.iteration, 1)

    @property
    def skipped_views(self) -> list[str]:
        """Train photos that were all masked at some step and taught nothing then."""
        return sorted(self.data.scene.train[i].name for i in self.skipped)

    @property
    def skipped(self) -> set[int]:
        """Those photos' indices."""
        return self._skipped | (self.sentinel.empty_views() if self.sentinel is not None else set())

    def note_skipped(self, views: Iterable[int]) -> None:
        """Of the part of the run before it was resumed."""
        self._skipped = set(views)

    @property
    def checkpoint_path(self) -> Path:
        return self.folder / "checkpoint" / "last.safetensors"

    def save(self) -> None:
        """Write the whole state and the timeline, each atomically."""
        checkpoint.save(self.checkpoint_path, snapshot.take(self))
        self.timeline.write(self.folder / "timeline.csv")

    def resume(self) -> bool:
        """Go on from the last checkpoint, if there is one; returns whether there was."""
        if not self.checkpoint_path.exists():
            return False
        snapshot.restore(self, checkpoint.load(self.checkpoint_path), self.checkpoint_path)
        if self.sentinel is not None:
            self.sentinel.reset()
        return True
