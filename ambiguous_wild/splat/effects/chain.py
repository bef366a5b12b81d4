"""The effects of a run as one object: the trainer calls it only where there is any."""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from ambiguous_wild.core import AwError, Camera
from ambiguous_wild.splat.effects.base import Effect, State
from ambiguous_wild.splat.field import GaussianAttribute
from ambiguous_wild.splat.fields import frames_of, renders_of
from ambiguous_wild.splat.gaussians import Gaussians
from ambiguous_wild.splat.losses import photometric
from ambiguous_wild.splat.rendered import (
    NOTHING,
    Cotangents,
    FramePull,
    Gradients,
    Pull,
    Rendered,
    Shade,
    ShadeGradients,
    ShadePull,
    as_cotangents,
    frame_of,
    sum_named,
    sum_own,
    sum_where,
)
from ambiguous_wild.splat.step import Shot, Step, TrainData

Draw = Callable[[Gaussians, Shot, Shade | None], Rendered]
FIT_STEPS = 128  # WildGaussians' number for an embedding on half a test photo


class Chain:
    """Knows which effect acts where; one that does not override a hook is not called there."""

    def __init__(self, effects: Sequence[Effect], data: TrainData) -> None:
        """
        Raises:
            AwError: two effects of one name; checkpoints and results hold effects by name.
        """
        self.effects = tuple(effects)
        names = [effect.name for effect in self.effects]
        twice = sorted({name for name in names if names.count(name) > 1})
        if twice:
            raise AwError(f"effect {twice[0]} is there twice; a method lists each effect once")
        self.views = len(data.photos)
        for effect in self.effects:
            effect.setup(data)

    def _with(self, hook: str, without: Collection[str] = ()) -> tuple[Effect, ...]:
        return tuple(e for e in self.effects if e.name not in without and e.acts(hook))

    def rows(self, gaussians: Gaussians) -> dict[str, GaussianAttribute]:
        """What every Gaussian carries for the effects.

        Raises:
            AwError: two effects carry something under the same name.
        """
        found: dict[str, GaussianAttribute] = {}
        for effect in self._with("rows"):
            for name, row in effect.rows(gaussians).items():
                if name in found:
                    raise AwError(
                        f"effect {effect.name} carries {name!r} with every Gaussian, and another does too"
                    )
                found[name] = row
        return found

    def protected(self) -> Callable[[Tensor], Tensor] | None:
        """Which rows density control leaves alone, from means [N, 3]; None = no effect protected any."""
        sparing = self._with("spared")
        if not sparing:
            return None
        return lambda means: torch.stack([effect.spared(means) for effect in sparing]).any(dim=0)

    def camera(self, shot: Shot) -> Camera:
        """The camera of a train photo as the effects have it."""
        for effect in self._with("camera"):
            shot = replace(shot, camera=effect.camera(shot))
        return shot.camera

    def model(
        self, gaussians: Gaussians, shot: Shot, without: Collection[str] = ()
    ) -> tuple[Gaussians, list[Pull]]:
        """The Gaussians as they are drawn, and the pulls in the order in which the effects acted."""
        pulls = []
        for effect in self._with("model", without):
            changed, pull = effect.model(gaussians, shot)
            gaussians = changed.share_pending_updates(gaussians)
            pulls.append(pull)
        return gaussians, pulls

    def neutral_model(self, gaussians: Gaussians, iteration: int) -> Gaussians:
        """The Gaussians as they are drawn for no photo in particular; colours of nets are not in them."""
        camera = Camera(1, 1, 1.0, 1.0, 0.5, 0.5, np.eye(4))  # no effect on all rows asks for it
        shot = Shot(iteration=iteration, nominal=0.0, view=None, camera=camera)
        return self.model(gaussians, shot)[0]

    def render(self, gaussians: Gaussians, shot: Shot, draw: Draw, without: Collection[str] = ()) -> Rendered:
        """Draw with all effects but those named; the camera is already theirs."""
        drawn, model_pulls = self.model(gaussians, shot, without)
        rendered = draw(drawn, shot, self._shade(drawn, shot, without))
        frame, frame_pulls = frame_of(rendered), []
        for effect in self._with("image", without):
            frame, pull = effect.image(frame, shot)
            frame_pulls.append(pull)
        posing = () if shot.view is None else self._with("pose", without)
        return EffectRender(rendered, frame.image, frame.alpha, drawn, shot, model_pulls, frame_pulls, posing)

    def _shade(self, drawn: Gaussians, shot: Shot, without: Collection[str]) -> Shade | None:
        shading = self._with("shade", without)
        if not shading:
            return None

        def shade(base: Tensor, rows: Tensor | slice) -> tuple[Tensor, ShadePull]:
            pulls, colours = [], base
            for effect in shading:
                colours, pull = effect.shade(drawn, rows, colours, shot)
                pulls.append(pull)
            return colours, lambda d_colours: _pull_all(pulls, d_colours)

        return shade

    def step(self, gradients: Gradients, shot: Shot, called_off: Tensor | None = None) -> None:
        """Every effect learns from the backward pass just done; see `Effect.step`."""
        for effect in self._with("step"):
            own = gradients.own.get(effect.name)
            if own is not None:
                effect.step(own, shot, called_off)

    def after_step(self, step: Step, gaussians: Gaussians) -> None:
        """The end of a step; see `Effect.after_step`."""
        for effect in self._with("after_step"):
            effect.after_step(step, gaussians)

    def rows_changed(self) -> None:
        """Density control changed the set of Gaussians."""
        for effect in self._with("rows_changed"):
            effect.rows_changed()

    def fit_view(self, gaussians: Gaussians, shot: Shot, photo: Tensor, keep: Tensor, draw: Draw) -> Tensor:
        """Fit the colour effects, and nothing else, to a part of a photo; the picture under that fit.

        Args:
            gaussians: the trained model; it does not change.
            shot: of the photo, with `fitting`.
            photo: [H, W, 3] in [0, 1]; outside `keep` it is not read.
            keep: [H, W], 1 where the fit may look.
            draw: the render call.
        """
        # black where it may not be looked at, for effects that read the photo too
        photo = torch.where(keep[..., None] > 0, photo, torch.zeros_like(photo))
        shot = replace(shot, photo=photo)
        fitted = self._with("fit")
        for effect in fitted:
            effect.begin_fit()
        for _ in range(FIT_STEPS if fitted else 0):
            rendered = self.render(gaussians, shot, draw)
            # "images" blanks both pictures outside: no window of SSIM reaches into the other half
            loss = photometric(rendered.image, photo, keep, weighting="images")
            own = rendered.backward(loss.d_image).own
            for effect in fitted:
                if effect.name in own:
                    effect.fit(own[effect.name])
        return self.render(gaussians, shot, draw).image

    def fitted(self) -> dict[str, Any]:
        """What `fit_view` does to a test photo: effects that are fitted and steps, effects that read it."""
        names = [effect.name for effect in self._with("fit")]
        found: dict[str, Any] = {"effects": names, "steps": FIT_STEPS if names else 0}
        reading = [effect.name for effect in self.effects if effect.reads_photo]
        return found | ({"read_by": reading} if reading else {})

    def facts(self) -> dict[str, Any]:
        """What every effect says of itself, by its name."""
        return {effect.name: effect.facts() for effect in self.effects}

    def state_dict(self) -> State:
        return {effect.name: effect.state_dict() for effect in self.effects}

    def load_state_dict(self, state: State) -> None:
        names = [effect.name for effect in self.effects]
        if sorted(state) != sorted(names):
            raise AwError(
                f"the checkpoint has the effects {', '.join(state) or 'none'}, this run "
                f"{', '.join(names) or 'none'}; train again with --overwrite always"
            )
        for effect in self.effects:
            effect.load_state_dict(state[effect.name])


