"""Finds the first value of a run that is not finite, stores what reproduces it, and rolls back if asked to.

The checks are cheap: one pass over the bits of the tensors; rows are searched only if a value is not finite.
Gradients are checked in every step, before anything changes. Those of the higher harmonics (45 of a
Gaussian's 59 floats) are not: they are the constant's times a polynomial of a unit vector, so what breaks
them breaks the constant too. Parameters are checked every `EVERY` iterations, after growth and before every
checkpoint, which checks other fields too: no checkpoint holds Gaussians that are not finite. Of effects only
the gradients are checked.

On an accelerator the host does not know the result of a step until it waits for it. So the device keeps a
flag that stays set, the number of finite steps before it, and the keep map and cotangents of the broken step
(`DeviceFiniteCheck`). While the flag is set the optimiser changes nothing: when the host reads it, the
parameters are still those of the broken step, which can be computed again.
"""

from __future__ import annotations

import math
import shlex
import shutil
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Literal

import torch
import torch.nn.functional as F
from torch import Tensor

from ambiguous_wild.core import AwError
from ambiguous_wild.core.config import Facts, State
from ambiguous_wild.io.files import atomic_path, write_json
from ambiguous_wild.splat import checkpoint
from ambiguous_wild.splat.backend import backend_of
from ambiguous_wild.splat.gaussians import Gaussians
from ambiguous_wild.splat.losses import PhotometricLoss
from ambiguous_wild.splat.rendered import Cotangents, Gradients
from ambiguous_wild.splat.step import Step
from ambiguous_wild.splat.train_config import OnNonFinite

Kind = Literal["loss", "gradient", "parameter"]
FOLDER = "nonfinite"
REPORT, GOOD, STEP = "report.json", "good.safetensors", "step.safetensors"
EVERY = 50  # iterations between checks of the parameters
MAX_ROLLBACKS = 5  # a run that needs more is stopped
_CHECKED = ("means", "quats", "log_scales", "opacity_logits", "sh0")  # gradients that are checked


@dataclass(frozen=True)
class NonFiniteFinding:
    """The first value that is not finite, and where it occurred."""

    what: Kind
    names: tuple[str, ...]  # tensors that hold it; empty for the loss
    rows: tuple[int, ...]  # the first ten static Gaussians with such a value
    count: int  # number of these Gaussians
    iteration: int
    since: int  # first iteration that may have caused it; before `iteration` for parameters
    view: str  # file name of the photo

    def __str__(self) -> str:
        which = f" of {', '.join(self.names)}" if self.names else ""
        which += f" in {self.count} Gaussians" if self.count else ""
        when = f"iteration {self.iteration}"
        if self.since < self.iteration:
            when = f"one of the iterations {self.since} to {self.iteration}, the last"
        return f"{self.what}{which} is not finite at {when}, view {self.view}"


class NonFinite(AwError):
    """Training met a value that is not a finite number; `tensors` holds those of the step."""

    def __init__(self, finding: NonFiniteFinding, view: int, tensors: State, message: str = "") -> None:
        super().__init__(message or str(finding))
        self.finding, self.view, self.tensors = finding, view, tensors


