"""`aw build-scene`: build a scene from photos."""

from __future__ import annotations

import json
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from ambiguous_wild.cli.options import (
    PathName,
    SectionedCommand,
    is_own_step,
    json_option,
    license_option,
    name_option,
    seed_option,
    threads_option,
)
from ambiguous_wild.core.processes import python_meanwhile
from ambiguous_wild.io.terminal import say

if TYPE_CHECKING:
    from ambiguous_wild.builder.pipeline import BuildResult

_CODE = (
    "import os\n"
    "if hasattr(os, 'nice'): os.nice(19)\n"
    "from ambiguous_wild.splat.calibration import warm_up\n"
    "warm_up()\n"
)


@contextmanager
def kernels_meanwhile() -> Iterator[None]:
    """Compile the CPU kernels at the lowest priority while the scene is built.

    Each kernel is kept as soon as it is compiled, and unfinished ones are left for later. Errors are ignored:
    the command that needs the kernels compiles what is missing and reports errors.
    """
    if _compiled():
        yield
        return
    with python_meanwhile(_CODE, {"NUMBA_NUM_THREADS": "1", "OMP_NUM_THREADS": "1"}):
        yield


def _compiled() -> bool:
    """Tell whether the kernel that is compiled last is on disk for the present source."""
    from ambiguous_wild.io.numba_cache import kernel_cache

    return any(kernel_cache().rglob("adam.catch_up-*.nbi"))


@click.command("build-scene", cls=SectionedCommand)
@click.argument("raw", type=PathName(), nargs=-1, required=True)
@click.option("-o", "--output", required=True, type=PathName(), help="Scene folder to make.")
@click.option(
    "--factor", type=int, help="Downsampling.  [default: the largest of 1, 2, 4, 8 that leaves 480 px]"
)
@click.option(
    "--camera",
    type=click.Choice(["auto", "single", "per-device", "per-folder", "per-image"]),
    default="auto",
    show_default=True,
    help="Photos that share a camera model; auto: decided by EXIF, photo size and folder.",
)
@click.option(
    "--sfm",
    type=click.Choice(["auto", "fast", "thorough"]),
    default="auto",
    show_default=True,
    help="Structure from motion; auto: fast, and more if fast leaves photos out.",
)
@click.option(
    "--matcher",
    type=click.Choice(["auto", "exhaustive", "sequential", "retrieval"]),
    default="auto",
    show_default=True,
    help="Pairs of photos to match: all, neighbours in order, or similar ones; auto: all up to 25 photos "
    "(thorough: 200), else similar ones.",
)
@click.option(
    "--mapper",
    type=click.Choice(["incremental", "global", "truth"]),
    default="incremental",
    show_default=True,
    help="COLMAP's mapper; global is faster on many photos, weaker on few. truth: no mapper, the exact cameras of "
    "a simulated capture.",
)
@click.option(
    "--part", type=int, default=1, show_default=True, help="Part to build, if photos fall into several."
)
@click.option(
    "--max-features",
    type=int,
    default=3000,
    show_default=True,
    help="SIFT features per photo; thorough uses 8000 or more of up to 100 photos.",
)
@click.option(
    "--keep-masks",
    "masks",
    type=PathName(),
    help="Folder of masks, white = keep, black = ignore: a.png or a.jpg.png.",
)
@click.option(
    "--masks-missing",
    type=click.Choice(["error", "keep"]),
    default="error",
    show_default=True,
    help="A photo without a mask: error refuses the capture, keep uses the whole photo.",
)
@click.option("--test-list", type=PathName(), help="File with the names of the test photos, one per line.")
@click.option("--no-test", is_flag=True, help="Train on all photos; nothing is measured then.")
@click.option("--strict", is_flag=True, help="Refuse the capture if one photo cannot be read.")
@threads_option
@seed_option("Seed of COLMAP's random choices.")
@name_option
@license_option
@click.option("--overwrite", is_flag=True, help="Replace a scene built from other photos or settings.")
@click.option("--keep-work", is_flag=True, help="Keep the work folder with every stage and COLMAP's log.")
@json_option
def command(
    raw: tuple[Path, ...],
    output: Path,
    masks: Path | None,
    test_list: Path | None,
    threads: int | None,
    name: str | None,
    overwrite: bool,
    keep_work: bool,
    as_json: bool,
    **settings: Any,  # fields of `BuildSettings`
) -> None:
    """Build a scene from the photos in RAW: check, COLMAP, undistort, downsample, split.

    RAW holds photos directly, in images/, in train/ and test/ (clean photos for testing), or in folders of
    any name (front/, back/); several RAW become one scene. They are not changed. If the build is killed,
    the same command continues it.
    """
    from ambiguous_wild.builder import scene_record
    from ambiguous_wild.builder.pipeline import build_scene
    from ambiguous_wild.builder.settings import BuildSettings
    from ambiguous_wild.core.config import from_plain
    from ambiguous_wild.core.names import check_name
    from ambiguous_wild.io.images import image_size

    settings["name"] = "" if name is None else check_name("scene name", name)
    # A core is idle while photos are registered, and training needs the kernels next.
    with kernels_meanwhile():
        result = build_scene(
            raw,
            output,
            from_plain(BuildSettings, settings),
            masks=masks,
            test_list=test_list,
            overwrite=overwrite,
            keep_work=keep_work,
            jobs=threads,
            progress=True,
        )
    info = result.info
    first = next(iter(sorted((result.scene / info["images"]).iterdir())))
    size = image_size(first)
    verdict = scene_record.verdict(info, size, None if is_own_step() else output)
    if as_json:
        click.echo(json.dumps(_facts(result, size, verdict), indent=2, ensure_ascii=False))
        return
    if result.up_to_date:
        say(f"{output} is up to date", out=True)
    for line in scene_record.summary_lines(info, test_advice=not is_own_step()):
        say(line, out=True)
    if not result.up_to_date:
        spent = ", ".join(f"{stage} {s:.1f}" for stage, s in info["seconds"].items())
        say(
            f"{result.seconds:.1f} s ({spent}; COLMAP {100 * scene_record.sfm_time_share(info):.0f} %)",
            out=True,
        )
    say(verdict, out=True)


def _facts(result: BuildResult, size: tuple[int, int], verdict: str) -> dict[str, object]:
    """Return scene.json without its long lists, and facts of this call."""
    long = ("files", "photos", "inputs")
    return {
        "scene": str(result.scene),
        "up_to_date": result.up_to_date,
        "wall_seconds": round(result.seconds, 3),
        "reused_stages": list(result.reused),
        "size": list(size),
        "verdict": verdict,
        **{k: v for k, v in result.info.items() if k not in long},
    }
