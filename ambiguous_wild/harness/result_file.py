"""The records of a run as they stand in its files, and the reader and writer of its result.

A record is a plain dict with the keys of its file. A result (`metrics.json`, or `failed.json`) is checked
when it is written and when it is read. It keeps the values of every image, never only their mean. JSON has
no infinity: it is written as the string "inf" and read back as a number. A missing value is ``null`` in the
file, and its reason stands under "missing".
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, Literal, NoReturn, NotRequired, Required, TypedDict, cast

import msgspec
import numpy as np
from msgspec import Meta

from ambiguous_wild.core import AwError
from ambiguous_wild.core.config import config_hash
from ambiguous_wild.core.errors import shortlist
from ambiguous_wild.harness.measures import MASK_LABELS, ImageRow, MetricRecord, measure, register_columns
from ambiguous_wild.io.files import sha256_file, unique_keys, write_json
from ambiguous_wild.metrics import stats

Status = Literal["ok", "failed"]
NotNegative = Annotated[float, Meta(ge=0.0)]
Count = Annotated[int, Meta(ge=0, le=10**15)]  # more is no number of anything
Finite = Annotated[float, Meta(ge=-1e300, le=1e300)]
Name = Annotated[str, Meta(pattern=r"\S")]
Options = dict[str, Any]  # plain values of a method's options: every method has its own keys
NOT_BEGUN = "masks had not begun"  # begins the reason why a short run has none
RunFacts = dict[str, Any]  # of a run; beside the keys of `Cell.result`, methods and effects add their own
# Keys of config.yaml that do not decide the result: how often the run is saved and probed, what happens at
# values that are not finite (the result says so where there were any), where the scene lies.
IGNORED: dict[str, tuple[str, ...]] = {
    "train": ("checkpoint_every_s", "probes", "on_nonfinite"),
    "scene": ("path",),
    "start": ("path",),
    "corrections": ("path",),
}
SCHEMA = 1
RESULT = "metrics.json"
FAILED = "failed.json"  # same schema, status "failed"; counts where there is no metrics.json
MODEL = "point_cloud.ply"
STOPPED = "stopped"  # folder with the model as it was when Ctrl-C came; removed when the run ends
CONFIG = "config.yaml"
RENDERS = Path("renders") / "test"
RESTORE = "restore it, or train again with --overwrite always"


def metrics_of(row: ImageRow) -> dict[str, float | None]:
    """Return every metric of the row by name."""
    return {key: cast("float | None", value) for key, value in row.items() if key != "name"}


def mean_of(result: RunResult | None, metric: str) -> float:
    """Return the mean of a metric's finite values over the test views; NaN where a view has no value."""
    rows = [] if result is None else [metrics_of(row) for row in result["per_image"]]
    values = [row.get(metric) for row in rows if metric in row or not measure(metric).partial]
    return stats.mean([math.nan if value is None else value for value in values])


def mask_scores(result: RunResult) -> dict[str, float]:
    """Return the mask scores that a result has, by the keys of `MASK_LABELS`."""
    scores = result["masks"] or {}
    return {k: v for k, v in scores.items() if k in MASK_LABELS and isinstance(v, float | int)}


class MaskScores(TypedDict, total=False):
    """Predicted distractor pixels against the exact ones, over all train photos together."""

    iou: float | None
    precision: float | None
    recall: float | None
    images: int


# (seconds of training so far, seconds of the kernel)
Sample = Annotated[list[NotNegative], Meta(min_length=2, max_length=2)]


class TimeRecord(TypedDict, total=False):
    """The evidence of whether the time of a run can be compared, see `timing.py`."""

    verdict: Required[Literal["alone", "contended", "unknown"]]
    reason: Required[str]  # empty for "alone"
    kernel: str  # of the calibration
    kernel_reference_s: NotNegative  # its seconds on the reference machine
    samples: list[Sample]
    parallel_share: float  # of the time in which several threads worked; the samples allow for it
    runs: int  # most runs of ours at once on this machine or GPU, this one included
    others: NotNegative  # processors that other programs used, mean over the run


class Cost(TypedDict, total=False):
    """Time, memory and size of a run. Unknown values are absent: an external program may report few."""

    train_s: float  # wall seconds
    cpu_s: float  # processor seconds of training, child processes included
    reference_s: float  # training in seconds of the reference machine, see `timing.py`
    timing: TimeRecord
    setup_s: float  # features, masks and compilation before the first step
    iterations: Count
    passes: int  # number of trainings that these numbers include, where there was more than one
    first_pass_s: float  # the part of train_s that the first training took
    ms_per_iteration: float
    ms_parts: dict[str, float]  # by part of an iteration
    gaussians: Count
    peak_rss_mb: float
    peak_cuda_mb: float
    device: str
    threads: int
    fps: float  # median of several rounds
    fps_low: float
    fps_high: float
    model_mb: float  # of point_cloud.ply, 10^6 bytes