class Watchdog:
    """Checks one training run. A healthy run has the same bits with and without it (a test compares)."""

    def __init__(self, folder: Path, action: OnNonFinite, seed: int, photos: list[str]) -> None:
        """
        Args:
            folder: folder of the run; findings are stored in its `nonfinite/`.
            action: what to do about a finding.
            seed: seed of the run, for the report.
            photos: names of the train photos.
        """
        self.folder, self.action, self.seed, self.photos = folder, action, seed, photos
        self.every = EVERY
        self.rollbacks: list[Facts] = []

    # -- looking ----------------------------------------------------------------------------------

    def check_loss(self, step: Step, keep: Tensor | None, loss: PhotometricLoss) -> None:
        """Raise NonFinite if the loss of this step is not finite."""
        if not math.isfinite(float(loss.value)):
            raise self._finding("loss", step.iteration, step.view, {}, _seen(step, keep, loss))

    def check_gradients(
        self, step: Step, keep: Tensor | None, loss: PhotometricLoss, gradients: Gradients
    ) -> None:
        """Raise NonFinite if a gradient of this step is not finite: nothing has been changed yet.

        Adam would hide it: its kernel sets a moment that is NaN to 0, like one that is too small.
        """
        named = _of_gaussians(gradients)
        bad = {} if _finite(named) else _bad_rows(named)
        others = [name for name, d in _of_others(gradients) if not bool(torch.isfinite(d).all())]
        if bad or others:
            seen = _seen(step, keep, loss) | {f"d_{name}": named[name] for name in bad}
            raise self._finding("gradient", step.iteration, step.view, bad, seen, others)

    def checked_gradients(self, gradients: Gradients) -> list[Tensor]:
        """Return the gradients that are checked in every step."""
        return [*_of_gaussians(gradients).values(), *(d for _, d in _of_others(gradients))]

    def nonreproducible(self, step: Step, keep: Tensor | None, loss: PhotometricLoss) -> NonFinite:
        """Return the finding of a step that is finite when repeated: a GPU sums in another order."""
        return self._finding("gradient", step.iteration, step.view, {}, _seen(step, keep, loss))

    def due(self, iteration: int) -> bool:
        """Whether parameters are checked after this iteration in any case."""
        return iteration % self.every == 0

    def check_parameters(self, iteration: int, view: int, gaussians: Gaussians) -> None:
        """Raise NonFinite if a parameter is not finite."""
        named = dict(gaussians.named_tensors())
        if not _finite(named):
            bad = _bad_rows(named)
            if bad:
                raise self._finding("parameter", iteration, view, bad, {"gaussians": named})

    def _finding(
        self,
        what: Kind,
        iteration: int,
        view: int,
        bad: Mapping[str, Tensor],
        seen: State,
        others: Sequence[str] = (),  # names of tensors that are not of the static Gaussians
    ) -> NonFinite:
        rows = torch.stack(list(bad.values())).any(0).nonzero()[:, 0].tolist() if bad else []
        since = iteration - (iteration - 1) % self.every if what == "parameter" else iteration
        finding = NonFiniteFinding(
            what, (*bad, *others), tuple(rows[:10]), len(rows), iteration, since, self.photos[view]
        )
        return NonFinite(finding, view, seen)

    # -- what is done about it --------------------------------------------------------------------

    def skips(self, epoch: int, view: int) -> bool:
        """Whether this photo is left out in this epoch, because a step with it was rolled back."""
        return any(r["epoch"] == epoch and r["view"] == view for r in self.rollbacks)

    @property
    def rolls_back(self) -> bool:
        """Whether the run rolls back after a finding."""
        return self.action == "rollback" and len(self.rollbacks) < MAX_ROLLBACKS

    def note_rollback(self, error: NonFinite, earlier: list[Facts], *, epoch: int, iteration: int) -> None:
        """Note that the run was rolled back: the photo is left out for the rest of its epoch.

        Args:
            error: the finding.
            earlier: rollbacks before this one; the checkpoint may hold fewer.
            epoch: epoch of the finding.
            iteration: iteration of the checkpoint.
        """
        rollback: Facts = {
            "iteration": error.finding.iteration,
            "epoch": epoch,
            "view": error.view,
            "photo": error.finding.view,
            "what": str(error),
            "to": iteration,
        }
        self.rollbacks, self.every = [*earlier, rollback], 1

    def final_error(self, error: NonFinite, where: Path) -> NonFinite:
        """Return the error that ends the run, with the folder that holds what reproduces it."""
        after = f" after {len(self.rollbacks)} rollbacks" if self.rollbacks else ""
        folder = shlex.quote(str(self.folder))
        return NonFinite(
            error.finding,
            error.view,
            error.tensors,
            f"{error}{after}; what the step saw is in {where}, and 'aw stress --replay {folder}' runs up to "
            "it again from the last good state; --set train.on_nonfinite=rollback leaves such a photo out "
            "and goes on",
        )

    def snapshot(self, good: Path, error: NonFinite) -> Path:
        """Store what reproduces a finding: a report, the last good checkpoint and what the step saw.

        Args:
            good: path of the last checkpoint, which need not exist.
            error: the finding.

        Returns:
            The folder.
        """
        where = self.folder / FOLDER / f"{error.finding.iteration:06d}"
        where.mkdir(parents=True, exist_ok=True)
        if good.exists():
            with atomic_path(where / GOOD) as temporary:
                shutil.copyfile(good, temporary)
        else:
            (where / GOOD).unlink(missing_ok=True)  # left by an earlier run in this folder
        checkpoint.save(where / STEP, error.tensors)
        report = asdict(error.finding) | {
            "message": str(error),
            "seed": self.seed,
            "starts_from": GOOD if good.exists() else "the beginning",
            "replay": f"aw stress --replay {shlex.quote(str(self.folder))}",
        }
        write_json(where / REPORT, report)
        return where

    # -- state ------------------------------------------------------------------------------------

    def facts(self) -> Facts:
        """Return the rollbacks for the run's results; empty if there were none."""
        return {"rollbacks": self.rollbacks} if self.rollbacks else {}

    def state_dict(self) -> list[Facts]:
        return self.rollbacks

    def load_state_dict(self, rollbacks: list[Facts]) -> None:
        self.rollbacks = list(rollbacks)
        self.every = 1 if rollbacks else EVERY