def _pull_all(pulls: Sequence[ShadePull], d_colours: Tensor) -> ShadeGradients:
    found = ShadeGradients(d_colours)
    for pull in reversed(pulls):
        one = pull(found.base)
        found = ShadeGradients(
            one.base,
            sum_named(one.extra, found.extra),
            sum_where(one.means, found.means),
            sum_own(found.own, one.own),
        )
    return found


class EffectRender:
    """A `Rendered` whose picture went through the image effects and whose gradients go back through all."""

    def __init__(
        self,
        rendered: Rendered,
        image: Tensor,
        alpha: Tensor,
        drawn: Gaussians,
        shot: Shot,
        model_pulls: Sequence[Pull],
        frame_pulls: Sequence[FramePull],
        posing: Sequence[Effect],
    ) -> None:
        """
        Args:
            rendered: by the back end.
            image, alpha: after the image effects.
            drawn: the Gaussians that the back end drew.
            shot: of the picture.
            model_pulls, frame_pulls: in the order in which the effects acted.
            posing: effects that learn from the camera's gradient.
        """
        self.image, self.alpha = image, alpha
        self.visible = rendered.visible
        self.frames, self.renders = frames_of(rendered), renders_of(rendered)
        self._inner, self._drawn, self._shot = rendered, drawn, shot
        self._model_pulls, self._frame_pulls, self._posing = model_pulls, frame_pulls, posing

    @property
    def depth(self) -> Tensor:
        return self._inner.depth

    @property
    def radii(self) -> Tensor:
        return self._inner.radii

    @torch.no_grad()
    def backward(self, cotangents: Cotangents | Tensor, needs: frozenset[str] = NOTHING) -> Gradients:
        """As `Rendered.backward`, with gradients of the effects' own parameters in `own`."""
        given = as_cotangents(cotangents)
        for frame_pull in reversed(self._frame_pulls):
            given = frame_pull(given)
        gradients = self._inner.backward(given, needs)
        for effect in self._posing:
            gradients = gradients.with_own(effect.name, effect.pose(self._drawn, gradients, self._shot))
        for pull in reversed(self._model_pulls):
            gradients = pull(gradients)
        return gradients
