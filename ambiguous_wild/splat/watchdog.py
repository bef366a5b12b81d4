"""Finds the first value of a run that is not finite, keeps what reproduces it, and undoes it where asked.

Looking is cheap: one pass over the tensors' bits, and only where a value is not finite are rows looked at.
Gradients are looked at in every step, before anything is changed; those of the higher harmonics (45 of a
Gaussian's 59 floats) are the constant's times a polynomial of a unit vector: what breaks them breaks the
constant too. Parameters are looked at every `EVERY` iterations, after growth and before every checkpoint:
no checkpoint holds a value that is not finite.

On an accelerator the host does not know the result of a step until it waits for it. So the device keeps a
flag that stays set, the number of finite steps before it, and the weights of the broken step's loss
(`Sentinel`). While the flag is set the optimiser changes nothing: when the host looks, the parameters are
still those of the broken step, and it can be computed again.
"""

from __future__ import annotations

import math
import shlex
import shutil
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal

import torch
from torch import Tensor

from ambiguous_wild.core import AwError
from ambiguous_wild.io.files import atomic_path, write_json
from ambiguous_wild.splat import checkpoint
from ambiguous_wild.splat.backend import backend_of
from ambiguous_wild.splat.gaussians import Gaussians
from ambiguous_wild.splat.losses import PhotometricLoss
from ambiguous_wild.splat.rendered import Cotangents, Gradients
from ambiguous_wild.splat.step import Step

OnNonFinite = Literal["stop", "rollback"]
FOLDER = "nonfinite"
REPORT, GOOD, STEP = "report.json", "good.safetensors", "step.safetensors"
EVERY = 50  # iterations between looks at the parameters
MOST_ROLLBACKS = 5  # a run that needs more is not worth saving
_LOOKED_AT = ("means", "quats", "log_scales", "opacity_logits", "sh0")  # of the gradients, see above


@dataclass(frozen=True)
class Finding:
    """The first value that is not finite, and where it came up."""

    what: Literal["loss", "gradient", "parameter"]
    names: tuple[str, ...]  # of the tensors it is in; empty for the loss
    rows: tuple[int, ...]  # Gaussians, the first ten
    count: int  # of such Gaussians
    iteration: int
    since: int  # the first iteration it may have come up at; earlier than `iteration` for parameters
    view: str  # file name of the photo

    def __str__(self) -> str:
        which = f" of {', '.join(self.names)} in {self.count} Gaussians" if self.names else ""
        when = f"iteration {self.iteration}"
        if self.since < self.iteration:
            when = f"one of the iterations {self.since} to {self.iteration}, the last"
        return f"{self.what}{which} is not finite at {when}, view {self.view}"


class NonFinite(AwError):
    """Training met a value that is not a finite number."""

    def __init__(self, finding: Finding, view: int, seen: Mapping[str, Any], message: str = "") -> None:
        super().__init__(message or str(finding))
        self.finding, self.view, self.seen = finding, view, seen