def _of_gaussians(gradients: Gradients) -> dict[str, Tensor]:
    return {name: getattr(gradients, name) for name in _CHECKED} | dict(gradients.attributes)


def _of_others(gradients: Gradients) -> list[tuple[str, Tensor]]:
    """Return the gradients of effects, as `effect.leaf`, and of other fields, as `field.means`."""
    fields = ((name, _of_gaussians(g)) for name, g in gradients.fields.items())
    groups = [*gradients.effect_grads.items(), *fields]
    return [(f"{group}.{name}", d) for group, named in groups for name, d in named.items()]


def _finite(named: Mapping[str, Tensor]) -> bool:
    tensors = list(named.values())
    return backend_of(tensors[0].device).all_finite(tensors)  # it may say no by mistake; then the rows decide


def _bad_rows(tensors: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """Return the rows [N] bool with a value that is not finite, of each tensor that has any."""
    by_tensor = {name: ~torch.isfinite(t).reshape(len(t), -1).all(1) for name, t in tensors.items()}
    return {name: rows for name, rows in by_tensor.items() if bool(rows.any())}


def _seen(step: Step, keep: Tensor | None, loss: PhotometricLoss) -> State:
    """Return the tensors of a step, which help to find the cause."""
    rendered = step.rendered
    return {
        "gaussians": dict(step.gaussians.items()),
        "photo": step.photo,
        "keep": keep,
        "render": {"image": rendered.image, "alpha": rendered.alpha, "depth": rendered.depth},
        "d_image": loss.d_image,
    }


@dataclass(frozen=True)
class NonFiniteStep:
    """A step with values that are not finite, and what its loss used."""

    iteration: int
    keep: Tensor | None
    method_cotangents: Cotangents | None  # cotangents of the method's own losses on the render


class DeviceFiniteCheck:
    """The checks of a training run on an accelerator, which do not make the host wait."""

    def __init__(self, device: torch.device, views: int) -> None:
        """
        Args:
            device: device of the run.
            views: number of train photos.
        """
        self._broken = torch.zeros(1, device=device)
        self._sound = torch.zeros(1, device=device)  # finite steps since the last look
        self._empty = torch.zeros(views, device=device)  # number of steps in which a photo was fully masked
        self._one = torch.ones(1, device=device)
        # steps since the last look: iteration, and shapes of what `_kept` holds of them
        self._watched: list[tuple[int, dict[str, torch.Size]]] = []
        # Keep map and method cotangents of the latest step, or of the broken one, flat and as large as the
        # largest so far: a policy that learns would return others when the step is repeated.
        self._kept: dict[str, Tensor] = {}

    def watch(
        self,
        iteration: int,
        view: int,
        loss: Tensor,
        gradients: Sequence[Tensor],
        keep: Tensor | None,
        method_cotangents: Cotangents | Tensor | None = None,
    ) -> Tensor:
        """Check one step.

        Args:
            iteration: iteration of the run.
            view: index of the step's photo.
            loss: 0-d.
            gradients: float32; they are not changed.
            keep: keep map of the loss, or None.
            method_cotangents: those of the method's own losses on the render, or None.

        Returns:
            [1] float32, 1 = the optimiser must change nothing: a value is not finite in this step or in one
            since the last look; or the photo is fully masked, and momentum alone would drift away from the
            scene.
        """
        inputs = _named(keep, method_cotangents)
        self._watched.append((iteration, {name: value.shape for name, value in inputs.items()}))
        before = self._broken.clone()
        # torch's check for mixed precision: one launch for all tensors, which are divided by 1
        torch._amp_foreach_non_finite_check_and_unscale_(
            [loss.detach().reshape(1), *(g.detach() for g in gradients)], self._broken, self._one
        )
        self._remember(before, inputs)
        nothing = None if keep is None else (keep.amax() <= 0).to(torch.float32).reshape(1)
        if nothing is not None:
            self._empty[view : view + 1] += nothing
        self._sound += 1.0 - self._broken
        return self._broken.clone() if nothing is None else torch.maximum(self._broken, nothing)

    def _remember(self, before: Tensor, inputs: Mapping[str, Tensor]) -> None:
        """Copy the inputs of the step's loss, unless an earlier step was broken."""
        for name, value in inputs.items():
            flat = value.detach().reshape(-1)
            kept = self._kept.get(name)
            if kept is None:
                kept = self._kept[name] = torch.zeros_like(flat)
            elif len(kept) < len(flat):
                kept = self._kept[name] = F.pad(kept, (0, len(flat) - len(kept)))
            kept[: len(flat)] = torch.where(before > 0, kept[: len(flat)], flat)

    def first_broken(self) -> NonFiniteStep | None:
        """Return the first step since the last look with a value that was not finite. The host waits."""
        broken, sound = torch.cat([self._broken, self._sound]).tolist()
        watched, self._watched = self._watched, []
        self._sound.zero_()
        if not broken:
            return None
        iteration, shapes = watched[int(sound)]
        inputs = {name: self._kept[name][: shape.numel()].reshape(shape) for name, shape in shapes.items()}
        keep = inputs.pop("keep", None)
        return NonFiniteStep(iteration, keep, Cotangents(**inputs, effect_grads={}) if inputs else None)

    def empty_views(self) -> set[int]:
        """Return the photos that were fully masked at some step. The host waits."""
        return {view for view, times in enumerate(self._empty.tolist()) if times}

    def reset(self) -> None:
        """Forget the steps since the last look; called after a checkpoint was loaded."""
        for tensor in (self._broken, self._sound):
            tensor.zero_()
        self._watched = []


def _named(keep: Tensor | None, method_cotangents: Cotangents | Tensor | None) -> dict[str, Tensor]:
    """Return those that are not None, by the names of `NonFiniteStep` and `Cotangents`."""
    if isinstance(method_cotangents, Tensor):
        method_cotangents = Cotangents(extra=method_cotangents)
    c = method_cotangents or Cotangents()
    named = {"keep": keep, "image": c.image, "extra": c.extra, "alpha": c.alpha, "depth": c.depth}
    return {name: value for name, value in named.items() if value is not None}
