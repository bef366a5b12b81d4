"""The `render` call on an NVIDIA GPU, through gsplat (extra `[cuda]`).

A picture is made in two stages with a cut between them: Gaussians to splats, splats to pixels. A second
cotangent goes back through the pixels alone; both meet at the cut and go back to the Gaussians together.
Nothing here reads a tensor's values: the host waits once a picture, in gsplat, for the number of tiles.
"""

from __future__ import annotations

from collections import OrderedDict
from dataclasses import dataclass

import torch
from torch import Tensor

from ambiguous_wild.core import Camera
from ambiguous_wild.splat import gsplat_seam as seam
from ambiguous_wild.splat.effects.posed import PosedCamera
from ambiguous_wild.splat.gaussians import SH_C0, Gaussians
from ambiguous_wild.splat.rendered import Gradients

_REMEMBERED = 8192  # cameras; a thousand photos at three sizes, and their test views


@dataclass(frozen=True)
class _OnDevice:
    """A camera as gsplat wants it."""

    viewmat: Tensor  # [1, 4, 4]
    intrinsics: Tensor  # [1, 3, 3]
    centre: Tensor  # [3]


_cameras: OrderedDict[tuple[int, torch.device], tuple[Camera, _OnDevice]] = OrderedDict()
_backgrounds: dict[tuple[tuple[float, float, float], torch.device], Tensor] = {}


class RenderedCuda:
    """Pictures of one camera and the way back to the parameters; see `render.Rendered`.

    Under `torch.no_grad` there is no way back and less to do.
    """

    def __init__(
        self,
        leaves: dict[str, Tensor],
        splats: seam.Splats,
        colours: Tensor,
        tiles: seam.Tiles,
        background: Tensor,
        size: tuple[int, int],
    ) -> None:
        """
        Args:
            leaves: raw parameters that gradients are asked for.
            splats, colours: made of them.
            tiles: of the splats.
            background: [1, 3].
            size: width and height in px.
        """
        self._leaves, self._splats, self._colours = leaves, splats, colours
        self._tiles, self._background, self._size = tiles, background, size
        self._graph = torch.is_grad_enabled()
        self._cut = self._leaves_of_the_cut()
        self._image, self._alpha, _ = self._blend(self._cut)
        self._depth: Tensor | None = None
        self.image, self.alpha = self._image.detach(), self._alpha.detach()
        self.visible, self._shown = (splats.radii > 0).all(dim=1), splats.radii

    @property
    def radii(self) -> Tensor:
        """[N] float32 px; made when it is asked for, no step does."""
        return torch.where(self.visible, self._shown.amax(dim=1), 0).to(torch.float32)

    @property
    def depth(self) -> Tensor:
        """[H, W], sum of weight times z; blended when it is first asked for."""
        if self._depth is None:
            with torch.no_grad():
                s = self._splats
                picture, _, _ = seam.blend(
                    s.means2d, s.conics, s.depths[:, None], s.opacities, self._tiles, *self._size
                )
            self._depth = picture[..., 0]
        return self._depth

    def backward(
        self,
        d_image: Tensor,
        *,
        d_image_extra: Tensor | None = None,
        d_alpha: Tensor | None = None,
        d_depth: Tensor | None = None,
        absolute: bool = False,
    ) -> Gradients:
        """As `Rendered.backward`; once.

        Raises:
            RuntimeError: the picture was drawn under `torch.no_grad`.
        """
        if not self._graph:
            raise RuntimeError("drawn under torch.no_grad: there is no way back")
        cut, image, alpha, batch = self._cut, self._image, self._alpha, None
        if absolute:
            # gsplat wants to know before it draws; who asks pays for a second drawing
            with torch.enable_grad():
                cut = self._leaves_of_the_cut()
                image, alpha, batch = self._blend(cut, absolute=True)
        found = _pull(image, alpha, cut, d_image, d_alpha, keep=d_image_extra is not None)
        screen = found[0]
        screen_abs = None if batch is None else seam.absolute_gradient(batch)
        depths = None
        if d_depth is not None:
            *through, depths = self._depth_gradients(d_depth)
            found = _add(found, [through[0], through[1], None, through[2]])
            screen = found[0]
        screen_extra = None
        if d_image_extra is not None:
            second = _pull(image, alpha, cut, d_image_extra, None, keep=False)
            screen_extra = second[0]
            found = _add(found, second)
        return Gradients(
            **self._to_parameters(found, depths),
            screen=screen,
            screen_extra=screen_extra,
            screen_abs=screen_abs,
        )

    def _leaves_of_the_cut(self) -> list[Tensor]:
        s = self._splats
        values = (s.means2d, s.conics, self._colours, s.opacities)
        return [value.detach().requires_grad_(self._graph) for value in values]

    def _blend(self, cut: list[Tensor], *, absolute: bool = False) -> tuple[Tensor, Tensor, Tensor]:
        means2d, conics, colours, opacities = cut
        return seam.blend(
            means2d, conics, colours, opacities, self._tiles, *self._size,
            background=self._background, absolute=absolute,
        )  # fmt: skip

    def _depth_gradients(self, d_depth: Tensor) -> tuple[Tensor, ...]:
        """Of means2d, conics, opacities and depths."""
        s = self._splats
        leaves = [v.detach().requires_grad_(True) for v in (s.means2d, s.conics, s.opacities, s.depths)]
        with torch.enable_grad():
            picture, _, _ = seam.blend(
                leaves[0], leaves[1], leaves[3][:, None], leaves[2], self._tiles, *self._size
            )
        return torch.autograd.grad(picture, leaves, d_depth[..., None])

    def _to_parameters(self, found: list[Tensor], depths: Tensor | None) -> dict[str, Tensor]:
        s = self._splats
        outputs, cotangents = [s.means2d, s.conics, self._colours, s.opacities], list(found)
        if depths is not None:
            outputs.append(s.depths)
            cotangents.append(depths)
        gradients = torch.autograd.grad(
            outputs, list(self._leaves.values()), cotangents, allow_unused=True, materialize_grads=True
        )
        return dict(zip(self._leaves, gradients, strict=True))


