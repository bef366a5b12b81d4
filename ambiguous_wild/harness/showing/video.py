"""What `aw video` does, as a call."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from ambiguous_wild.core import AwError, Camera, Scene
from ambiguous_wild.harness.showing.read import read_models
from ambiguous_wild.io.atomic import check_output
from ambiguous_wild.splat.cpu.warmup import prepare_cpu
from ambiguous_wild.viewing import camera_path
from ambiguous_wild.viewing.video import Frame, Tick, draw_frames, narrowed, write_gif, write_mp4

GIF_FPS = 12.0
PATHS = ("test", "orbit")


@dataclass(frozen=True)
class Video:
    """What was written."""

    path: Path
    gif: Path | None
    frames: int
    seconds: float
    labels: tuple[str, ...]


def video_runs(
    paths: Sequence[Path],
    output: Path,
    *,
    path: str | Path = "test",
    seconds: float = 8.0,
    fps: float = 24.0,
    width: int | None = None,
    columns: int | None = None,
    gif: Path | None = None,
    gif_seconds: float = 4.0,
    gif_width: int = 640,
    scene: str | None = None,
    scene_folder: Path | None = None,
    threads: int | None = None,
    say: Callable[[str], None] = lambda text: None,
    tick: Tick = lambda done, total: None,
) -> Video:
    """Film the models of runs side by side along one camera path.

    Args:
        paths: run folders, or folders of runs, all of one scene.
        output: the .mp4 file.
        path: "test" (through the test cameras), "orbit", or a file of a viewer.
        seconds, fps: length and frames per second.
        width: of each method's picture, px; None = the photos'.
        columns: pictures in a row.
        gif: also an animation of the video, played faster so that it lasts `gif_seconds`.
        gif_seconds, gif_width: its length and width, px.
        scene: name of the scene, where the runs are of several.
        scene_folder: where it lies; None = where the runs say.
        threads: of the kernels; None = all.
        say, tick: told what is done.

    Raises:
        AwError: no run with a model, several scenes, no scene, no camera path, or no place for the file.
    """
    if output.suffix.lower() != ".mp4":
        raise AwError(f"-o {output}: give a name that ends in .mp4")
    if gif is not None and gif.suffix.lower() != ".gif":
        raise AwError(f"--gif {gif}: give a name that ends in .gif")
    frames = round(seconds * fps)
    if frames < 2:
        raise AwError(f"{seconds:g} seconds at {fps:g} frames per second are fewer than two frames")
    for wanted in (output, *([gif] if gif else [])):
        check_output(wanted)
    shown = read_models(paths, scene=scene, scene_folder=scene_folder)
    for note in shown.notes:
        say(note)
    cameras = _cameras(shown.scene, path, frames, width)
    prepare_cpu(threads, say)
    kept: list[Frame] = []
    chosen = {
        round(k * (frames - 1) / max(1, round(gif_seconds * GIF_FPS) - 1))
        for k in range(round(gif_seconds * GIF_FPS))
    }

    def watched() -> Iterator[Frame]:
        for number, frame in enumerate(draw_frames(shown.models, cameras, columns=columns, tick=tick)):
            if gif is not None and number in chosen:
                kept.append(narrowed(frame, gif_width))
            yield frame

    written = write_mp4(output, watched(), fps)
    if gif is not None:
        write_gif(gif, kept, len(kept) / gif_seconds)
    return Video(output, gif, written, written / fps, tuple(model.label for model in shown.models))


def _cameras(scene: Scene, path: str | Path, frames: int, width: int | None) -> list[Camera]:
    lens = (scene.test or scene.views)[0].camera
    wide = lens.width if width is None else width
    size = (wide, max(2, round(lens.height * wide / lens.width)))
    if path == "test":
        return camera_path.through_views(scene, frames, size)
    if path == "orbit":
        return camera_path.orbit(scene, frames, size)
    return camera_path.from_file(Path(path), scene, frames, size)
