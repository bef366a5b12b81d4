"""The one training loop. Methods fill its places (`parts.py`); nothing here knows a method by name."""

from __future__ import annotations

import csv
import io
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from torch import Tensor

from ambiguous_wild.core import AwError, Camera
from ambiguous_wild.io.atomic import write_text
from ambiguous_wild.splat import checkpoint
from ambiguous_wild.splat.data import shrink, shrink_camera, shrink_keep
from ambiguous_wild.splat.effects.chain import Chain
from ambiguous_wild.splat.gaussians import Gaussians
from ambiguous_wild.splat.losses import photometric
from ambiguous_wild.splat.optim import SplatAdam
from ambiguous_wild.splat.parts import Parts
from ambiguous_wild.splat.render import render
from ambiguous_wild.splat.rendered import Rendered
from ambiguous_wild.splat.resolution import FULL, Level, ceiling_at, coarse_to_fine, divisor_at
from ambiguous_wild.splat.step import NOMINAL_ITERATIONS, Step, TrainData

COARSE_UNTIL = 0.4  # share of the run; measured on simulated captures, see docs/training.md
TIMELINE_ROWS = 100


@dataclass(frozen=True)
class TrainConfig:
    """How long, on what, how often saved. What is learnt how is the method's (`Parts`)."""

    iterations: int = NOMINAL_ITERATIONS
    budget_s: float | None = None  # seconds of training instead of a number of iterations
    seed: int = 0
    resolution: Literal["auto", "full", "coarse-to-fine"] = "auto"  # auto: coarse-to-fine under a budget
    max_gaussians: int | None = None  # None: the method's own ceiling
    torch_threads: int = 1  # fixed, not the machine's: the split of a sum decides its last bits
    checkpoint_every_s: float = 60.0
    probes: int = 8  # times the test PSNR is probed; the clock stands still meanwhile


@dataclass
class Clock:
    """Training time alone: reading photos, probing and saving do not count."""

    elapsed_s: float = 0.0
    parts_s: dict[str, float] = field(default_factory=dict)
    _since: float | None = None

    def start(self) -> None:
        self._since = time.perf_counter()

    def stop(self) -> None:
        if self._since is not None:
            self.elapsed_s += time.perf_counter() - self._since
            self._since = None

    def now(self) -> float:
        running = 0.0 if self._since is None else time.perf_counter() - self._since
        return self.elapsed_s + running

    @contextmanager
    def part(self, name: str) -> Iterator[None]:
        begin = time.perf_counter()
        try:
            yield
        finally:
            self.parts_s[name] = self.parts_s.get(name, 0.0) + time.perf_counter() - begin


