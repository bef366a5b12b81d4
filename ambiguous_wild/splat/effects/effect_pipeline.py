"""The effects of a run as one object."""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from ambiguous_wild.core import AwError, Camera
from ambiguous_wild.core.config import Facts, State
from ambiguous_wild.splat.effects.base import Effect
from ambiguous_wild.splat.field import GaussianAttribute
from ambiguous_wild.splat.fields import frames_of, renders_of
from ambiguous_wild.splat.gaussians import Gaussians
from ambiguous_wild.splat.losses import photometric
from ambiguous_wild.splat.rendered import (
    NO_STATISTICS,
    Cotangents,
    FrameVjp,
    Gradients,
    Rendered,
    Shade,
    ShadeGradients,
    ShadeVjp,
    Vjp,
    as_cotangents,
    frame_of,
    sum_effect_grads,
    sum_named,
    sum_optional,
)
from ambiguous_wild.splat.step import Step, TrainData, ViewContext

Draw = Callable[[Gaussians, ViewContext, Shade | None], Rendered]
FIT_STEPS = 128  # WildGaussians' number for an embedding on half a test photo


class EffectPipeline:
    """Calls the effects in order; an effect is called only for the hooks that it overrides."""

    def __init__(self, effects: Sequence[Effect], data: TrainData) -> None:
        """
        Raises:
            AwError: two effects have the same name, by which checkpoints and results hold them.
        """
        self.effects = tuple(effects)
        names = [effect.name for effect in self.effects]
        twice = sorted({name for name in names if names.count(name) > 1})
        if twice:
            raise AwError(f"effect {twice[0]} is listed twice; a method lists each effect once")
        self.views = len(data.photos)
        for effect in self.effects:
            effect.setup(data)

    def _with(self, hook: str, without: Collection[str] = ()) -> tuple[Effect, ...]:
        return tuple(e for e in self.effects if e.name not in without and e.acts(hook))

    def rows(self, gaussians: Gaussians) -> dict[str, GaussianAttribute]:
        """Return the attributes of Gaussians that the effects need.

        Raises:
            AwError: two effects have an attribute of the same name.
        """
        attributes: dict[str, GaussianAttribute] = {}
        for effect in self._with("rows"):
            for name, row in effect.rows(gaussians).items():
                if name in attributes:
                    raise AwError(
                        f"effect {effect.name} has an attribute {name!r} of Gaussians, and so has another"
                    )
                attributes[name] = row
        return attributes

    def protected(self) -> Callable[[Tensor], Tensor] | None:
        """Return a function of means [N, 3] that tells which rows are protected; None = no effect does."""
        protecting = self._with("frozen_in_density_control")
        if not protecting:
            return None
        return lambda means: torch.stack(
            [effect.frozen_in_density_control(means) for effect in protecting]
        ).any(dim=0)

    def camera(self, context: ViewContext) -> Camera:
        """Return the camera of a train photo as the effects change it."""
        for effect in self._with("camera"):
            context = replace(context, camera=effect.camera(context))
        return context.camera

    def model(
        self, gaussians: Gaussians, context: ViewContext, without: Collection[str] = ()
    ) -> tuple[Gaussians, list[Vjp]]:
        """Return the Gaussians as they are drawn, and the vjps in the order of the effects."""
        vjps = []
        for effect in self._with("model", without):
            changed, vjp = effect.model(gaussians, context)
            gaussians = changed.share_pending_updates(gaussians)
            vjps.append(vjp)
        return gaussians, vjps

    def neutral_model(self, gaussians: Gaussians, iteration: int) -> Gaussians:
        """Return the Gaussians as they are drawn without a photo; they do not hold the colours of nets."""
        camera = Camera(1, 1, 1.0, 1.0, 0.5, 0.5, np.eye(4))  # effects on the model do not read it
        context = ViewContext(iteration=iteration, nominal=0.0, view=None, camera=camera)
        return self.model(gaussians, context)[0]

    def render(
        self, gaussians: Gaussians, context: ViewContext, draw: Draw, without: Collection[str] = ()
    ) -> Rendered:
        """Draw with all effects except those named; the effects have already changed the camera."""
        if not self.effects:
            return draw(gaussians, context, None)
        drawn, model_vjps = self.model(gaussians, context, without)
        rendered = draw(drawn, context, self._shade(drawn, context, without))
        posing = () if context.view is None else self._with("pose", without)
        return EffectRender(rendered, drawn, context, model_vjps, self._with("image", without), posing)

    def _shade(self, drawn: Gaussians, context: ViewContext, without: Collection[str]) -> Shade | None:
        shading = self._with("shade", without)
        if not shading:
            return None

        def shade(base: Tensor, rows: Tensor | slice) -> tuple[Tensor, ShadeVjp]:
            vjps, colours = [], base
            for effect in shading:
                colours, vjp = effect.shade(drawn, rows, colours, context)
                vjps.append(vjp)
            return colours, lambda d_colours: _vjp_all(vjps, d_colours)

        return shade

    def step(self, gradients: Gradients, context: ViewContext, skip_step: Tensor | None = None) -> None:
        """Let every effect learn from the last backward pass; see `Effect.step`."""
        for effect in self._with("step"):
            effect_grads = gradients.effect_grads.get(effect.name)
            if effect_grads is not None:
                effect.step(effect_grads, context, skip_step)

    def after_step(self, step: Step, gaussians: Gaussians) -> None:
        """Call the effects at the end of a step; see `Effect.after_step`."""
        for effect in self._with("after_step"):
            effect.after_step(step, gaussians)

    def rows_changed(self) -> None:
        """Tell the effects that density control changed the set of Gaussians."""
        for effect in self._with("rows_changed"):
            effect.rows_changed()

    def fit_view(
        self, gaussians: Gaussians, context: ViewContext, photo: Tensor, keep: Tensor, draw: Draw
    ) -> Tensor:
        """Fit only the colour effects to a part of a photo; returns the picture [H, W, 3] after the fit.

        Args:
            gaussians: the trained model; it does not change.
            context: view context of the photo, with `fitting`.
            photo: [H, W, 3] in [0, 1]; it is not read outside of `keep`.
            keep: [H, W], 1 where the fit may read the photo.
            draw: the render call.
        """
        # black where the fit must not read it, also for effects that read the photo
        photo = torch.where(keep[..., None] > 0, photo, torch.zeros_like(photo))
        context = replace(context, photo=photo)
        fitted = self._with("fit")
        if not fitted:
            return self.render(gaussians, context, draw).image
        for effect in fitted:
            effect.begin_fit()
        redraw = any(effect.acts(hook) for effect in fitted for hook in ("model", "shade"))
        rendered = self.render(gaussians, context, draw)
        for _ in range(FIT_STEPS):
            assert isinstance(rendered, EffectRender)  # there are effects
            # "images" blanks both pictures outside of `keep`, so no window of SSIM reaches the other half
            loss = photometric(rendered.image, photo, keep, weighting="images")
            through = rendered.backward if redraw else rendered.through_image_effects
            effect_grads = through(loss.d_image).effect_grads
            for effect in fitted:
                if effect.name in effect_grads:
                    effect.fit(effect_grads[effect.name])
            if redraw:
                rendered = self.render(gaussians, context, draw)
            else:
                rendered.act_on_image()
        return rendered.image

    def fitted(self) -> Facts:
        """Return the effects that `fit_view` fits to a test photo, its steps, and effects that read it."""
        names = [effect.name for effect in self._with("fit")]
        fit: Facts = {"effects": names, "steps": FIT_STEPS if names else 0}
        reading = [effect.name for effect in self.effects if effect.reads_photo]
        return {**fit, "read_by": reading} if reading else fit

    def facts(self) -> Facts:
        """Return the facts of every effect by its name."""
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


