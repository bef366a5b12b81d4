"""Records that cross files: settings of a run (config.yaml), its result (metrics.json), where it was made.

All are plain dicts, with the keys that the files have. `result_file.py` checks a result when it is read.
"""

from __future__ import annotations

from typing import Any, Literal, NotRequired, Required, TypedDict, cast

Status = Literal["ok", "failed"]


class ImageRow(TypedDict, total=False):
    """Metrics of one test image; None = undefined there. A plugin or later version may add others."""

    name: Required[str]  # of the test view
    psnr: float | None
    ssim: float | None
    ssim_inria: float | None
    flip: float | None
    psnr_affine: float | None
    lpips_alex: float | None
    lpips_vgg: float | None
    lpips_vgg_01: float | None
    psnr_valid: float | None  # this and the next three: absent where the image has no such pixel
    psnr_covered: float | None
    psnr_uncovered: float | None
    psnr_supported: float | None


def image_row(name: str, metrics: dict[str, float]) -> ImageRow:
    """The row of one test image."""
    return cast(ImageRow, {"name": name, **metrics})


def metrics_of(row: ImageRow) -> dict[str, float | None]:
    """Every metric of the row, by name."""
    return {key: cast("float | None", value) for key, value in row.items() if key != "name"}


class MaskScores(TypedDict):
    """Predicted distractor pixels against the exact ones, over all train photos together."""

    iou: float | None
    precision: float | None
    recall: float | None
    images: int


class TimeRecord(TypedDict, total=False):
    """How far the time of a run can be trusted, see `timing.py`."""

    verdict: Required[Literal["alone", "contended", "unknown"]]
    reason: Required[str]  # empty for "alone"
    kernel: str  # of the calibration
    kernel_reference_s: float  # its seconds on the reference machine
    samples: list[list[float]]  # (seconds of training so far, seconds of the kernel)
    parallel_share: float  # of the time in which several threads worked; the samples allow for it
    runs: int  # most runs of ours at once on this machine or GPU, this one included
    others: float  # processors that other programs used, mean over the run


class Cost(TypedDict, total=False):
    """What a run took. What is unknown is absent: an external program may know little."""

    train_s: float  # wall seconds
    cpu_s: float  # processor seconds of training, child processes included
    reference_s: float  # training in seconds of the reference machine, see `timing.py`
    timing: TimeRecord
    setup_s: float  # features, masks and compilation before the first step
    iterations: int
    passes: int  # trainings that all of this counts, where there was more than one
    first_pass_s: float  # of train_s, that of the first
    ms_per_iteration: float
    ms_parts: dict[str, float]  # by part of an iteration
    gaussians: int
    peak_rss_mb: float
    peak_cuda_mb: float
    device: str
    threads: int
    fps: float  # median of several rounds
    fps_low: float
    fps_high: float
    model_mb: float  # of point_cloud.ply, 10^6 bytes


class Environment(TypedDict):
    """Versions and hardware, as in env.json."""

    ambiguous_wild: str
    python: str
    platform: str
    cpu: str
    cores: int | None
    device: str
    packages: dict[str, str | None]  # None = not installed
    gpu: NotRequired[str]
    gsplat_max_alpha: NotRequired[float]  # differs between sources of gsplat


class Provenance(TypedDict):
    """Where a result was made, from which code, and the command that makes it again."""

    environment: Environment
    code_hash: str
    reproduce: str


class Rescore(TypedDict):
    """Metrics that `aw rescore` added to a result, and by which code."""

    metrics: list[str]
    version: str
    code_hash: str


class RunResult(TypedDict):
    """A result file: metrics.json, or failed.json of a run that failed."""

    schema: int
    method: str
    scene: str
    seed: int
    status: Status
    error: str | None
    options: dict[str, Any]  # of the method
    per_image: list[ImageRow]
    missing: dict[str, str]  # metric -> why it is missing
    masks: MaskScores | None  # None: no masks, or no exact ones to compare with
    facts: dict[str, Any]  # of the method, its effects and the watchdog
    cost: Cost
    config_hash: str
    scene_hash: str
    version: str
    # results of earlier versions lack these
    environment: NotRequired[Environment]
    code_hash: NotRequired[str]
    reproduce: NotRequired[str]
    rescored: NotRequired[list[Rescore]]


class SceneConfig(TypedDict):
    """The scene of a run."""

    name: str
    sha256: str
    factor: int | None  # of images_N; None = not known
    path: str


class UnusualConfig(TypedDict, total=False):
    """Settings of a run that config.yaml holds only where they differ from the usual ones."""

    effects: list[str]
    protocol: str


class RunConfig(UnusualConfig):
    """config.yaml of a run: everything that decides its result, and where its scene lies."""

    method: str
    source: str  # hash of a plugin's file; empty for a method of ours
    options: dict[str, Any]
    train: dict[str, Any]  # fields of `TrainConfig`
    scene: SceneConfig
    device: str
    version: str
    config_hash: NotRequired[str]  # added when it is written
