"""Write renders and masks of a trained model and measure them; every number comes from 8-bit images."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

from ambiguous_wild.core import AwError, Camera, Scene, View
from ambiguous_wild.harness.measures import ImageRow, measure_images, metrics
from ambiguous_wild.harness.regions import exact_distractor, exact_shadow
from ambiguous_wild.harness.result_file import Cost, MaskScores
from ambiguous_wild.io.files import atomic_dir
from ambiguous_wild.io.images import read_png_rgb, to_uint8, write_png
from ambiguous_wild.io.mask_reasons import FILE as REASONS
from ambiguous_wild.io.mask_reasons import MaskReasons, reasons_of, write_reasons
from ambiguous_wild.methods.mask_policies import makes_masks
from ambiguous_wild.metrics import image as image_metrics
from ambiguous_wild.metrics import mask_scores as mask_metrics
from ambiguous_wild.splat import backend
from ambiguous_wild.splat.cpu.compile import threads
from ambiguous_wild.splat.step import Step
from ambiguous_wild.splat.trainer import Trainer

FPS_ROUNDS = 5
FPS_SECONDS = 1.0  # of all rounds: medians spread by 3 %, as in two seconds; by 4 % in half a second


@dataclass(frozen=True)
class TestPhoto:
    """A test view with its photo, [H, W, 3] uint8."""

    __test__ = False  # the name is the field's term, not a pytest class

    view: View
    photo: np.ndarray


Draw = Callable[[TestPhoto], torch.Tensor]  # the picture of a test view, [H, W, 3] in [0, 1] after clamping


def load_test_photos(scene: Scene) -> list[TestPhoto]:
    """Read the test views' photos as 8-bit RGB.

    Raises:
        AwError: a photo is too small to be measured; checked here, before anything is trained.
    """
    for view in scene.test:
        image_metrics.check_size(view.camera.height, view.camera.width)
    return [TestPhoto(view, read_png_rgb(view.image_path)) for view in scene.test]


def mean_psnr(truth: Sequence[TestPhoto], draw: Callable[[Camera], np.ndarray]) -> float:
    """Return the mean PSNR in dB over the test views, from 8-bit images."""
    return float(np.mean([image_metrics.psnr(to_uint8(draw(t.view.camera)), t.photo) for t in truth]))


def render_and_measure(
    draw: Draw,
    truth: list[TestPhoto],
    folder: Path,
    *,
    scene: Scene,
    half: bool = False,
) -> tuple[list[ImageRow], dict[str, str]]:
    """Render the test views to PNG and measure what was written.

    Args:
        draw: draws a test view: a trained model, or splats or pictures that an external program wrote.
        truth: the test photos.
        folder: where the PNG files are written.
        scene: the scene, for metrics of regions.
        half: NeRF-W's protocol: the right half, from W // 2, is measured.

    Returns:
        Metrics of each image, and the reason for each metric that is missing.
    """
    if not truth:
        return [], dict.fromkeys(metrics(), "the scene has no test views")

    def pictures() -> Iterator[tuple[str, np.ndarray, np.ndarray]]:
        for t in truth:
            path = temporary / Path(t.view.name).with_suffix(".png")
            path.parent.mkdir(parents=True, exist_ok=True)
            write_png(path, to_uint8(draw(t).cpu().numpy()))
            yield t.view.name, read_png_rgb(path), t.photo

    with atomic_dir(folder) as temporary:
        return measure_images(pictures(), metrics().values(), scene, half=half, around=kernel_threads)


def refuse_empty(truth: Sequence[TestPhoto], folder: Path) -> None:
    """Raise AwError if every render has a single colour while some photo has more: the model shows nothing.

    Args:
        truth: the test photos.
        folder: where the renders are.
    """
    renders = (read_png_rgb(folder / Path(t.view.name).with_suffix(".png")) for t in truth)
    if any(np.ptp(t.photo, axis=(0, 1)).any() for t in truth) and not any(
        np.ptp(render, axis=(0, 1)).any() for render in renders
    ):
        raise AwError(
            f"all {len(truth)} test renders have a single colour each: no Gaussian is in front of the test "
            "cameras; check poses, focal lengths, principal points and points of the scene"
        )


@contextmanager
def kernel_threads() -> Iterator[int]:
    """Let torch use as many threads as the CPU kernels until the `with` ends; yield their number."""
    before = torch.get_num_threads()
    torch.set_num_threads(threads())
    try:
        yield threads()
    finally:
        torch.set_num_threads(before)


def trained_renderer(trainer: Trainer, half: bool) -> Draw:
    """Return the function that renders test views of a trained model.

    `half`: colour effects are fitted on the left half of the photo, columns 0 to ceil(W / 2); nothing else is
    changed.
    """

    def draw(test: TestPhoto) -> torch.Tensor:
        if not half:
            return trainer.render(test.view.camera).image
        photo = torch.from_numpy(test.photo.astype(np.float32) / 255.0)
        keep = torch.zeros(photo.shape[:2])
        keep[:, : -(-photo.shape[1] // 2)] = 1.0
        return trainer.render_fitted(test.view.camera, photo, keep)

    return draw


def write_masks(trainer: Trainer, folder: Path) -> MaskScores | None:
    """Write the keep map of every train view and score it, see `write_keeps`; beside it, why it is so."""
    reasons: dict[str, MaskReasons] = {}

    def keeps() -> Iterator[tuple[View, np.ndarray]]:
        for index, view in enumerate(trainer.data.scene.train):
            if trainer.data.user_keep[index] is None and not makes_masks(trainer.hooks):
                continue  # everything is kept
            keep, why = explained_keep(trainer, _last_step(trainer, index))
            if why is not None:
                reasons[view.name] = why
            if keep is not None:
                yield view, (keep > 0.5).cpu().numpy()

    scores = write_keeps(trainer.data.scene, keeps(), folder)
    write_reasons(folder.parent / REASONS, reasons)
    return scores


def keep_maps(trainer: Trainer) -> Iterator[tuple[View, np.ndarray]]:
    """Compute the keep map [H, W] bool of each train view that has one; each is rendered for it."""
    for index, view in enumerate(trainer.data.scene.train):
        step = _last_step(trainer, index)
        keep = trainer.combine_user_keep(step, trainer.hooks.mask.predict(step))
        if keep is not None:
            yield view, (keep > 0.5).cpu().numpy()


def _last_step(trainer: Trainer, view: int) -> Step:
    return trainer.make_step(max(trainer.iteration, 1), view, downsampling=1)


def explained_keep(trainer: Trainer, step: Step) -> tuple[torch.Tensor | None, MaskReasons | None]:
    """Return the keep map of the step's photo at its own size, and why its regions are masked or kept."""
    predicted, reasons = trainer.hooks.mask.predict_with_reasons(step)
    keep, own = trainer.combine_user_keep(step, predicted), trainer.data.user_keep[step.view]
    if own is None:
        return keep, reasons
    outside = (own <= 0.5).cpu().numpy()
    regions = np.full(outside.shape, -1) if reasons is None else reasons.regions.astype(int) - 1
    sentences = [] if reasons is None else list(reasons.sentences)

    def add(where: np.ndarray, sentence: str) -> None:
        regions[where] = len(sentences)
        sentences.append(sentence)

    add(outside, "masked: the capture's own mask leaves it out")
    by_hand = trainer.data.by_hand[step.view] if trainer.data.by_hand else None
    if by_hand is not None:
        add((by_hand < 0).cpu().numpy(), "masked: by hand")
        add((by_hand > 0).cpu().numpy(), "kept: by hand")
    return keep, reasons_of(regions, sentences)


