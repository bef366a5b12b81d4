"""Watch a training in a browser: renders, masks, the loss; pause and step. Needs viser (extra [view]).

Everything is drawn in `tick`, between two steps and in the trainer's thread; the browser's callbacks only set
requests. Drawing changes nothing: the run ends with the same bits, which a test compares.
"""

from __future__ import annotations

import html
import math
import threading
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ambiguous_wild.core import AwError, Camera
from ambiguous_wild.core.camera import pose_at, rotation_from_quat
from ambiguous_wild.core.errors import install_command
from ambiguous_wild.io.images import read_png_rgb, to_uint8
from ambiguous_wild.io.page_parts import narrowed
from ambiguous_wild.io.palette import MASKED, tint
from ambiguous_wild.viewing.model import space_of

if TYPE_CHECKING:
    from ambiguous_wild.splat.trainer import Trainer

_WIDTH = 480  # px of a picture that is sent
_WAIT_S = 0.1  # between checks for requests while paused
_POINTS = 20_000  # largest number of points of the sparse model
_ROWS = 2000  # largest number of points of the loss curve


class LiveView:
    """A server that shows one training after the other; `tick` is called after every iteration."""

    def __init__(self, host: str, port: int, *, paused: bool = False, every: int = 25) -> None:
        """
        Args:
            host: address to listen on; 127.0.0.1 = this machine alone.
            port: 0 = any free one.
            paused: pause after the first step.
            every: iterations between pictures.

        Raises:
            AwError: viser is missing, or the port is taken.
        """
        try:
            import viser
        except ImportError:
            raise AwError(f"a live view needs viser: {install_command('view')}") from None
        self._viser: Any = viser
        self.port = _free_port(host, port)
        self._server = self._viser.ViserServer(
            host=host, port=self.port, label="aw view --live", verbose=False
        )
        self._lock = threading.Lock()
        self._woken = threading.Condition(self._lock)
        self._paused, self._steps, self._stale = paused, 0, True
        self._every = every
        self._trainer: Trainer | None = None
        self._losses: list[tuple[int, float]] = []
        self._controls()

    # -- requests of the user; called in viser's threads --------------------------------------------

    def _controls(self) -> None:
        gui = self._server.gui
        self._status = gui.add_markdown("waiting for the first step")
        self._pause = gui.add_button("Resume" if self._paused else "Pause")
        self._step = gui.add_button("Step", disabled=not self._paused)
        self._pause.on_click(lambda _: self.pause(not self._paused))
        self._step.on_click(lambda _: self.step())
        self._camera = gui.add_dropdown("Camera", ("-",))
        self._camera.on_update(lambda _: self._ask())
        self._interval = gui.add_slider(
            "Iterations a picture", min=1, max=500, step=1, initial_value=self._every
        )
        self._images = {
            name: gui.add_image(np.zeros((2, 2, 3), np.uint8), label=name)
            for name in ("render", "photo and mask")
        }
        plot = self._viser.uplot
        self._plot = gui.add_uplot(
            data=(np.array([0.0, 1.0]), np.array([0.0, 0.0])),
            series=(plot.Series(label="iteration"), plot.Series(label="loss", stroke="#e4572e", width=2)),
            scales={"x": plot.Scale(time=False)},
            title="loss",
            aspect=2.0,
        )
        self._server.on_client_connect(self._connected)

    def _connected(self, client: Any) -> None:
        client.camera.on_update(lambda _: self._ask())
        self._ask()

    def pause(self, on: bool) -> None:
        """Pause after the current step, or continue."""
        with self._woken:
            self._paused = on
            self._woken.notify_all()
        self._pause.label = "Resume" if on else "Pause"
        self._step.disabled = not on

    def step(self) -> None:
        """Make one more step while paused."""
        with self._woken:
            self._steps += 1
            self._woken.notify_all()

    def _ask(self) -> None:
        with self._woken:
            self._stale = True
            self._woken.notify_all()

    # -- called in the trainer's thread ------------------------------------------------------------

    def tick(self, trainer: Trainer) -> None:
        """Show the present model if a picture is due; wait while paused."""
        if trainer is not self._trainer:
            self._begin(trainer)
        timeline = trainer.timeline
        due = trainer.iteration % int(self._interval.value) == 0 or trainer.iteration <= 1 or trainer.done
        if due or self._paused:
            if timeline.loss_count:
                self._losses.append((trainer.iteration, float(timeline.loss_sum) / timeline.loss_count))
            self._draw(trainer)
        while True:
            with self._woken:
                if not self._paused or trainer.done:
                    return
                if self._steps:
                    self._steps -= 1
                    return
                if not self._stale:
                    self._woken.wait(_WAIT_S)
                stale = self._stale
            if stale:
                self._draw(trainer)

    def end(self, text: str) -> None:
        """Show how the run ended."""
        self._status.content = html.escape(text)

    def stop(self) -> None:
        """Close the server."""
        self.pause(False)
        self._server.stop()

    def _begin(self, trainer: Trainer) -> None:
        """Show cameras and sparse points of the run's scene."""
        self._trainer, self._losses = trainer, []
        scene = trainer.data.scene
        self._views = {f"{v.split}: {v.name}": v for v in (*scene.test, *scene.train)}
        self._train = {v.name: index for index, v in enumerate(scene.train)}
        space = space_of(scene)
        place = self._server.scene
        place.reset()
        place.set_up_direction(tuple(space.up))
        points = scene.points
        if len(points):
            rows = np.linspace(0, len(points) - 1, min(len(points), _POINTS)).astype(int)
            size = 0.004 * space.extent
            place.add_point_cloud(
                "/points", points.xyz[rows], points.rgb[rows], point_size=size, visible=False
            )
        for number, (label, view) in enumerate(self._views.items()):
            self._frustum(f"/cameras/{number}", label, view.camera, 0.06 * space.extent)
        self._camera.options = tuple(self._views) or ("-",)
        for client in self._server.get_clients().values():
            client.camera.look_at = tuple(space.middle)

    def _frustum(self, name: str, label: str, camera: Camera, scale: float) -> None:
        turned = self._viser.transforms.SO3.from_matrix(camera.cam_from_world[:3, :3].T)
        handle = self._server.scene.add_camera_frustum(
            name,
            fov=2 * math.atan(camera.height / 2 / camera.fy),
            aspect=camera.width / camera.height,
            scale=scale,
            color=(255, 166, 64) if label.startswith("test") else (88, 166, 255),
            wxyz=turned.wxyz,
            position=camera.center,
        )

        @handle.on_click
        def _(_: Any) -> None:
            self._camera.value = label

    def _draw(self, trainer: Trainer) -> None:
        with self._lock:
            self._stale = False
        spent = dict(trainer.clock.parts_s)
        view = self._views.get(str(self._camera.value))
        if view is not None:
            self._images["render"].image = narrowed(self._picture(trainer, view.camera), _WIDTH)
            self._images["photo and mask"].image = narrowed(
                self._photo(trainer, view.name, view.image_path), _WIDTH
            )
        for client in self._server.get_clients().values():
            camera = _camera_of(client.camera)
            if camera is not None:
                client.scene.set_background_image(self._picture(trainer, camera), format="jpeg")
        trainer.clock.parts_s = spent  # time for viewing does not count as training
        rows = self._losses[:: max(1, len(self._losses) // _ROWS)]
        if len(rows) > 1:
            self._plot.data = tuple(np.array(column, np.float64) for column in zip(*rows))
        loss = f", loss {self._losses[-1][1]:.4f}" if self._losses else ""
        self._status.content = (
            f"iteration {trainer.iteration} ({100 * trainer.progress(trainer.iteration):.0f} %), "
            f"{len(trainer.gaussians):,} Gaussians{loss}{', paused' if self._paused else ''}"
        )

    def _picture(self, trainer: Trainer, camera: Camera) -> np.ndarray:
        return to_uint8(trainer.picture(camera).cpu().numpy())

    def _photo(self, trainer: Trainer, name: str, path: Path) -> np.ndarray:
        """Return the photo with the pixels that the method masks now in red."""
        photo = read_png_rgb(path)
        if name not in self._train:
            return photo
        step = trainer.make_step(max(trainer.iteration, 1), self._train[name], downsampling=1)
        keep = trainer.combine_user_keep(step, trainer.hooks.mask.predict(step))
        if keep is None:
            return photo
        return tint(photo, (keep < 0.5).cpu().numpy(), MASKED)


def _camera_of(seen: Any) -> Camera | None:
    """Convert a browser's camera to ours; None if the browser has not sent it yet."""
    wxyz, fov, aspect = np.asarray(seen.wxyz, np.float64), float(seen.fov), float(seen.aspect)
    size = np.linalg.norm(wxyz)
    position = np.asarray(seen.position, np.float64)
    if not (
        np.isfinite(position).all()
        and np.isfinite(size)
        and size > 0
        and 0.01 < fov < 3.1
        and 0.05 < aspect < 20
    ):
        return None
    height = max(16, min(_WIDTH, round(_WIDTH / aspect)))
    width = max(16, round(height * aspect))
    focal = height / 2 / math.tan(fov / 2)
    return Camera(
        width, height, focal, focal, width / 2, height / 2, pose_at(position, rotation_from_quat(wxyz).T)
    )


def _free_port(host: str, port: int) -> int:
    """Check the port, or choose a free one for 0, because viser would silently take another.

    Raises:
        AwError: the port is taken, or the address is not of this machine.
    """
    import socket

    try:
        family = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0][0]
        with socket.socket(family, socket.SOCK_STREAM) as probe:
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            probe.bind((host, port))
            return int(probe.getsockname()[1])
    except OSError as error:
        raise AwError(
            f"cannot listen on {host}:{port}: {error.strerror or error}; choose another --port, or 0"
        ) from None