class Environment(TypedDict, total=False):
    """Versions and hardware, as in env.json."""

    ambiguous_wild: str
    commit: str  # of a clone, with "+changes" where files differ from it; absent where it is not known
    python: str
    platform: str
    cpu: str
    cores: int | None
    device: str
    packages: dict[str, str | None]  # None = not installed
    gpu: str
    gsplat_max_alpha: float  # differs between sources of gsplat


class Provenance(TypedDict):
    """The machine, the code and the command that made a result."""

    environment: Environment
    code_hash: str
    reproduce: str


class Rescore(TypedDict):
    """The metrics that `aw rescore` added to a result, and the code that computed them."""

    metrics: list[str]
    version: str
    code_hash: str


class RunResult(TypedDict):
    """A result file: metrics.json, or failed.json of a run that failed."""

    schema: int
    method: Name
    scene: Name
    seed: int
    status: Status
    error: str | None
    options: Options
    per_image: list[ImageRow]
    missing: dict[str, str]  # metric -> why it is missing
    masks: MaskScores | None  # None: no masks, or no exact ones to compare with
    facts: RunFacts  # of the method, its effects and the watchdog
    cost: Cost
    config_hash: str
    scene_hash: str
    version: str
    # results of earlier versions lack these
    environment: NotRequired[Environment]
    code_hash: NotRequired[str]
    reproduce: NotRequired[str]
    rescored: NotRequired[list[Rescore]]
    metrics: NotRequired[dict[str, MetricRecord]]  # of metrics that are not of this package
    model_sha256: NotRequired[str]  # of point_cloud.ply; also absent where the run has none
    render_sha256: NotRequired[dict[str, str]]  # test photo -> hash of its render


class SceneConfig(TypedDict):
    """The scene of a run."""

    name: str
    sha256: str
    factor: int | None  # of images_N; None = not known
    path: str
    background: NotRequired[list[float]]  # [3] in [0, 1]; absent: black


class TrainRecord(TypedDict):
    """The fields of `TrainConfig`, as plain values."""

    iterations: int
    budget_s: float | None
    seed: int | None  # None in ablation.json, which has several
    resolution: str
    max_gaussians: int | None
    torch_threads: int
    checkpoint_every_s: float
    probes: int
    on_nonfinite: str


class Continued(TypedDict):
    """Where a run went on from an earlier one that was shorter, or without corrections."""

    iteration: int  # that the earlier run had reached
    config_hash: str  # of the earlier run


class UnusualConfig(TypedDict, total=False):
    """Settings of a run that config.yaml holds only where they differ from the usual ones."""

    effects: list[str]
    protocol: str
    start: dict[str, str]  # sha256 and path of the file of --start
    corrections: dict[str, str]  # sha256 and path of the file of --corrections
    continued: list[Continued]  # in the order of training


class RunConfig(UnusualConfig):
    """config.yaml of a run: everything that decides its result, and where its scene lies."""

    method: str
    source: str  # hash of a plugin's file; empty for a method of ours
    options: Options
    train: TrainRecord
    scene: SceneConfig
    device: str
    version: str
    config_hash: NotRequired[str]  # added when it is written


def write_result(path: Path | str, result: Mapping[str, object]) -> None:
    """Check a result and write it atomically.

    Args:
        path: path of the file, usually RUNS/<scene>/<method>/seed<k>/metrics.json.
        result: a `RunResult`; infinite numbers become "inf", NaN becomes null.

    Raises:
        AwError: the result does not follow the schema.
    """
    data = encoded(result)
    _checked(data, str(path))
    write_json(path, data)


def read_result(path: Path | str) -> RunResult:
    """Read and check a result file.

    Returns:
        The result with numbers decoded: "inf" is ``math.inf`` again; null stays None.

    Raises:
        AwError: no such file, no JSON, another schema version, or a field that is absent or of the wrong
            type; the error names the file and the field.
    """
    path = Path(path)
    try:
        text = path.read_text(encoding="utf-8")
        data = json.loads(text, parse_constant=_no_constant, object_pairs_hook=unique_keys)
    except FileNotFoundError:
        raise AwError(f"no result file {path}") from None
    except (OSError, ValueError, RecursionError) as error:
        raise AwError(f"{path} is damaged ({error}); run 'aw bench' again to replace it") from None
    return _checked(data, str(path))


def config_identity(config: RunConfig | Mapping[str, Any]) -> str:
    """Return the sha256 of the settings that decide a run's result.

    Args:
        config: the resolved configuration, as in config.yaml; its own "config_hash" is ignored.

    Raises:
        ValueError: a number in it is not finite.
        TypeError: a value in it has no form in JSON.
    """
    settings: Options = {k: v for k, v in config.items() if k != "config_hash"}
    for part in IGNORED.keys() & settings.keys():
        settings[part] = {k: v for k, v in settings[part].items() if k not in IGNORED[part]}
    return config_hash(settings)


def artefact_hashes(run: Path, rows: Sequence[ImageRow]) -> dict[str, str | dict[str, str]]:
    """Return the hashes of a run's model and renders, as metrics.json keeps them."""
    model = {"model_sha256": sha256_file(run / MODEL)} if (run / MODEL).is_file() else {}
    return {
        **model,
        "render_sha256": {row["name"]: sha256_file(render_path(run, row["name"])) for row in rows},
    }


