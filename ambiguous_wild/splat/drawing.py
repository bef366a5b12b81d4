"""Rendering with a run's effects, fields, SH degree, background and filter."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import replace

import torch
from torch import Tensor

from ambiguous_wild.core import AwError
from ambiguous_wild.core.config import State
from ambiguous_wild.splat.effects.effect_pipeline import EffectPipeline
from ambiguous_wild.splat.field import Field
from ambiguous_wild.splat.fields import STATIC, Composite, FieldStart, renders_of
from ambiguous_wild.splat.gaussians import PARAMETERS, Gaussians
from ambiguous_wild.splat.method_hooks import MethodHooks
from ambiguous_wild.splat.render import render
from ambiguous_wild.splat.rendered import Gradients, Rendered, Shade, check_needs, with_visible
from ambiguous_wild.splat.step import Step, TrainData, ViewContext


class SceneRenderer:
    """Draws the pictures of one run, and holds its fields beside the static one."""

    def __init__(self, data: TrainData, hooks: MethodHooks, static: Field, effects: EffectPipeline) -> None:
        """
        Args:
            data: the training side.
            hooks: the method.
            static: the first field.
            effects: the run's effects.

        Raises:
            AwError: a field has the name of the static one.
        """
        self.hooks, self.effects, self.static = hooks, effects, static
        self.others: dict[str, Field] = {}
        self._most: dict[str, int | None] = {}
        if hooks.fields is not None:
            for name, start in hooks.fields.setup(data, static.gaussians, self._static_rates).items():
                self._add(name, start, data)

    def _static_rates(self, progress: float) -> dict[str, float]:
        """Return the learning rates of the static field's parameters, without those of attributes."""
        rates = self.static.rates(progress)
        return {name: rates[name] for name in PARAMETERS}

    def _add(self, name: str, start: FieldStart, data: TrainData) -> None:
        if name == STATIC:
            raise AwError(f"a field beside the static one cannot be called {STATIC!r}")
        self.others[name] = Field(start.gaussians, start.rates, start.density)
        self._most[name] = start.most
        if start.density is not None:
            check_needs(start.density.needs, data.backend.statistics)
            start.density.setup(data)
            start.density.protected = self.effects.protected()

    # -- pictures ---------------------------------------------------------------------------------

    def __call__(self, gaussians: Gaussians, context: ViewContext, without: Collection[str] = ()) -> Rendered:
        """Draw the model; effects have already changed the view context's camera."""
        return self.effects.render(gaussians, context, self._compose, without)

    def draw_again(
        self, gaussians: Gaussians, context: ViewContext, without: Collection[str] = ()
    ) -> Rendered:
        """Draw another picture of a step, see `Step.draw`."""
        if gaussians is self.static.gaussians:
            return self(gaussians, context, without)
        context = replace(context, other_gaussians=True)
        return self.effects.render(gaussians, context, self._draw, without)

    def fit(self, gaussians: Gaussians, context: ViewContext, photo: Tensor, keep: Tensor) -> Tensor:
        """Draw a picture in the colours of its photo, see `EffectPipeline.fit_view`."""
        return self.effects.fit_view(gaussians, context, photo, keep, self._draw)

    def _draw(
        self, gaussians: Gaussians, context: ViewContext, shade: Shade | None, *, layer: bool = False
    ) -> Rendered:
        hooks = self.hooks
        return render(
            gaussians,
            context.camera,
            sh_degree=min(
                int(context.nominal // hooks.schedule.sh_every), hooks.sh_degree, gaussians.sh_degree
            ),
            background=(0.0, 0.0, 0.0) if layer else hooks.background,
            antialias=hooks.antialias,
            blur=hooks.blur,
            shade=shade,
        )

    def _compose(self, gaussians: Gaussians, context: ViewContext, shade: Shade | None) -> Rendered:
        rendered = self._draw(gaussians, context, shade)
        fields = self.hooks.fields
        if fields is None or context.view is None:
            return rendered
        names = fields.drawn(context)
        deformed = {name: fields.deform(name, self.others[name].gaussians, context) for name in names}
        drawn = {
            name: self._draw(
                own.share_pending_updates(self.others[name].gaussians), context, None, layer=fields.layers
            )
            for name, (own, _) in deformed.items()
        }
        vjps = {name: vjp for name, (_, vjp) in deformed.items()}
        needs = {name: control.needs for name in drawn if (control := self.others[name].density) is not None}
        return Composite(fields, {STATIC: rendered, **drawn}, needs, context, vjps)

    # -- the other fields -------------------------------------------------------------------------

    def with_other_pictures(self, step: Step, keep: Tensor | None, gradients: Gradients) -> Gradients:
        """Add the gradients of pictures that the fields drew themselves to the step's gradients."""
        if self.hooks.fields is None:
            return gradients
        more = dict(self.hooks.fields.gradients(step, keep))
        static = more.pop(STATIC, None)
        if static is not None:
            gradients = gradients + static
        present = gradients.fields
        summed = {name: present[name] + g if name in present else g for name, g in more.items()}
        return replace(gradients, fields={**present, **summed})

    def learn(
        self, step: Step, gradients: Mapping[str, Gradients], progress: float, skip_step: Tensor | None
    ) -> None:
        """Run the optimiser and density control of every other field that has gradients."""
        for name, own in gradients.items():
            field = self.others[name]
            most = self._most[name]
            if skip_step is not None and own.visible is not None:
                own = replace(own, visible=own.visible & (skip_step == 0))
            # density control takes the visible rows from the field's own render
            rendered = renders_of(step.rendered).get(name, step.rendered)
            if own.visible is not None and rendered is not step.rendered:
                rendered = with_visible(rendered, own.visible)
            seen = replace(
                step,
                gaussians=field.gaussians,
                growth_cap=step.growth_cap if most is None else most,
                rendered=rendered,
            )
            field.learn(own, progress, skip_step)
            field.refine(seen, own, None)

    def state_dict(self) -> State:
        """Return the state of the other fields by name; empty if there are none."""
        return {name: field.state_dict() for name, field in self.others.items()}

    def load_state_dict(self, state: State, device: torch.device) -> None:
        """Restore what `state_dict` returned.

        Raises:
            KeyError: the state lacks a field.
        """
        for name, field in self.others.items():
            field.load_state_dict(state[name], device)