class NonFinite(AwError):
    """The loss stopped being a number."""


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
        self.extent = data.scene.extent
        self.clock = Clock()
        self.setup_s = 0.0  # seconds before the first step, of the process that began the run
        self.iteration = 0
        self.timeline: list[dict[str, Any]] = []
        self._loss_sum, self._loss_count = 0.0, 0
        self._skipped_views: set[int] = set()
        self._pyramid: dict[tuple[int, int], Tensor] = {}

        points = data.scene.points
        self.gaussians = Gaussians.from_points(
            points.xyz, points.rgb, sh_degree=parts.sh_degree, opacity=parts.start_opacity
        ).to(data.device)
        self.start_count = len(self.gaussians)
        self.levels = self._levels()
        self.optimiser = SplatAdam(self.gaussians, self._learning_rates(0.0))
        self.density = parts.density(parts.density_config, self.extent, config.seed)
        parts.mask.setup(data)
        self.effects = Chain(parts.effects, data) if parts.effects else None

    # -- schedule ---------------------------------------------------------------------------------

    def progress(self, iteration: int) -> float:
        """Share of the run that lies behind after `iteration` steps, in [0, 1]."""
        if self.config.budget_s is not None:
            return min(self.clock.now() / self.config.budget_s, 1.0)
        return min(iteration / self.config.iterations, 1.0)

    @property
    def done(self) -> bool:
        return self.progress(self.iteration) >= 1.0

    def _short(self) -> bool:
        return self.config.budget_s is not None or self.config.iterations < self.parts.schedule.short_below

    def _most_gaussians(self) -> int:
        """Growth ends here: a short run can neither afford nor settle more than the photos can tell apart.

        Simulated courtyard at 240x135, 3000 iterations: 14 000, 20 000, 32 000 and 64 000 Gaussians gave
        RefineSplat 30.3, 31.1, 31.3 and 30.7 dB at 9.5, 11.3, 13.6 and 19.6 ms an iteration.
        """
        if self.config.max_gaussians is not None:
            return self.config.max_gaussians
        most = self.parts.density_config.max_gaussians
        if not self._short():
            return most
        pixels = float(np.median([photo.shape[0] * photo.shape[1] for photo in self.data.photos]))
        return min(most, max(self.start_count, int(self.parts.schedule.per_pixel_short * pixels)))

    def _levels(self) -> tuple[Level, ...]:
        wanted: str = self.config.resolution
        if wanted == "auto":
            wanted = "coarse-to-fine" if self.config.budget_s is not None else self.parts.schedule.resolution
        if wanted == "full":
            return FULL
        sample = self.data.photos[:: max(len(self.data.photos) // 8, 1)]
        return coarse_to_fine([photo.cpu().numpy() for photo in sample], COARSE_UNTIL)

    def _learning_rates(self, progress: float) -> dict[str, float]:
        s = self.parts.schedule
        last = s.lr_means_final_short if self._short() else s.lr_means_final
        return {
            "means": self.extent * s.lr_means * (last / s.lr_means) ** progress,
            "quats": s.lr_quats,
            "log_scales": s.lr_scales,
            "opacity_logits": s.lr_opacity,
            "sh0": s.lr_sh0,
            "sh_rest": s.lr_sh_rest,
        }

    def _view_at(self, iteration: int) -> int:
        """Every view once an epoch in an order of its own; a function of the seed, so it has no state."""
        n = len(self.data.photos)
        epoch, k = divmod(iteration - 1, n)
        return int(np.random.default_rng([self.config.seed, 0x51, epoch]).permutation(n)[k])

    # -- one step ---------------------------------------------------------------------------------

    def _photo(self, view: int, divisor: int) -> Tensor:
        if divisor == 1:
            return self.data.photos[view]
        key = (view, divisor)
        if key not in self._pyramid:
            self._pyramid[key] = shrink(self.data.photos[view], divisor)
        return self._pyramid[key]

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
        divisor = divisor_at(self.levels, progress) if divisor is None else divisor
        camera = shrink_camera(self.data.cameras[view], divisor)
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
            ceiling=ceiling_at(self.start_count, self._most_gaussians(), divisor, progress, COARSE_UNTIL),
            photo=self._photo(view, divisor),
            camera=camera,
            rendered=rendered,
            gaussians=self.gaussians,
        )

    def combine_user_keep(self, step: Step, keep: Tensor | None) -> Tensor | None:
        """The policy's keep map times the capture's own mask, where there is one."""
        user = self.data.user_keep[step.view]
        if user is None:
            return keep
        user = shrink_keep(user, step.divisor)
        return user if keep is None else keep * user

    def step(self) -> float:
        """One iteration; returns the photometric loss."""
        iteration = self.iteration + 1
        part = self.clock.part
        step = self.make_step(iteration, self._view_at(iteration))
        with part("mask"):
            keep = self.combine_user_keep(step, self.parts.mask.keep(step))
        with part("loss"):
            loss = photometric(
                step.rendered.image,
                step.photo,
                keep,
                lambda_dssim=self.parts.lambda_dssim,
                weighting=self.parts.weighting,
            )
        if not np.isfinite(loss.value):
            raise self._non_finite(step, "loss")
        with part("mask loss"):
            extra = self.parts.mask.cotangent(step, keep)
        if keep is not None and not bool(keep.any()):
            # Nothing to learn from: moving on Adam's momentum alone would drift away from the scene.
            self._skipped_views.add(step.view)
            self.iteration = iteration
            return loss.value
        with part("backward"):
            gradients = step.rendered.backward(loss.d_image, d_image_extra=extra)
        with part("optimiser"):
            self.optimiser.step(
                gradients, step.rendered.visible, self._learning_rates(self.progress(iteration))
            )
        with part("density"):
            self.density.observe(step, gradients, keep)
            self.gaussians, events = self.density.refine(step, self.gaussians, self.optimiser)
            self.optimiser.bind(self.gaussians)
        if self.effects is not None:
            with part("effects"):
                self.effects.step(step.view, self.progress(iteration))
                if events:
                    self.effects.rows_changed()
        if "reset" in events:
            self.parts.mask.on_opacity_reset(step)
        self.iteration = iteration
        return loss.value

    def _non_finite(self, step: Step, what: str) -> NonFinite:
        bad = [name for name, tensor in self.gaussians.items() if not bool(torch.isfinite(tensor).all())]
        where = self.data.scene.train[step.view].name
        return NonFinite(
            f"{what} is not finite at iteration {step.iteration}, view {where}"
            + (f", parameters {', '.join(bad)}" if bad else "")
            + f"; the last good state is in {self.folder / 'checkpoint'}"
        )

    # -- the loop ---------------------------------------------------------------------------------

    def train(self, *, tick: Callable[[Trainer], None] | None = None) -> None:
        """Run to the end; saves as it goes, probes on schedule.

        Args:
            tick: called after every iteration with the clock stopped (progress bars).

        Raises:
            NonFinite: names view, iteration and parameters.
        """
        last_save = time.monotonic()
        while not self.done:
            before = self.progress(self.iteration)
            self.clock.start()
            loss = self.step()
            self.clock.stop()
            self._loss_sum, self._loss_count = self._loss_sum + loss, self._loss_count + 1
            after = self.progress(self.iteration)
            if int(after * TIMELINE_ROWS) > int(before * TIMELINE_ROWS):
                probes = self.config.probes
                self._log(probing=probes > 0 and int(after * probes) > int(before * probes))
            if tick is not None:
                tick(self)
            if time.monotonic() - last_save > self.config.checkpoint_every_s and not self.done:
                self.save()
                last_save = time.monotonic()
        self.optimiser.flush()
        self.save()

    def _log(self, probing: bool) -> None:
        n = max(self.iteration, 1)
        row: dict[str, Any] = {
            "wall_s": round(self.clock.now(), 3),
            "iteration": self.iteration,
            "loss": self._loss_sum / max(self._loss_count, 1),
            "gaussians": len(self.gaussians),
            "psnr_probe": None,
        }
        self._loss_sum, self._loss_count = 0.0, 0
        row |= {f"ms_{name.replace(' ', '_')}": 1e3 * s / n for name, s in self.clock.parts_s.items()}
        if probing and self.probe is not None:
            spent = dict(self.clock.parts_s)
            row["psnr_probe"] = self.probe(self._probe_image)
            self.clock.parts_s = spent
        self.timeline.append(row)

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
        return sorted(self.data.scene.train[i].name for i in self._skipped_views)

    # -- state ------------------------------------------------------------------------------------

    @property
    def checkpoint_path(self) -> Path:
        return self.folder / "checkpoint" / "last.safetensors"

    def save(self) -> None:
        """Write the whole state and the timeline, each atomically."""
        state = {
            "iteration": self.iteration,
            "elapsed_s": self.clock.now(),
            "setup_s": self.setup_s,
            "parts_s": self.clock.parts_s,
            "gaussians": dict(self.gaussians.items()),
            "optimiser": self.optimiser.state_dict(),
            "density": self.density.state_dict(),
            "mask": self.parts.mask.state_dict(),
            **({} if self.effects is None else {"effects": self.effects.state_dict()}),
            "timeline": self.timeline,
            "loss": [self._loss_sum, self._loss_count],
            "skipped": sorted(self._skipped_views),
        }
        checkpoint.save(self.checkpoint_path, state)
        write_timeline(self.folder / "timeline.csv", self.timeline)

    def resume(self) -> bool:
        """Go on from the last checkpoint, if there is one; returns whether there was."""
        if not self.checkpoint_path.exists():
            return False
        state = checkpoint.load(self.checkpoint_path)
        try:
            self.gaussians = Gaussians(**state["gaussians"]).to(self.data.device)
            self.optimiser = SplatAdam(self.gaussians, self._learning_rates(0.0))
            self.optimiser.load_state_dict(state["optimiser"])
            self.density.load_state_dict(state["density"])
            self.parts.mask.load_state_dict(state["mask"])
            if self.effects is not None:
                self.effects.load_state_dict(state["effects"])
            self.iteration = state["iteration"]
            self.setup_s = state["setup_s"]
            self.clock = Clock(state["elapsed_s"], dict(state["parts_s"]))
            self.timeline = list(state["timeline"])
            self._loss_sum, self._loss_count = state["loss"]
            self._skipped_views = set(state["skipped"])
        except (KeyError, TypeError) as error:
            raise AwError(
                f"checkpoint {self.checkpoint_path} lacks {error}; train again with --overwrite always"
            ) from None
        return True


def write_timeline(path: Path, rows: list[dict[str, Any]]) -> None:
    """timeline.csv: one line a hundredth of the run; empty cells where nothing was measured."""
    names = list(dict.fromkeys(name for row in rows for name in row))
    text = io.StringIO()
    writer = csv.DictWriter(text, names, lineterminator="\n", restval="")
    writer.writeheader()
    writer.writerows({k: "" if v is None else v for k, v in row.items()} for row in rows)
    write_text(path, text.getvalue())