def write_keeps(scene: Scene, keeps: Iterable[tuple[View, np.ndarray]], folder: Path) -> MaskScores | None:
    """Write keep maps [H, W] bool of train views (white = keep) and score them where the truth is known.

    Returns:
        IoU, precision and recall of the distractor pixels, counted over all photos together (a single photo
        has no precision where nothing is masked), or None without truth. Shadows and reflections of
        distractors are not counted: to mask them is as right as not to.
    """
    counts = []
    with atomic_dir(folder) as temporary:
        for view, keep in keeps:
            path = temporary / Path(view.name).with_suffix(".png")
            path.parent.mkdir(parents=True, exist_ok=True)
            write_png(path, keep.astype(np.uint8) * 255)
            truth = exact_distractor(scene, view)
            shadow = exact_shadow(scene, view)
            if truth is not None:
                scored = keep if shadow is None else keep | (shadow & ~truth)  # true negatives: in no score
                counts.append(mask_metrics.confusion(scored, ~truth))
    if not counts:
        return None
    total = mask_metrics.pooled(counts)
    return {"iou": total.iou, "precision": total.precision, "recall": total.recall, "images": len(counts)}


def frames_per_second(trainer: Trainer) -> Cost:
    """Measure the rendered frames per second over the views of the scene, after a warm-up.

    Returns:
        fps, the median of several rounds, and fps_low and fps_high, the slowest and the fastest round.
    """
    cameras = [v.camera for v in (trainer.data.scene.test or trainer.data.scene.train)]
    with torch.no_grad():
        for camera in cameras[:3]:
            trainer.render(camera)
    backend.wait(trainer.data.device)
    rounds = [_frames_per_second(trainer, cameras, FPS_SECONDS / FPS_ROUNDS) for _ in range(FPS_ROUNDS)]
    return {"fps": float(np.median(rounds)), "fps_low": min(rounds), "fps_high": max(rounds)}


@torch.no_grad()
def _frames_per_second(trainer: Trainer, cameras: list[Camera], least_s: float) -> float:
    frames, begin = 0, time.perf_counter()
    while True:
        trainer.render(cameras[frames % len(cameras)])
        backend.wait(trainer.data.device)
        frames += 1
        seconds = time.perf_counter() - begin
        if seconds >= least_s:
            return frames / seconds
