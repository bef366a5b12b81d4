"""Camera paths and videos: smooth, where they should be, readable by another decoder."""

from __future__ import annotations

import json
import math
import re
import signal
import threading
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
import pytest

from ambiguous_wild.core import AwError, Camera, Scene
from ambiguous_wild.io.scene_folder import load_scene
from ambiguous_wild.viewing import video
from ambiguous_wild.viewing.model import space_of
from ambiguous_wild.viewing.video import labelled, write_gif, write_mp4
from tests.command_line import aw
from tests.tiny_scene import write_tiny_scene
from tests.viewing.wall_runs import write_shown_run

SIZE = (64, 48)


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("filmed")
    scene = write_tiny_scene(root / "porch")
    for method in ("3dgs", "refinesplat"):
        write_shown_run(root / "runs", scene, method)
    return root / "runs"


@pytest.fixture(scope="module")
def scene(runs: Path) -> Scene:
    return load_scene(runs.parent / "porch")


def frames_of(path: Path) -> list[np.ndarray]:
    reader, found = cv2.VideoCapture(str(path)), []
    while True:
        more, frame = reader.read()
        if not more:
            return found
        found.append(frame[:, :, ::-1])


def test_the_path_goes_through_the_test_cameras(scene: Scene) -> None:
    path = video.through_views(scene, 41, SIZE)
    assert len(path) == 41 and {(c.width, c.height) for c in path} == {SIZE}
    centers = np.array([c.center for c in path])
    for view in scene.test:
        assert np.linalg.norm(centers - view.camera.center, axis=1).min() < 0.05
    steps = np.linalg.norm(np.diff(centers, axis=0), axis=1)
    assert steps.max() < 3 * steps.mean()
    assert path[0].fx == pytest.approx(scene.test[0].camera.fx)


def test_an_orbit_keeps_distance_and_looks_at_the_middle(scene: Scene) -> None:
    space = space_of(scene)
    assert space.up @ [0, -1, 0] > 0.99 and abs(space.middle[2] - 4) < 0.2
    path = video.orbit(scene, 12, SIZE)
    for camera in path:
        assert np.linalg.norm(camera.center - space.middle) == pytest.approx(space.distance)
        seen = camera.cam_from_world[:3, :3] @ space.middle + camera.cam_from_world[:3, 3]
        assert np.allclose(seen[:2], 0, atol=1e-9) and seen[2] > 0
        assert camera.cam_from_world[1, :3] @ space.up < 0  # y down
        assert np.linalg.det(camera.cam_from_world[:3, :3]) == pytest.approx(1)


def nerfstudio(cameras: list[Camera], fov: float) -> dict[str, object]:
    flip = np.diag([1.0, -1, -1, 1])
    rows = [
        {"camera_to_world": (np.linalg.inv(c.cam_from_world) @ flip).ravel().tolist(), "fov": fov}
        for c in cameras
    ]
    return {"camera_type": "perspective", "camera_path": rows, "fps": 24}


def inria(position: list[float], rotation: np.ndarray, fx: float = 60.0) -> dict[str, object]:
    lens = {"fx": fx, "fy": 60.0, "width": 64, "height": 48}
    return {"position": position, "rotation": rotation.tolist(), **lens}


def test_paths_of_viewers_are_read(scene: Scene, tmp_path: Path) -> None:
    given = [view.camera for view in scene.train[:4]]
    (tmp_path / "a.json").write_text(json.dumps(nerfstudio(given, 60.0)))
    path = video.from_file(tmp_path / "a.json", scene, 4, (100, 80))
    for camera, wanted in zip(path, given):
        assert np.allclose(camera.cam_from_world, wanted.cam_from_world, atol=1e-9)
        assert camera.fy == pytest.approx(40 / math.tan(math.radians(30))) and camera.fx == camera.fy
    rows = [inria(c.center.tolist(), c.cam_from_world[:3, :3].T) for c in given]
    (tmp_path / "b.json").write_text(json.dumps(rows))
    path = video.from_file(tmp_path / "b.json", scene, 4, (128, 96))
    assert all(np.allclose(c.cam_from_world, w.cam_from_world, atol=1e-9) for c, w in zip(path, given))
    assert path[0].fx == 120 and len(video.from_file(tmp_path / "b.json", scene, 30, SIZE)) == 30


@pytest.mark.parametrize(
    "text",
    [
        "", "[]", "{}", "nonsense", '{"camera_path": [1, 2]}', '{"camera_path": [{}, {}]}', "[" * 5000,
        '{"camera_path": [{"camera_to_world": [1, 2]}, {"camera_to_world": [1, 2]}]}',
        json.dumps([inria([0, 0, 0], np.diag([2, 2, 2]))] * 2),
        json.dumps([inria([0, 0, 0], np.eye(3), fx=0)] * 2),
        json.dumps([inria([0, 0, 1e999], np.eye(3))] * 2),
    ],
)  # fmt: skip
def test_what_is_no_path_is_one_line(scene: Scene, tmp_path: Path, text: str) -> None:
    (tmp_path / "p.json").write_text(text)
    with pytest.raises(AwError, match=r"p\.json") as error:
        video.from_file(tmp_path / "p.json", scene, 5, SIZE)
    assert "\n" not in str(error.value)


