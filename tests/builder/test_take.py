"""`aw capture` on videos and folders made on the spot."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest
from click.testing import CliRunner

from ambiguous_wild.builder import capture_photos
from ambiguous_wild.builder.collect import collect
from ambiguous_wild.cli.capture import capture_command as command
from ambiguous_wild.core import AwError
from tests.builder.capture_maker import texture, write_capture

FRAMES, SHARP_EVERY = 48, 8
CODECS = {".avi": "MJPG", ".mp4": "mp4v"}


def write_video(path: Path, frames: int = FRAMES) -> Path:
    """A pan over a texture; frames 4, 12, 20, ... are sharp, the others are not."""
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*CODECS[path.suffix]), 24.0, (160, 120))
    assert writer.isOpened()
    for i in range(frames):
        frame = np.ascontiguousarray(texture(1)[100:220, 2 * i : 2 * i + 160])
        if i % SHARP_EVERY != SHARP_EVERY // 2:
            frame = cv2.GaussianBlur(frame, (0, 0), 3)
        writer.write(frame)
    writer.release()
    return path


def patched(data: bytes, kind: bytes, payload: bytes, *, add: bool = False) -> bytes:
    """An MP4 file whose boxes of one kind hold `payload`, or get it added at their end."""
    out, at = b"", 0
    while at + 8 <= len(data):
        size, name = int.from_bytes(data[at : at + 4], "big"), data[at + 4 : at + 8]
        inner = data[at + 8 : at + size]
        if name == kind:
            inner = inner + payload if add else payload
        elif name in (b"moov", b"trak", b"mdia", b"minf", b"stbl"):
            inner = patched(inner, kind, payload, add=add)
        elif name == b"stsd":  # version, number of entries
            inner = inner[:8] + patched(inner[8:], kind, payload, add=add)
        out += (8 + len(inner)).to_bytes(4, "big") + name + inner
        at += size
    return out


def error(*words: object) -> str:
    raised = CliRunner().invoke(command, [str(w) for w in words]).exception
    assert isinstance(raised, AwError), raised
    assert "\n" not in str(raised)
    return str(raised)


def test_frames_are_the_sharp_ones_and_evenly_spaced(tmp_path: Path) -> None:
    video, out = write_video(tmp_path / "v.avi"), tmp_path / "raw"
    done = CliRunner().invoke(
        command, [str(video), "-o", str(out), "--frames", "6", "--json"], catch_exceptions=False
    )
    facts = json.loads(done.stdout)
    assert [p["frame"] for p in facts["photos"]] == list(range(4, FRAMES, SHARP_EVERY))
    assert facts["photos"][1]["time_s"] == pytest.approx(12 / 24)
    record = json.loads((out / "capture.json").read_text())
    assert {*record} == {
        *("version", "kind", "source", "frames_read", "frames_announced", "photos", "left_out")
    }
    assert list(record["photos"][0]) == ["photo", "frame", "time_s", "sharpness"]
    assert sorted(p.name for p in out.iterdir()) == [
        "capture.json",
        *(f"frame_{k:05d}.jpg" for k in range(1, 7)),
    ]
    saved = cv2.imread(str(out / "frame_00001.jpg")).astype(int)
    assert np.abs(saved - texture(1)[100:220, 8:168].astype(int)).mean() < 12  # two times JPEG


def test_a_short_video_gives_all_it_has(tmp_path: Path) -> None:
    video, out = write_video(tmp_path / "v.avi", 5), tmp_path / "raw"
    done = CliRunner().invoke(command, [str(video), "-o", str(out)], catch_exceptions=False)
    assert done.exit_code == 0 and "5 photos in" in done.output
    assert "has 5 frames: took all of them, fewer than --frames 60" in done.output
    assert [p["frame"] for p in json.loads((out / "capture.json").read_text())["photos"]] == [0, 1, 2, 3, 4]


def test_stretches_of_equals_keep_their_distance() -> None:
    flat = np.full((16, 16, 3), 7, np.uint8)
    frames = ((i, i / 10, flat) for i in range(40))
    got = [f.index for f in capture_photos.sharpest_frames(frames, [0, 1, 2, 3, 4])]
    assert len(got) == 4 and np.diff(got).min() >= 5
    one_each = [
        f.index
        for f in capture_photos.sharpest_frames(((i, float(i), flat) for i in range(4)), [0, 1, 2, 3, 4])
    ]
    assert one_each == [0, 1, 2, 3]


def test_a_folder_is_copied_byte_for_byte_once_each(tmp_path: Path) -> None:
    paths = write_capture(tmp_path / "in", 4)
    (tmp_path / "in/a b;$(x)\n.jpg").write_bytes(paths[0].read_bytes())
    (tmp_path / "in/bad.jpg").write_bytes(b"none")
    done = CliRunner().invoke(
        command, [str(tmp_path / "in"), "-o", str(tmp_path / "raw")], catch_exceptions=False
    )
    assert "4 photos in" in done.stdout and "bad.jpg (no image" in done.stdout
    facts = json.loads((tmp_path / "raw/capture.json").read_text())
    assert len(facts["photos"]) == 4 and len(facts["left_out"]) == 2
    for photo in facts["photos"]:
        assert "\n" not in photo["photo"] and " " not in photo["photo"]
        assert (tmp_path / "raw" / photo["photo"]).read_bytes() == (
            tmp_path / "in" / photo["source"]
        ).read_bytes()


def test_bad_sources_are_one_line_and_leave_nothing(tmp_path: Path) -> None:
    out = tmp_path / "raw"
    (tmp_path / "text.mp4").write_text("no video " * 100)
    (tmp_path / "empty.mp4").write_bytes(b"")
    (tmp_path / "nothing").mkdir()
    assert "no video that can be read" in error(tmp_path / "text.mp4", "-o", out)
    assert "is empty" in error(tmp_path / "empty.mp4", "-o", out)
    assert "SOURCE is empty" in error("", "-o", out)
    assert "holds no photos" in error(tmp_path / "nothing", "-o", out)
    assert "does not exist" in error(tmp_path / "absent", "-o", out)
    assert "unknown camera" in error("camera:front", "-o", out)
    assert "there is no camera 99" in error("camera:99", "-o", out)
    video = write_video(tmp_path / "v.avi", 2)
    assert "v.avi can be used, 3 are needed" in error(video, "-o", out)
    pattern = tmp_path / "%02d.avi"
    video.rename(pattern)
    assert "'%' in its name" in error(pattern, "-o", out, "--frames", 3)
    assert [p.name for p in tmp_path.iterdir() if "raw" in p.name] == []


def test_an_output_that_exists_is_left_alone(tmp_path: Path) -> None:
    write_capture(tmp_path / "in", 3)
    (tmp_path / "raw").mkdir()
    (tmp_path / "raw/mine.txt").write_text("x")
    assert "nothing is overwritten" in error(tmp_path / "in", "-o", tmp_path / "raw")
    assert "lies inside" in error(tmp_path / "in", "-o", tmp_path / "in/raw")
    assert [p.name for p in (tmp_path / "raw").iterdir()] == ["mine.txt"]


def test_a_camera_that_stops_leaves_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    class Camera:
        def __init__(self) -> None:
            self.left = 40

        def isOpened(self) -> bool:
            return True

        def get(self, _: int) -> float:
            return 10.0

        def grab(self) -> bool:
            return True

        def read(self) -> tuple[bool, np.ndarray]:
            self.left -= 1
            return self.left >= 0, texture(1)[:64, :64] + np.uint8(max(self.left, 0))

        def release(self) -> None:
            pass

    monkeypatch.setattr(capture_photos, "_open", lambda _: Camera())
    facts = capture_photos.photos_from_camera(0, tmp_path / "ok", frames=4, every_s=1.0)
    assert [p["frame"] // 10 for p in facts["photos"]] == [0, 1, 2, 3]
    with pytest.raises(AwError, match="stopped after 4 of 9"):
        capture_photos.photos_from_camera(0, tmp_path / "raw", frames=9, every_s=1.0)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["ok"]


def test_of_a_broken_video_there_is_one_line_and_it_is_ours(tmp_path: Path) -> None:
    (tmp_path / "text.mp4").write_text("no video " * 100)
    words = ["capture", str(tmp_path / "text.mp4"), "-o", str(tmp_path / "raw")]
    done = subprocess.run(
        [sys.executable, "-m", "ambiguous_wild.cli.main", *words], capture_output=True, text=True
    )
    lines = done.stderr.strip().splitlines()
    assert done.returncode == 2 and len(lines) == 1 and "no video that can be read" in lines[0]


def test_a_video_that_was_cut_short_is_told(tmp_path: Path) -> None:
    whole = write_video(tmp_path / "v.avi").read_bytes()
    (tmp_path / "half.avi").write_bytes(whole[: len(whole) // 2])
    words = [str(tmp_path / "half.avi"), "-o", str(tmp_path / "raw"), "--frames", "3"]
    done = CliRunner().invoke(command, words, catch_exceptions=False)
    assert done.exit_code == 0 and f"announces {FRAMES} frames" in done.stderr
    whole_words = [str(tmp_path / "v.avi"), "-o", str(tmp_path / "b"), "--frames", "3"]
    assert "warning" not in CliRunner().invoke(command, whole_words, catch_exceptions=False).stderr


def test_frames_of_a_variable_rate_are_picked_by_their_time(tmp_path: Path) -> None:
    """24 frames at 24 a second, then 24 at 4 a second: 1 s and 6 s."""
    data = write_video(tmp_path / "v.mp4").read_bytes()
    stts = data.index(b"stts") + 8
    delta = int.from_bytes(data[stts + 8 : stts + 12], "big")
    runs = b"".join(v.to_bytes(4, "big") for v in (0, 2, 24, delta, 24, 6 * delta))
    (tmp_path / "v.mp4").write_bytes(patched(data, b"stts", runs).replace(b"edts", b"free"))
    facts = capture_photos.photos_from([tmp_path / "v.mp4"], tmp_path / "raw", frames=7)
    times = [p["time_s"] for p in facts["photos"]]
    assert sum(p["frame"] < 24 for p in facts["photos"]) == 1  # one second of seven; by their count, 3.5
    assert max(np.diff(times)) < 1.51 and times[-1] > 6


@pytest.mark.parametrize(("curve", "name"), [(18, "HLG"), (16, "PQ"), (1, None)])
def test_hdr_video_is_refused_by_name(tmp_path: Path, curve: int, name: str | None) -> None:
    colr = b"\0\0\0\x13colrnclx" + bytes([0, 9, 0, curve, 0, 9, 0])
    data = write_video(tmp_path / "v.mp4").read_bytes()
    (tmp_path / "v.mp4").write_bytes(patched(data, b"mp4v", colr, add=True))
    assert capture_photos.hdr_curve(tmp_path / "v.mp4") == name
    head = b"\x1aE\xdf\xa3" + b"." * 40 + b"\x55\xba\x81" + bytes([curve]) + b"\x1fC\xb6u"
    (tmp_path / "v.mkv").write_bytes(head + b"\x55\xba\x81\x12" * (name is None))
    assert capture_photos.hdr_curve(tmp_path / "v.mkv") == name
    if name:
        assert f"is HDR video ({name})" in error(tmp_path / "v.mp4", "-o", tmp_path / "raw")
        assert not (tmp_path / "raw").exists()


def test_several_folders_and_videos_go_to_a_folder_each(tmp_path: Path) -> None:
    for folder in ("front", "back"):
        write_capture(tmp_path / "in" / folder, 2)
    for photo in (tmp_path / "in/back").iterdir():
        cv2.imwrite(str(photo), cv2.imread(str(photo))[:, ::-1])
    write_video(tmp_path / "in/walk.avi", 5)
    write_video(tmp_path / "in/front/live.avi", 5)  # beside photos
    write_capture(tmp_path / "cat/images", 2)
    write_video(tmp_path / "cat/train.avi", 5)  # what the photos were taken from
    (tmp_path / "other").mkdir()
    write_video(tmp_path / "other/walk.mp4", 40)
    for number, sources in enumerate(
        (["in", "other/walk.mp4"], ["in/back", "in/front", "in/walk.avi", "other"])
    ):
        out = tmp_path / f"raw{number}"
        words = [*(str(tmp_path / s) for s in sources), "-o", str(out), "--frames", "4"]
        done = CliRunner().invoke(command, words, catch_exceptions=False)
        assert "live.avi (a video beside photos" in done.stdout
        names = sorted(p.relative_to(out).as_posix() for p in out.rglob("*.jpg"))
        frames = [f"{w}/frame_{k:05d}.jpg" for w in ("walk", "walk_2") for k in range(1, 5)]
        assert names == ["back/p00.jpg", "back/p01.jpg", "front/p00.jpg", "front/p01.jpg", *frames]
        facts = json.loads((out / "capture.json").read_text())
        assert sorted(p["photo"] for p in facts["photos"]) == names
        assert [v["frames_read"] for v in facts["videos"]] == [5, 40]
        stems = [s.stem for s in collect(out).sources]
        assert len(set(stems)) == 12 and stems[-1] == "walk_2_frame_00004"
    CliRunner().invoke(
        command, [*(str(tmp_path / "cat" / s) for s in ("images", "train.avi")), "-o", str(tmp_path / "raw")]
    )
    assert len(collect(tmp_path / "raw").sources) == 7  # names that mean something are not given to sources
    assert "holds 2 photos" in error(tmp_path / "cat", "-o", tmp_path / "none")


def test_360_degree_photos_become_pinhole_views(tmp_path):
    """A sphere whose colour is the direction, so that every pixel of a view says where it looks."""
    width, height = 2048, 1024
    longitude = ((np.arange(width) + 0.5) / width - 0.5) * 2 * np.pi
    latitude = ((np.arange(height) + 0.5) / height - 0.5) * np.pi
    direction = np.stack(
        [
            np.sin(longitude)[None] * np.cos(latitude)[:, None],
            np.broadcast_to(np.sin(latitude)[:, None], (height, width)),
            np.cos(longitude)[None] * np.cos(latitude)[:, None],
        ],
        axis=-1,
    )
    sphere = np.round(127.5 + 127 * direction).astype(np.uint8)
    (tmp_path / "raw").mkdir()
    for name, pixels in (("a.png", sphere), ("b.png", 255 - sphere), ("c.png", sphere[:, ::-1])):
        cv2.imwrite(str(tmp_path / "raw" / name), pixels[..., ::-1])
    record = capture_photos.photos_from([tmp_path / "raw"], tmp_path / "out")
    assert len(record["photos"]) == 24 and all("_yaw" in photo["photo"] for photo in record["photos"])
    for yaw in (0, 90, 225):
        view = cv2.imread(str(tmp_path / "out" / f"a_yaw{yaw:03}.jpg"))[..., ::-1]
        side = len(view)
        assert view.shape == (512, 512, 3)
        x, y = np.meshgrid(*2 * [(np.arange(side) + 0.5) / side * 2 - 1])
        ray = np.stack([x, y, np.ones_like(x)], axis=-1)
        ray /= np.linalg.norm(ray, axis=-1, keepdims=True)
        c, s = np.cos(np.radians(yaw)), np.sin(np.radians(yaw))
        turned = ray @ np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]]).T
        assert np.abs(view - (127.5 + 127 * turned)).mean() < 2
