"""Where the report's masks and backgrounds come from: the truth, the user, or a trained run."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Protocol

import numpy as np

from ambiguous_wild.core import AwError, Scene, View
from ambiguous_wild.core.errors import shortlist
from ambiguous_wild.io.images import load_image_float, read_gray


@dataclass(frozen=True)
class Masks:
    """Masks of the train photos, by the photo's name."""

    source: str  # truth, scene, run or folder: as recorded
    paths: dict[str, Path]
    keep: bool  # white = static; else white = distractor

    def load(self, view: View) -> np.ndarray:  # [H, W] bool
        """True on distractors, at the photo's size.

        Raises:
            AwError: unreadable, or of another shape than the photo.
        """
        white = load_mask(self.paths[view.name], view)
        return ~white if self.keep else white


def find_masks(scene: Scene, choice: str | None, run: Path | None, keep: bool = False) -> Masks:
    """Distractor masks of the train photos.

    Args:
        scene: whose photos.
        choice: "truth", "scene" (masks/train), "run", or a folder; None takes the first of truth, run and
            scene that is there.
        run: folder of a run with masks/.
        keep: white means keep in a folder of the user's; by default white means distractor.

    Raises:
        AwError: there is none, photos lack theirs, or `keep` is said of others than a folder's.
    """
    if keep and choice in (None, "truth", "scene", "run"):
        raise AwError(
            "--masks-white keep is of a folder given with --masks; all other masks say it themselves"
        )
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
                f"{scene.name} has no distractor masks: neither truth/distractor nor masks/train; give "
                "--masks DIR (PNG of the photo's stem, white = distractor) or --run RUN of a method that "
                "masks"
            )
    if choice == "truth":
        return Masks("truth", _all(scene, truth, "add them (all black where there is no distractor)"), False)
    if choice == "scene":
        folder = scene.root / "masks" / "train"
        return Masks("scene", _all(scene, folder, "add them (all white where there is no distractor)"), True)
    if choice == "run":
        if run is None:
            raise AwError("--masks run needs --run RUN, a folder of 'aw bench'")
        return Masks("run", _all(scene, run / "masks", "this method draws no masks; take another run"), True)
    wanted = "add them (all black where there is no distractor)"
    return Masks("folder", _all(scene, Path(choice), wanted), keep)


def _all(scene: Scene, folder: Path, advice: str) -> dict[str, Path]:
    if not folder.is_dir():
        raise AwError(
            f"there is no mask folder {folder} for {scene.name}: give --masks DIR, truth, scene or run"
        )
    found = {v.name: folder / f"{stem(v)}.png" for v in scene.train}
    missing = [name for name, path in found.items() if not path.is_file()]
    if missing:
        raise AwError(
            f"{len(missing)} of {len(found)} train photos have no mask in {folder}: {shortlist(missing)}; "
            + advice
        )
    return found


def load_mask(path: Path, view: View) -> np.ndarray:
    """White (128 and above) of a mask at the photo's size, [H, W] bool; another size is resampled.

    Raises:
        AwError: unreadable, or of another shape than the photo.
    """
    import cv2

    mask = read_gray(path)
    width, height = view.camera.width, view.camera.height
    if mask.shape != (height, width):
        if abs(mask.shape[1] * height - mask.shape[0] * width) > 0.02 * mask.shape[1] * height:
            raise AwError(
                f"mask {path} is {mask.shape[1]}x{mask.shape[0]}, its photo {width}x{height}: another shape; "
                "export it from the photo of the scene"
            )
        mask = cv2.resize(mask, (width, height), interpolation=cv2.INTER_NEAREST)
    return mask >= 128


class Background(Protocol):
    """What is behind the distractors."""

    source: str

    def load(self, index: int, view: View) -> tuple[np.ndarray | None, np.ndarray | None]:
        """Of train photo `index`: [H, W, 3] float32 in [0, 1] or None, and where it is known, [H, W] bool
        (None: everywhere)."""
        ...


class CleanBackground:
    """Clean versions of the photos; a photo without one is of unknown background."""

    source = "clean"

    def __init__(self, scene: Scene) -> None:
        self.folder = scene.root / "truth" / "clean"

    def load(self, index: int, view: View) -> tuple[np.ndarray | None, np.ndarray | None]:
        """See `Background`.

        Raises:
            AwError: it is of another size than the photo.
        """
        path = self.folder / f"{stem(view)}.png"
        if not path.is_file():
            return None, None
        image = load_image_float(path)
        if image.shape[:2] != (view.camera.height, view.camera.width):
            raise AwError(
                f"{path} is {image.shape[1]}x{image.shape[0]}, its photo {view.camera.width}x"
                f"{view.camera.height}; load the factor it was built for, or build it again"
            )
        return image, None


class NoBackground:
    """Nothing is known behind distractors: colour has no score."""

    source = "none"

    def load(self, index: int, view: View) -> tuple[np.ndarray | None, np.ndarray | None]:
        """See `Background`."""
        return None, None


def find_background(scene: Scene, choice: str | None, run: Path | None, masks: Masks) -> Background:
    """What to compare distractors with: clean versions where there are any, else the render of a run.

    Raises:
        AwError: there is neither, or the one asked for is not there.
    """
    clean = scene.root / "truth" / "clean"
    there = any((clean / f"{stem(v)}.png").is_file() for v in scene.train)
    if choice is None:
        choice = "clean" if there else "run" if run is not None else ""
    if choice == "clean" and there:
        return CleanBackground(scene)
    if choice == "run" and run is not None:
        from ambiguous_wild.harness.ambiguity.run_background import RunBackground

        return RunBackground(scene, run, masks)
    if choice == "none":
        return NoBackground()
    if choice == "run":
        raise AwError("--background run needs --run RUN, a folder of 'aw bench'")
    raise AwError(
        f"{scene.name} has no clean versions in {clean}: nothing is known behind its distractors; give "
        "--run RUN of a trained run, or --background none to leave colour out"
    )


def stem(view: View) -> str:
    """The photo's name without its suffix, as its mask is called."""
    return str(PurePosixPath(view.name).with_suffix(""))