def test_a_video_of_two_methods(runs: Path, tmp_path: Path) -> None:
    done = aw(
        "video", runs, "-o", tmp_path / "v.mp4", "--seconds", 1, "--fps", 12, "--width", 96, "--threads", 1,
        "--gif", tmp_path / "v.gif",
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert "12 frames, 1.0 s, 3dgs; refinesplat" in done.stderr.partition("drawing 12 frames of 3dgs; ")[2]
    frames = frames_of(tmp_path / "v.mp4")
    assert len(frames) == 12 and frames[0].shape == (72, 196, 3)
    left, right = frames[5][20:, :96].astype(float), frames[5][20:, 100:].astype(float)
    assert left.std() > 20 and np.abs(left - right).mean() < 12  # the same wall twice, below the labels
    assert b"vp09" in (tmp_path / "v.mp4").read_bytes()
    from PIL import Image

    with Image.open(tmp_path / "v.gif") as gif:
        assert gif.size[0] == 196 and gif.n_frames == 12 and gif.info["loop"] == 0
    assert sorted(p.name for p in tmp_path.iterdir()) == ["v.gif", "v.mp4"]


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (["-o", "v.avi"], "ends in .mp4"),
        (["-o", "v.mp4", "--gif", "v.png"], "ends in .gif"),
        (["-o", "v.mp4", "--path", "gone.json"], "cannot read gone.json"),
        (["-o", "v.mp4", "--seconds", "0.1", "--fps", "1"], "fewer than two frames"),
        (["-o", "v.mp4", "--width", "4096", "--columns", "2", "--seconds", "1"], "at most 8192"),
    ],
)
def test_what_cannot_be_filmed_leaves_nothing(
    runs: Path, tmp_path: Path, words: list[str], told: str
) -> None:
    done = aw("video", runs, *words, cwd=tmp_path)
    assert done.returncode == 2 and told in done.stderr and done.stderr.count("error:") == 1
    assert list(tmp_path.iterdir()) == []


def test_frames_come_back_nearly_as_they_were(tmp_path: Path) -> None:
    y, x = np.mgrid[:90, :160]
    given = [
        np.stack([(x + 3 * k) % 256, (2 * y + k) % 200, np.full_like(x, 90)], axis=2).astype(np.uint8)
        for k in range(10)
    ]
    assert write_mp4(tmp_path / "v.mp4", iter(given), 24) == 10
    for frame, wanted in zip(frames_of(tmp_path / "v.mp4"), given):
        error = np.mean((frame.astype(float) - wanted) ** 2)
        assert 10 * math.log10(255**2 / error) > 28
    with pytest.raises(AwError, match="wrote nothing"):
        write_mp4(tmp_path / "none.mp4", iter([]), 24)
    with pytest.raises(AwError, match="no frame"):
        write_gif(tmp_path / "none.gif", [], 10)


def test_a_frame_is_drawn_while_the_one_before_is_encoded(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    drawn, written = threading.Event(), []

    class Encoder:
        def write(self, frame: np.ndarray) -> None:
            assert drawn.wait(10), "the second frame waits for the first"
            written.append(int(frame[0, 0, 0]))

        def release(self) -> None:
            (tmp_path / "released").touch()

    def frames(last: int) -> Iterator[np.ndarray]:
        for k in range(last):
            if k == 1:
                drawn.set()
            yield np.full((2, 2, 3), k, np.uint8)

    def opened(temporary: Path, *given: object) -> Encoder:
        temporary.write_bytes(b"video")
        return Encoder()

    monkeypatch.setattr(video, "_open", opened)
    assert write_mp4(tmp_path / "v.mp4", frames(4), 24) == 4
    assert written == [0, 1, 2, 3] and (tmp_path / "released").exists()
    monkeypatch.setattr(Encoder, "write", lambda self, frame: 1 / 0)
    with pytest.raises(ZeroDivisionError):
        write_mp4(tmp_path / "none.mp4", frames(4), 24)
    assert not (tmp_path / "none.mp4").exists()


def test_frames_until_an_interruption_are_kept_beside_an_earlier_video(
    runs: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "v.mp4"
    path.write_bytes(b"an earlier video")
    draw = video.Renderer.__call__
    drawn: list[int] = []

    def stopped(self, camera):  # type: ignore[no-untyped-def]
        drawn.append(1)
        if len(drawn) == 10:  # two models: in the fifth frame
            signal.raise_signal(signal.SIGTERM)
        return draw(self, camera)

    monkeypatch.setattr(video.Renderer, "__call__", stopped)
    done = aw("video", runs, "-o", path, "--seconds", "1")
    part = tmp_path / "v-part.mp4"
    assert done.returncode == 130 and f"interrupted: the first 4 frames are in {part}" in done.stderr
    assert re.search(
        r"drawing 24 frames of .*\nabout \d+ s; a smaller --width or --fps is faster", done.stderr
    )
    assert len(frames_of(part)) == 4 and path.read_bytes() == b"an earlier video"
    assert sorted(p.name for p in tmp_path.iterdir()) == ["v-part.mp4", "v.mp4"]
    assert signal.getsignal(signal.SIGTERM) == signal.SIG_DFL


def test_a_label_stays_in_its_picture() -> None:
    plain = np.full((48, 64, 3), 200, np.uint8)
    drawn = labelled(plain, "a very long label of a méthod\n" * 3)
    assert drawn.shape == plain.shape and (drawn[30:] == 200).all() and (plain == 200).all()
    assert (drawn[:12] != 200).any()
