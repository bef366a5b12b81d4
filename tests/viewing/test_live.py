"""`aw view --live`: a client on the network pauses, steps and resumes; the model's bits stay the same."""

from __future__ import annotations

import contextlib
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from ambiguous_wild.core import AwError
from ambiguous_wild.harness.benchmark import bench
from ambiguous_wild.report.model_views import watch
from tests.command_line import aw
from tests.tiny_scene import TEST, TRAIN, write_tiny_scene

viser = pytest.importorskip("viser", reason="extra [view] is not installed")

ITERATIONS = 60
PATIENCE_S = 120.0


class Client:
    """What a browser does, over viser's own protocol: it keeps every control's state and presses buttons."""

    def __init__(self, port: int) -> None:
        from websockets.sync.client import connect

        protocol: Any = f"viser-v{viser.__version__}"
        self.connection = contextlib.ExitStack()
        self.socket = self.connection.enter_context(
            connect(f"ws://127.0.0.1:{port}", subprotocols=[protocol], max_size=None, proxy=None)
        )
        self.controls: dict[str, dict[str, Any]] = {}
        self.backgrounds = 0
        threading.Thread(target=self._listen, daemon=True).start()

    def _listen(self) -> None:
        import msgspec
        import zstandard

        try:
            for frame in self.socket:
                assert isinstance(frame, bytes)
                size = int.from_bytes(frame[8:16], "little")
                inner = zstandard.ZstdDecompressor().decompress(frame[16 : 16 + size])
                for message in msgspec.msgpack.decode(inner)["messages"]:
                    self._take(message)
        except Exception:  # the server has closed
            return

    def _take(self, message: dict[str, Any]) -> None:
        if "props" in message and "uuid" in message:
            self.controls[message["uuid"]] = {"type": message["type"], **message["props"]}
        elif message["type"] == "GuiUpdateMessage":
            self.controls.setdefault(message["uuid"], {}).update(message["updates"])
        elif message["type"] == "BackgroundImageMessage":
            self.backgrounds += 1

    def send(self, **message: Any) -> None:
        import msgspec

        self.socket.send(msgspec.msgpack.encode(message))

    def control(self, label: str) -> str:
        wait(lambda: any(c.get("label") == label for c in list(self.controls.values())), f"control {label}")
        return next(uuid for uuid, c in list(self.controls.items()) if c.get("label") == label)

    def set(self, label: str, value: Any) -> None:
        self.send(type="GuiUpdateMessage", uuid=self.control(label), updates={"value": value})

    def press(self, label: str) -> None:
        self.set(label, True)

    @property
    def status(self) -> str:
        texts = [c["_markdown"] for c in list(self.controls.values()) if "_markdown" in c]
        return texts[0] if texts else ""

    def look(self, x: float) -> None:
        """Move the free camera."""
        pose = {"wxyz": (1.0, 0.0, 0.0, 0.0), "position": (x, 0.0, 0.0), "look_at": (x, 0.0, 1.0)}
        lens = {"fov": 0.8, "near": 0.01, "far": 100.0, "image_height": 300, "image_width": 400}
        self.send(type="ViewerCameraMessage", up_direction=(0.0, -1.0, 0.0), **pose, **lens)


def wait(true: Callable[[], bool], what: str) -> None:
    end = time.monotonic() + PATIENCE_S
    while not true():
        assert time.monotonic() < end, f"never: {what}"
        time.sleep(0.02)


def test_pause_step_resume_and_the_same_bits(tmp_path: Path) -> None:
    from ambiguous_wild.viewing.live import LiveView

    scene = write_tiny_scene(tmp_path / "porch")
    plain = bench("refinesplat", scene, output=tmp_path / "plain", iterations=ITERATIONS, threads=1, jobs=1)
    view = LiveView("127.0.0.1", 0, paused=True)
    problems: list[BaseException] = []

    def train() -> None:
        try:
            watch(scene, "refinesplat", tmp_path / "live", iterations=ITERATIONS, threads=1, view=view)
        except BaseException as error:
            problems.append(error)

    client = Client(view.port)
    thread = threading.Thread(target=train)
    thread.start()
    try:
        wait(lambda: "iteration 1 " in client.status and "paused" in client.status, "the first step")
        names = [f"test: {n}" for n in TEST] + [f"train: {n}" for n in TRAIN]
        camera = client.control("Camera")
        wait(lambda: list(client.controls[camera].get("options", ())) == names, "cameras to choose from")
        client.look(0.1)  # viser takes a client as one when it has said where it looks from
        wait(lambda: client.backgrounds > 0, "a picture of the free camera")
        for number in (2, 3):
            client.press("Step")
            wait(lambda number=number: f"iteration {number} " in client.status, f"step {number}")  # type: ignore[misc]
        drawn = client.backgrounds
        client.look(0.3)
        wait(lambda: client.backgrounds > drawn, "a picture of the camera that moved")
        render = next(u for u, c in client.controls.items() if c.get("label") == "photo and mask")
        seen = client.controls[render]["_data"]
        client.set("Camera", names[-1])
        wait(lambda: client.controls[render]["_data"] != seen, "the photo of another camera")
        client.set("Iterations a picture", 10)
        client.press("Resume")
        wait(lambda: "paused" not in client.status, "to go on")
        wait(lambda: client.status.startswith("refinesplat on porch") or bool(problems), "the end")
    finally:
        view.pause(False)
        thread.join()
        view.stop()
    assert problems == []
    (run,) = (tmp_path / "live").rglob("metrics.json")
    for name in ("point_cloud.ply", *(f"renders/test/{n}" for n in TEST)):
        assert (run.parent / name).read_bytes() == (plain.runs[0].folder / name).read_bytes(), name


def test_what_cannot_be_watched_is_one_line(tmp_path: Path) -> None:
    from ambiguous_wild.viewing.live import LiveView

    view = LiveView("127.0.0.1", 0)
    try:
        with pytest.raises(AwError, match=f"cannot listen on 127.0.0.1:{view.port}.*choose another --port"):
            LiveView("127.0.0.1", view.port)
    finally:
        view.stop()
    done = aw("view", "--live", tmp_path / "none", "--port", 0, "-o", tmp_path / "out", "--iterations", 5)
    assert done.returncode == 2 and "error: " in done.stderr and not (tmp_path / "out").exists()
