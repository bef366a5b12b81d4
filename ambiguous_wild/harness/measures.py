"""The columns a table can have: label, digits and which way is better, as data."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal


@dataclass(frozen=True)
class Measure:
    """A column: how it is called, which way is better, how many digits are shown."""

    key: str  # as in the result file
    label: str
    better: Literal["higher", "lower", None]  # None: not ranked
    digits: int
    per_image: bool = True  # else one number a run
    timed: bool = False  # a busy machine changes it: ranked only between runs that were alone

    @property
    def quality(self) -> bool:
        """Whether it says how good the result is; the others say what it costs."""
        return self.per_image or self.key.startswith("mask_")


MEASURES: dict[str, Measure] = {
    m.key: m
    for m in (
        Measure("psnr", "PSNR", "higher", 2),
        Measure("ssim", "SSIM", "higher", 3),
        Measure("lpips_alex", "LPIPS alex", "lower", 3),
        Measure("ssim_inria", "SSIM Inria", "higher", 3),
        Measure("lpips_vgg", "LPIPS vgg", "lower", 3),
        Measure("lpips_vgg_01", "LPIPS vgg 01", "lower", 3),
        Measure("flip", "FLIP", "lower", 3),
        Measure("psnr_affine", "PSNR affine", "higher", 2),
        Measure("psnr_valid", "PSNR valid", "higher", 2),
        Measure("psnr_covered", "PSNR covered", "higher", 2),
        Measure("psnr_uncovered", "PSNR uncovered", "higher", 2),
        Measure("psnr_supported", "PSNR supported", "higher", 2),
        Measure("mask_iou", "mask IoU", "higher", 3, per_image=False),
        Measure("mask_precision", "mask precision", "higher", 3, per_image=False),
        Measure("mask_recall", "mask recall", "higher", 3, per_image=False),
        Measure("train_s", "train s", "lower", 1, per_image=False, timed=True),
        Measure("reference_s", "ref s", "lower", 1, per_image=False, timed=True),
        Measure("cpu_s", "cpu s", "lower", 1, per_image=False),
        Measure("setup_s", "setup s", "lower", 1, per_image=False, timed=True),
        Measure("iterations", "iterations", None, 0, per_image=False),
        Measure("ms_per_iteration", "ms/iter", "lower", 1, per_image=False, timed=True),
        Measure("fps", "FPS", "higher", 1, per_image=False, timed=True),
        Measure("gaussians", "Gaussians", "lower", 0, per_image=False),
        Measure("model_mb", "MB", "lower", 1, per_image=False),
        Measure("fps_low", "FPS low", "higher", 1, per_image=False, timed=True),
        Measure("fps_high", "FPS high", "higher", 1, per_image=False, timed=True),
        Measure("peak_rss_mb", "peak RSS MB", "lower", 0, per_image=False),
        Measure("peak_cuda_mb", "peak CUDA MB", "lower", 0, per_image=False),
    )
}
# Measured on part of a picture: one without such a pixel has no value, and is no gap in a mean.
PARTIAL = ("psnr_valid", "psnr_covered", "psnr_uncovered", "psnr_supported")
ALWAYS = ("psnr", "ssim", "lpips_alex")  # shown even where missing: the reason stands below the table
COST = ("train_s", "reference_s", "ms_per_iteration", "fps", "gaussians", "model_mb")
# A metric that is not listed takes its direction from its family: psnr_distractor is a PSNR.
FAMILIES: tuple[tuple[str, Literal["higher", "lower"], int], ...] = (
    ("psnr", "higher", 2),
    ("ssim", "higher", 3),
    ("lpips", "lower", 3),
)


def measure(key: str) -> Measure:
    """The column of that key; one that is not listed takes direction and digits from its family."""
    if key in MEASURES:
        return MEASURES[key]
    for family, better, digits in FAMILIES:
        if key == family or key.startswith(family + "_"):
            return Measure(key, key, better, digits)
    return Measure(key, key, None, 3)