def render_cuda(
    gaussians: Gaussians,
    camera: Camera,
    *,
    sh_degree: int,
    background: tuple[float, float, float],
    antialias: bool,
) -> RenderedCuda:
    """Render on the GPU; see `render.render`.

    Raises:
        AwError: gsplat is missing or cannot be used; says the command that mends it.
    """
    seam.ready(gaussians.device.type)
    cam = on_device(camera, gaussians.device)
    graph = torch.is_grad_enabled()
    leaves = {name: tensor.detach().requires_grad_(graph) for name, tensor in gaussians.items()}
    splats = seam.project(
        leaves["means"],
        leaves["quats"],
        leaves["log_scales"].exp(),
        torch.sigmoid(leaves["opacity_logits"]),
        cam.viewmat,
        cam.intrinsics,
        camera.width,
        camera.height,
        antialias=antialias,
    )
    colours = colours_of(leaves, splats, cam.centre, min(sh_degree, gaussians.sh_degree))
    size = (camera.width, camera.height)
    tiles = seam.sort(splats, *size)
    return RenderedCuda(leaves, splats, colours, tiles, background_on(background, gaussians.device), size)


def colours_of(leaves: dict[str, Tensor], splats: seam.Splats, centre: Tensor, degree: int) -> Tensor:
    """[N, 3], max(SH + 0.5, 0)."""
    if degree == 0:
        return (leaves["sh0"] * SH_C0 + 0.5).clamp(min=0.0)
    active = leaves["sh_rest"][:, : (degree + 1) ** 2 - 1]
    coefficients = torch.cat([leaves["sh0"][:, None], active], dim=1)
    visible = (splats.radii > 0).all(dim=1)
    shade = seam.shade(degree, leaves["means"] - centre, coefficients, visible)
    return (shade + 0.5).clamp(min=0.0)


def on_device(camera: Camera, device: torch.device) -> _OnDevice:
    """The camera's matrices there, copied once: a copy from the host in every step would make it wait."""
    if isinstance(camera, PosedCamera):  # of pose refinement: another one in every step, made there
        return _OnDevice(
            camera.pose.float()[None], camera.intrinsics_there.float()[None], camera.centre.float()
        )
    key = (id(camera), device)
    if key in _cameras:
        _cameras.move_to_end(key)
        return _cameras[key][1]
    pose = torch.from_numpy(camera.cam_from_world.astype("float32"))
    found = _OnDevice(
        pose[None].to(device),
        torch.from_numpy(camera.intrinsics.astype("float32"))[None].to(device),
        torch.from_numpy(camera.center.astype("float32")).to(device),
    )
    _cameras[key] = (camera, found)  # the camera itself too: as long as it lives, its id is its own
    while len(_cameras) > _REMEMBERED:
        _cameras.popitem(last=False)
    return found


def background_on(background: tuple[float, float, float], device: torch.device) -> Tensor:
    key = (background, device)
    if key not in _backgrounds:
        _backgrounds[key] = torch.tensor([background], dtype=torch.float32).to(device)
    return _backgrounds[key]


def _pull(
    image: Tensor, alpha: Tensor, cut: list[Tensor], d_image: Tensor, d_alpha: Tensor | None, *, keep: bool
) -> list[Tensor]:
    """Gradients of what lies at the cut."""
    outputs, cotangents = [image], [d_image]
    if d_alpha is not None:
        outputs.append(alpha)
        cotangents.append(d_alpha)
    return list(torch.autograd.grad(outputs, cut, cotangents, retain_graph=keep))


def _add(a: list[Tensor], b: list[Tensor | None] | list[Tensor]) -> list[Tensor]:
    return [x if y is None else x + y for x, y in zip(a, b, strict=True)]
