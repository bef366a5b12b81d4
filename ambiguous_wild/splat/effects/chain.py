"""The effects of a run as one object: the trainer calls it only where there is any."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch import Tensor

from ambiguous_wild.core import AwError, Camera
from ambiguous_wild.splat.effects.base import Effect, State
from ambiguous_wild.splat.gaussians import Gaussians
from ambiguous_wild.splat.losses import photometric
from ambiguous_wild.splat.rendered import Gradients, Rendered
from ambiguous_wild.splat.step import TrainData

Draw = Callable[[Gaussians, Camera], Rendered]
FIT_STEPS = 128  # WildGaussians' number for an embedding on half a test photo


class Chain:
    """Knows which effect acts where; one that does not override a hook is not called there."""

    def __init__(self, effects: Sequence[Effect], data: TrainData) -> None:
        self.effects = tuple(effects)
        self.views = len(data.photos)
        for effect in self.effects:
            effect.setup(data)
        self._camera = self._with("camera")
        self._model = self._with("model")
        self._pose = self._with("pose_backward")
        self._image = self._with("image")
        self._rows = self._with("rows_changed")
        self._step = self._with("step")
        self._fit = self._with("fit")

    def _with(self, hook: str) -> tuple[Effect, ...]:
        return tuple(e for e in self.effects if getattr(type(e), hook) is not getattr(Effect, hook))

    def camera(self, view: int, camera: Camera) -> Camera:
        """The camera of a train photo as the effects have it."""
        for effect in self._camera:
            camera = effect.camera(view, camera)
        return camera

    def model(self, gaussians: Gaussians, view: int | None, iteration: int) -> Gaussians:
        """The Gaussians as they are drawn for this view; for `None` what a viewer should be given."""
        for effect in self._model:
            changed = effect.model(gaussians, view, iteration)
            if "before_colours" in gaussians.__dict__:  # the renderer asks for postponed rows
                changed.__dict__["before_colours"] = gaussians.before_colours
            gaussians = changed
        return gaussians

    def render(
        self, gaussians: Gaussians, camera: Camera, view: int | None, iteration: int, draw: Draw
    ) -> Rendered:
        """Draw with all effects; the camera is already theirs."""
        drawn = self.model(gaussians, view, iteration)
        rendered = draw(drawn, camera)
        images = [rendered.image]
        for effect in self._image:
            images.append(effect.image(images[-1], view))
        return Drawn(self, rendered, images, drawn, camera, view)

    def step(self, view: int, progress: float, called_off: Tensor | None = None) -> None:
        """Every effect learns from the backward pass just done; see `Effect.step`."""
        for effect in self._step:
            effect.step(view, progress, called_off)

    def rows_changed(self) -> None:
        """Density control changed the set of Gaussians."""
        for effect in self._rows:
            effect.rows_changed()

    def fit_view(
        self, gaussians: Gaussians, camera: Camera, photo: Tensor, keep: Tensor, draw: Draw
    ) -> Tensor:
        """Fit the colour effects, and nothing else, to a part of a photo; the picture under that fit.

        Args:
            gaussians: the trained model; it does not change.
            camera: of the photo.
            photo: [H, W, 3] in [0, 1]; outside `keep` it is not read.
            keep: [H, W], 1 where the fit may look.
            draw: the render call.
        """
        for effect in self._fit:
            effect.begin_fit()
        for _ in range(FIT_STEPS if self._fit else 0):
            rendered = self.render(gaussians, camera, self.views, 0, draw)
            # "images" blanks both pictures outside: no window of SSIM reaches into the other half
            loss = photometric(rendered.image, photo, keep, weighting="images")
            rendered.backward(loss.d_image)
            for effect in self._fit:
                effect.fit()
        return self.render(gaussians, camera, self.views, 0, draw).image

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


class Drawn:
    """A `Rendered` whose picture went through the image effects and whose gradients go back through all."""

    def __init__(
        self,
        chain: Chain,
        rendered: Rendered,
        images: list[Tensor],
        drawn: Gaussians,
        camera: Camera,
        view: int | None,
    ) -> None:
        self.image, self.alpha = images[-1], rendered.alpha
        self.visible = rendered.visible
        self._chain, self._inner, self._images = chain, rendered, images
        self._drawn, self._camera, self._view = drawn, camera, view

    @property
    def depth(self) -> Tensor:
        return self._inner.depth

    @property
    def radii(self) -> Tensor:
        return self._inner.radii

    @torch.no_grad()
    def backward(
        self,
        d_image: Tensor,
        *,
        d_image_extra: Tensor | None = None,
        d_alpha: Tensor | None = None,
        d_depth: Tensor | None = None,
        absolute: bool = False,
    ) -> Gradients:
        """As `Rendered.backward`. Effects learn from `d_image` alone: a method's own loss on the render
        is no statement about a photo's exposure."""
        chain, view = self._chain, self._view
        for effect, image in reversed(list(zip(chain._image, self._images))):
            d_image = effect.image_backward(image, d_image, view, learn=True)
            if d_image_extra is not None:
                d_image_extra = effect.image_backward(image, d_image_extra, view, learn=False)
        gradients = self._inner.backward(
            d_image, d_image_extra=d_image_extra, d_alpha=d_alpha, d_depth=d_depth, absolute=absolute
        )
        if view is not None and view < chain.views:
            for effect in chain._pose:
                effect.pose_backward(self._drawn, self._camera, gradients, view)
        for effect in reversed(chain._model):
            gradients = effect.model_backward(gradients, view)
        return gradients