class Watchdog:
    """Looks at one training run. A healthy run has the same bits with and without it (a test compares)."""

    def __init__(self, folder: Path, action: OnNonFinite, seed: int, photos: list[str]) -> None:
        """
        Args:
            folder: the run's; findings go to its `nonfinite/`.
            action: what to do about a finding.
            seed: of the run, for the report.
            photos: names of the train photos.
        """
        self.folder, self.action, self.seed, self.photos = folder, action, seed, photos
        self.every = EVERY
        self.rollbacks: list[dict[str, Any]] = []

    # -- looking ----------------------------------------------------------------------------------

    def look_at_loss(self, step: Step, keep: Tensor | None, loss: PhotometricLoss) -> None:
        """Raise NonFinite if the loss of this step is not finite."""
        if not math.isfinite(float(loss.value)):
            raise self._found("loss", step.iteration, step.view, {}, _seen(step, keep, loss))

    def look_at_gradients(
        self, step: Step, keep: Tensor | None, loss: PhotometricLoss, gradients: Gradients
    ) -> None:
        """Raise NonFinite if a gradient of this step is not finite: nothing has been changed yet.

        Adam would not show it: its kernel takes a moment that is NaN for one too small to count.
        """
        named = self.looked_at(gradients)
        if not _finite(named):
            bad = _bad_rows(named)
            if bad:
                found = {f"d_{name}": named[name] for name in bad}
                raise self._found("gradient", step.iteration, step.view, bad, _seen(step, keep, loss) | found)

    def looked_at(self, gradients: Gradients) -> dict[str, Tensor]:
        """Those that are looked at in every step."""
        return {name: getattr(gradients, name) for name in _LOOKED_AT} | dict(gradients.extra)

    def not_seen_again(self, step: Step, keep: Tensor | None, loss: PhotometricLoss) -> NonFinite:
        """A finding that the step did not show when it was made again: sums come in another order there."""
        return self._found("gradient", step.iteration, step.view, {}, _seen(step, keep, loss))

    def due(self, iteration: int) -> bool:
        """Whether parameters are looked at after this iteration, whatever happened in it."""
        return iteration % self.every == 0

    def look_at_parameters(self, iteration: int, view: int, gaussians: Gaussians) -> None:
        """Raise NonFinite if a parameter is not finite: now and then, after growth, before a checkpoint."""
        named = dict(gaussians.rows())
        if not _finite(named):
            bad = _bad_rows(named)
            if bad:
                raise self._found("parameter", iteration, view, bad, {"gaussians": named})

    def _found(
        self, what: Any, iteration: int, view: int, bad: Mapping[str, Tensor], seen: Mapping[str, Any]
    ) -> NonFinite:
        rows = torch.stack(list(bad.values())).any(0).nonzero()[:, 0].tolist() if bad else []
        since = iteration - (iteration - 1) % self.every if what == "parameter" else iteration
        finding = Finding(what, tuple(bad), tuple(rows[:10]), len(rows), iteration, since, self.photos[view])
        return NonFinite(finding, view, seen)

    # -- what is done about it --------------------------------------------------------------------

    def skips(self, epoch: int, view: int) -> bool:
        """Whether this photo is left out in this epoch: what it did there was undone."""
        return any(r["epoch"] == epoch and r["view"] == view for r in self.rollbacks)

    @property
    def undoes(self) -> bool:
        """Whether the run is to roll back from a finding."""
        return self.action == "rollback" and len(self.rollbacks) < MOST_ROLLBACKS

    def note_rollback(
        self, error: NonFinite, earlier: list[dict[str, Any]], *, epoch: int, iteration: int
    ) -> None:
        """The run went back: leave the photo out for the rest of its epoch.

        Args:
            error: the finding.
            earlier: rollbacks before this one; the checkpoint may know fewer.
            epoch: of the finding.
            iteration: of the checkpoint.
        """
        back = {
            "iteration": error.finding.iteration,
            "epoch": epoch,
            "view": error.view,
            "photo": error.finding.view,
            "what": str(error),
            "to": iteration,
        }
        self.rollbacks, self.every = [*earlier, back], 1

    def final(self, error: NonFinite, where: Path) -> NonFinite:
        """The finding that ends the run, with the folder where what reproduces it was kept."""
        tried = f" after {len(self.rollbacks)} rollbacks" if self.rollbacks else ""
        folder = shlex.quote(str(self.folder))
        return NonFinite(
            error.finding,
            error.view,
            error.seen,
            f"{error}{tried}; what the step saw is in {where}, and 'aw stress --replay {folder}' runs up to "
            f"it again from the last good state; --on-nonfinite rollback leaves such a photo out and goes on",
        )

    def keep(self, good: Path, error: NonFinite) -> Path:
        """Write what reproduces a finding: report, last good checkpoint and what the step saw.

        Args:
            good: the last checkpoint; it need not exist.
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
            (where / GOOD).unlink(missing_ok=True)  # of an earlier run of this folder
        checkpoint.save(where / STEP, error.seen)
        report = asdict(error.finding) | {
            "message": str(error),
            "seed": self.seed,
            "starts_from": GOOD if good.exists() else "the beginning",
            "replay": f"aw stress --replay {shlex.quote(str(self.folder))}",
        }
        write_json(where / REPORT, report)
        return where

    # -- state ------------------------------------------------------------------------------------

    def facts(self) -> dict[str, Any]:
        """What was undone; nothing where nothing was."""
        return {"rollbacks": self.rollbacks} if self.rollbacks else {}

    def state_dict(self) -> list[dict[str, Any]]:
        return self.rollbacks

    def load_state_dict(self, rollbacks: list[dict[str, Any]]) -> None:
        self.rollbacks = list(rollbacks)
        self.every = 1 if rollbacks else EVERY


def _finite(named: Mapping[str, Tensor]) -> bool:
    tensors = list(named.values())
    return backend_of(tensors[0].device).all_finite(tensors)  # where that says no, the rows tell


def _bad_rows(tensors: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """Rows [N] bool with a value that is not finite, of the tensors that have any."""
    found = {name: ~torch.isfinite(t).reshape(len(t), -1).all(1) for name, t in tensors.items()}
    return {name: rows for name, rows in found.items() if bool(rows.any())}


def _seen(step: Step, keep: Tensor | None, loss: PhotometricLoss) -> dict[str, Any]:
    """Tensors for whoever looks into it."""
    rendered = step.rendered
    return {
        "gaussians": dict(step.gaussians.items()),
        "photo": step.photo,
        "keep": keep,
        "render": {"image": rendered.image, "alpha": rendered.alpha, "depth": rendered.depth},
        "d_image": loss.d_image,
    }


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