def _vjp_all(vjps: Sequence[ShadeVjp], d_colours: Tensor) -> ShadeGradients:
    total = ShadeGradients(d_colours)
    for vjp in reversed(vjps):
        one = vjp(total.base)
        total = ShadeGradients(
            one.base,
            sum_named(one.attributes, total.attributes),
            sum_optional(one.means, total.means),
            sum_effect_grads(total.effect_grads, one.effect_grads),
        )
    return total


class EffectRender:
    """A `Rendered` after the image effects; its backward pass goes through all effects."""

    def __init__(
        self,
        rendered: Rendered,
        drawn: Gaussians,
        context: ViewContext,
        model_vjps: Sequence[Vjp],
        toning: Sequence[Effect],
        posing: Sequence[Effect],
    ) -> None:
        """
        Args:
            rendered: render of the back end.
            drawn: Gaussians that the back end drew.
            context: view context of the picture.
            model_vjps: vjps in the order in which the effects acted.
            toning: effects that act on the picture.
            posing: effects that learn from the camera's gradient.
        """
        self.visible = rendered.visible
        self.frames, self.renders = frames_of(rendered), renders_of(rendered)
        self._inner, self._drawn, self._context = rendered, drawn, context
        self._model_vjps, self._toning, self._posing = model_vjps, toning, posing
        self.act_on_image()

    def act_on_image(self) -> None:
        """Let the image effects act on the back end's picture, with the values that they have now."""
        frame = frame_of(self._inner)
        self._frame_vjps: list[FrameVjp] = []
        for effect in self._toning:
            frame, vjp = effect.image(frame, self._context)
            self._frame_vjps.append(vjp)
        self.image, self.alpha = frame.image, frame.alpha

    def through_image_effects(self, cotangents: Cotangents | Tensor) -> Cotangents:
        """Return the cotangents of the back end's pictures."""
        passed = as_cotangents(cotangents)
        for frame_vjp in reversed(self._frame_vjps):
            passed = frame_vjp(passed)
        return passed

    @property
    def depth(self) -> Tensor:
        return self._inner.depth

    @property
    def radii(self) -> Tensor:
        return self._inner.radii

    @torch.no_grad()
    def backward(self, cotangents: Cotangents | Tensor, needs: frozenset[str] = NO_STATISTICS) -> Gradients:
        """Do as `Rendered.backward`; gradients of the effects' own parameters are in `effect_grads`."""
        gradients = self._inner.backward(self.through_image_effects(cotangents), needs)
        for effect in self._posing:
            gradients = gradients.with_effect_grads(
                effect.name, effect.pose(self._drawn, gradients, self._context)
            )
        for vjp in reversed(self._model_vjps):
            gradients = vjp(gradients)
        return gradients
