"""Find the masks and backgrounds for the ambiguity report: from the truth, the user, or a trained run."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np

from ambiguous_wild.core import AwError, Camera, Scene, View
from ambiguous_wild.core.errors import shortlist
from ambiguous_wild.harness.result_file import FAILED, MODEL, RESULT
from ambiguous_wild.io import plain_yaml
from ambiguous_wild.io.images import load_image_float, read_mask
from ambiguous_wild.io.ply import read_splat_ply
from ambiguous_wild.io.scene_folder import without_suffix
from ambiguous_wild.viewing.model import gaussians_of

# limits for a background that a run renders
OPAQUE = 0.9  # accumulated alpha of a surface
SEEN_BY = 2  # number of other photos that must see the surface unmasked
DEPTH_SLACK = 0.05  # largest relative difference of depth at which two photos see the same surface


@dataclass(frozen=True)
class DistractorMasks:
    """Masks of the train photos, by the photo's name."""

    source: str  # truth, scene, run or folder; kept in the report
    paths: dict[str, Path]
    keep: bool  # white = static; else white = distractor

    def load(self, view: View) -> np.ndarray:  # [H, W] bool
        """Return the mask of a photo at its size, True on distractors.

        Raises:
            AwError: the mask is unreadable, or its shape differs from the photo's.
        """
        white = load_mask(self.paths[view.name], view)
        return ~white if self.keep else white


def find_masks(scene: Scene, choice: str | None, run: Path | None, *, keep: bool = False) -> DistractorMasks:
    """Find the distractor masks of the train photos.

    Args:
        scene: the scene.
        choice: "truth", "scene" (masks/), "run" or a folder; None = the first of truth, run and scene
            that exists.
        run: folder of a run with masks/.
        keep: in the chosen folder white means keep; else it means distractor.

    Raises:
        AwError: there are no masks, or some photos have none.
    """
    truth = scene.root / "truth" / "distractor"
    if choice is None:
        if truth.is_dir():
            choice = "truth"
        elif run is not None and (run / "masks").is_dir() and any((run / "masks").rglob("*.png")):
            choice = "run"
        elif any(v.keep_path for v in scene.train):
            choice = "scene"
        else:
            raise AwError(
                f"{scene.name} has no distractor masks: neither truth/distractor nor masks/; give "
                "--distractor-masks or --keep-masks DIR (PNG of the photo's stem) or --run RUN of a method "
                "that masks"
            )
    if choice == "run" and run is None and not keep:
        raise AwError("--distractor-masks run needs --run RUN, a folder of 'aw bench'")
    black, white = (f"add them (all {colour} where there is no distractor)" for colour in ("black", "white"))
    if choice == "scene" and not keep:  # wherever in masks/ training takes them from
        taken = {v.name: v.keep_path for v in scene.train}
        return DistractorMasks(choice, _complete(taken, scene.root / "masks", white), keep=True)
    sources = {"truth": (truth, False, black)}
    if run is not None:
        sources["run"] = (run / "masks", True, "this method draws no masks; take another run")
    if choice in sources and not keep:
        folder, is_keep, advice = sources[choice]
        return DistractorMasks(choice, _all(scene, folder, advice), is_keep)
    return DistractorMasks("folder", _all(scene, Path(choice), white if keep else black), keep)


def _all(scene: Scene, folder: Path, advice: str) -> dict[str, Path]:
    if not folder.is_dir():
        raise AwError(
            f"there is no mask folder {folder} for {scene.name}: give --distractor-masks truth|scene|run|DIR"
        )
    return _complete({v.name: folder / f"{without_suffix(v.name)}.png" for v in scene.train}, folder, advice)


def _complete(paths: Mapping[str, Path | None], folder: Path, advice: str) -> dict[str, Path]:
    found = {name: path for name, path in paths.items() if path is not None and path.is_file()}
    missing = [name for name in paths if name not in found]
    if missing:
        raise AwError(
            f"{len(missing)} of {len(paths)} train photos have no mask in {folder}: {shortlist(missing)}; "
            + advice
        )
    return found


def load_mask(path: Path, view: View) -> np.ndarray:
    """Return where a mask is white, [H, W] bool, resampled to the photo's size; see `read_mask`.

    Raises:
        AwError: the mask is unreadable, or its shape differs from the photo's.
    """
    import cv2

    mask = read_mask(path)
    width, height = view.camera.width, view.camera.height
    if mask.shape != (height, width):
        if abs(mask.shape[1] * height - mask.shape[0] * width) > 0.02 * mask.shape[1] * height:
            raise AwError(
                f"mask {path} is {mask.shape[1]}x{mask.shape[0]}, its photo {width}x{height}: another shape; "
                "export it from the photo of the scene"
            )
        mask = cv2.resize(mask, (width, height), interpolation=cv2.INTER_NEAREST)
    return mask >= 128


Seen = tuple[np.ndarray | None, np.ndarray | None]


@dataclass(frozen=True)
class Background:
    """The background behind the distractors."""

    source: str  # clean, run or none; kept in the report
    # returns the background of train photo `index`, [H, W, 3] float32 in [0, 1] or None, and where it is
    # known, [H, W] bool (None: everywhere)
    load: Callable[[int, View], Seen]


def clean_background(index: int, view: View, *, folder: Path) -> Seen:
    """Load the clean version of a photo; a photo without one has an unknown background.

    Raises:
        AwError: the clean version differs from the photo in size.
    """
    path = folder / f"{without_suffix(view.name)}.png"
    if not path.is_file():
        return None, None
    image = load_image_float(path)
    if image.shape[:2] != (view.camera.height, view.camera.width):
        raise AwError(
            f"{path} is {image.shape[1]}x{image.shape[0]}, its photo {view.camera.width}x"
            f"{view.camera.height}; load the factor it was built for, or build it again"
        )
    return image, None