def render_path(run: Path, name: str) -> Path:
    """Return where a run keeps the render of a test photo."""
    return (run / RENDERS / name).with_suffix(".png")


def check_render(run: Path, result: RunResult, name: str) -> Path:
    """Return the path of a render; raise AwError where it is absent or not the one that was measured."""
    path = render_path(run, name)
    if not path.is_file():
        raise AwError(f"{run} lacks its render {path.relative_to(run)}: {RESTORE}")
    if sha256_file(path) != result.get("render_sha256", {}).get(name):
        raise AwError(f"{path} is not the render that was measured (not the hash in {RESULT}): {RESTORE}")
    return path


def check_whole(run: Path, result: RunResult) -> None:
    """Raise AwError where a finished run lacks its settings, or files that its result lists."""
    needed = [run / CONFIG] + [run / MODEL] * ("model_sha256" in result)
    needed += [render_path(run, name) for name in result.get("render_sha256", {})]
    if lacking := [str(path.relative_to(run)) for path in needed if not path.is_file()]:
        raise AwError(
            f"{run} is damaged, it lacks {shortlist(lacking)}: restore it, or delete the folder, and "
            "the same command trains it again"
        )


def check_model(run: Path, result: RunResult) -> None:
    """Raise AwError if the run's model is not the one that was measured; a program may keep none."""
    if "model_sha256" not in result and not (run / MODEL).is_file():
        return
    if not (run / MODEL).is_file() or sha256_file(run / MODEL) != result.get("model_sha256"):
        raise AwError(
            f"{run / MODEL} is not the model that was measured (another hash than in {RESULT}): {RESTORE}"
        )


def _checked(data: Any, where: str) -> RunResult:
    """Return the result with numbers decoded; raise AwError where it does not follow `RunResult`."""
    try:
        if not isinstance(data, dict):
            raise msgspec.ValidationError("it must hold one JSON object")
        if data.get("schema") != SCHEMA:
            raise msgspec.ValidationError(
                f"schema version {data.get('schema')!r}, this version reads {SCHEMA}"
            )
        data = data | {name: _decode(data[name]) for name in ("per_image", "cost", "masks") if name in data}
        # a number that was not finite is null, and another program may write a count with a point
        plain = data | {name: _plain(data[name]) for name in ("cost", "environment") if name in data}
        msgspec.convert(plain, RunResult)
        for name, kind in (("cost", Cost), ("masks", MaskScores)):  # keys of plugins and later versions
            more = {k: v for k, v in (plain.get(name) or {}).items() if k not in kind.__annotations__}
            msgspec.convert(more, dict[str, Finite | None])
        rows = {row["name"]: metrics_of(row) for row in data["per_image"]}
        if len(rows) < len(data["per_image"]):
            raise msgspec.ValidationError("an image is listed twice - at `$.per_image`")
        msgspec.convert(rows, dict[str, dict[str, float | None]])  # metrics of plugins and later versions too
        if any(kernel <= 0.0 for _, kernel in plain["cost"].get("timing", {}).get("samples", ())):
            raise msgspec.ValidationError("a calibration took no time - at `$.cost.timing.samples`")
        register_columns(data.get("metrics", {}))
        if data["status"] == "failed" and not data["error"]:
            raise msgspec.ValidationError("a failed run must say its error")
    except (msgspec.ValidationError, RecursionError) as error:
        why = (
            str(error)[:300].encode("ascii", "backslashreplace").decode()
        )  # a value may be long or unprintable
        raise AwError(
            f"{where} is no result file of this program: {why}; run 'aw bench' again to replace it"
        ) from None
    return cast(RunResult, data)


def _plain(value: Any) -> Any:
    """Return the value without null in objects, and with whole numbers as integers."""
    if isinstance(value, dict):
        return {k: _plain(v) for k, v in value.items() if v is not None}
    return int(value) if isinstance(value, float) and value.is_integer() and abs(value) < 1e15 else value


def _no_constant(name: str) -> NoReturn:
    raise ValueError(f"{name} is not JSON")


def encoded(value: Any) -> Any:
    """Return the value for JSON: null for NaN, "inf" and "-inf" for infinity, Python's own numbers."""
    if isinstance(value, Mapping):
        return {str(k): encoded(v) for k, v in value.items()}
    if isinstance(value, (list, tuple)):
        return [encoded(v) for v in value]
    if isinstance(value, (np.bool_, np.integer, np.floating)):
        value = value.item()
    if isinstance(value, float) and not math.isfinite(value):
        return None if math.isnan(value) else ("inf" if value > 0 else "-inf")
    return value


def _decode(value: Any) -> Any:
    if isinstance(value, dict):
        return {k: v if k == "name" else _decode(v) for k, v in value.items()}
    if isinstance(value, list):
        return [_decode(v) for v in value]
    return float(value) if value in ("inf", "-inf") else value