class RunBackground:
    """Renders of a run's Gaussians at the train cameras.

    A render has a colour at every pixel, but not every pixel is known: a pixel counts as known where the
    render is opaque and two other photos see its surface outside of their masks.
    """

    def __init__(self, scene: Scene, run: Path, masks: DistractorMasks) -> None:
        """
        Raises:
            AwError: the run is not finished, or of another scene or size.
        """
        check_run(scene, run)
        self.views, self.masks = list(scene.train), masks
        self._gaussians = gaussians_of(read_splat_ply(run / MODEL))
        self._depth: dict[int, tuple[Camera, np.ndarray, np.ndarray]] = {}  # of the other photos, coarse

    def load(self, index: int, view: View) -> Seen:
        """See `Background`."""
        if not self._depth:
            self._depth = {k: self._coarse(v) for k, v in enumerate(self.views)}
        image, alpha, depth = self._render(view.camera)
        known = alpha >= OPAQUE
        rows, cols = np.nonzero(known & self.masks.load(view))
        points = view.camera.unproject(np.column_stack([cols, rows]) + 0.5, depth[rows, cols])
        seen = np.zeros(len(rows), int)
        for other, coarse in self._depth.items():
            if other != index:
                seen += sees(*coarse, points)
        known[rows[seen < SEEN_BY], cols[seen < SEEN_BY]] = False
        return image, known

    def _render(self, camera: Camera) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        from ambiguous_wild.splat.render import render

        drawn = render(self._gaussians, camera, sh_degree=self._gaussians.sh_degree)
        alpha = drawn.alpha.numpy()
        depth = drawn.depth.numpy() / np.maximum(alpha, 1e-6)
        return drawn.image.numpy().clip(0.0, 1.0), alpha, depth

    def _coarse(self, view: View) -> tuple[Camera, np.ndarray, np.ndarray]:
        """Return a camera of about a quarter of the size, its depth, and where it sees the static scene."""
        import cv2

        width, height = max(view.camera.width // 4, 16), max(view.camera.height // 4, 16)
        camera = view.camera.resized(width, height)
        _, alpha, depth = self._render(camera)
        # a coarse pixel is static only if none of its pixels is masked
        masked = self.masks.load(view).astype(np.uint8)
        static = cv2.resize(masked * 255, (width, height), interpolation=cv2.INTER_AREA) == 0
        return camera, depth, static & (alpha >= OPAQUE)


def find_background(scene: Scene, choice: str | None, run: Path | None, masks: DistractorMasks) -> Background:
    """Find the background to compare with: clean versions if there are any, else the render of a run.

    Raises:
        AwError: there is neither, or not the chosen one.
    """
    clean = scene.root / "truth" / "clean"
    has_clean = any(scene.truth_file("clean", view).is_file() for view in scene.train)
    if choice is None:
        choice = "clean" if has_clean else "run" if run is not None else ""
    if choice == "clean" and has_clean:
        return Background("clean", partial(clean_background, folder=clean))
    if choice == "run" and run is not None:
        return Background("run", RunBackground(scene, run, masks).load)
    if choice == "none":
        return Background("none", lambda index, view: (None, None))  # colour has no score
    if choice == "run":
        raise AwError("--background run needs --run RUN, a folder of 'aw bench'")
    raise AwError(
        f"{scene.name} has no clean versions in {clean}: the background of its distractors is unknown; give "
        "--run RUN of a trained run, or --background none to leave colour out"
    )


def check_run(scene: Scene, run: Path) -> None:
    """Check that the run is finished and of this scene.

    Raises:
        AwError: it is not; the error says what to do.
    """
    from ambiguous_wild.harness.cell import scene_identity

    path, failed = run / "config.yaml", (run / FAILED).is_file() and not (run / RESULT).is_file()
    if failed or not path.is_file() or not (run / MODEL).is_file():
        raise AwError(
            f"{run} is no finished run (config.yaml and point_cloud.ply); give a folder of 'aw bench', "
            "RUNS/SCENE/METHOD/seed0"
        )
    try:
        config = plain_yaml.read_mapping(path)
        identity, name = config["scene"]["sha256"], config["scene"]["name"]
    except (AwError, KeyError, TypeError) as error:
        raise AwError(f"{path} is damaged ({' '.join(str(error).split())}); train the run again") from None
    if identity != scene_identity(scene):
        raise AwError(
            f"{run} was trained on scene {name!r} with other photos, split or size than {scene.root}; "
            "train on this one: 'aw bench --scene'"
        )


def sees(
    camera: Camera,
    depth: np.ndarray,  # [h, w] z
    static: np.ndarray,  # [h, w] bool: opaque and outside the mask
    points: np.ndarray,  # [P, 3] world
) -> np.ndarray:  # [P] bool
    """Return whether the camera sees each point: inside the picture, at its surface, outside the mask."""
    local = camera.to_camera(points)
    z = np.maximum(local[:, 2], 1e-9)
    cols = np.floor(np.clip(camera.fx * local[:, 0] / z + camera.cx, -1, camera.width)).astype(int)
    rows = np.floor(np.clip(camera.fy * local[:, 1] / z + camera.cy, -1, camera.height)).astype(int)
    inside = (local[:, 2] > 1e-6) & (cols >= 0) & (cols < camera.width) & (rows >= 0) & (rows < camera.height)
    r, c = rows.clip(0, camera.height - 1), cols.clip(0, camera.width - 1)
    return inside & static[r, c] & (np.abs(depth[r, c] - z) <= DEPTH_SLACK * z)
