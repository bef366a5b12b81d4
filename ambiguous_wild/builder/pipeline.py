"""Build a scene from a folder of photos: resumable stages, and one rename at the end."""

from __future__ import annotations

import errno
import json
import os
import shutil
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import cast

from ambiguous_wild.builder import scene_record
from ambiguous_wild.builder.collect import collect, largest_photo
from ambiguous_wild.builder.progress import Bar
from ambiguous_wild.builder.records import SceneRecord
from ambiguous_wild.builder.settings import BuildSettings
from ambiguous_wild.builder.sfm import SfmCrash
from ambiguous_wild.builder.stages import Stages
from ambiguous_wild.builder.workspace import Workspace
from ambiguous_wild.core.errors import AwError
from ambiguous_wild.core.machine import photo_threads, usable_cores
from ambiguous_wild.core.names import check_name
from ambiguous_wild.io.files import check_output, folder_lock, refuse_foreign_files
from ambiguous_wild.io.scene_folder import load_scene, read_scene_json, verify_files

# Full disk, quota, permissions, read-only disk, broken disk: the user can repair these.
_DISK_ERRORS = {errno.ENOSPC, errno.EDQUOT, errno.EACCES, errno.EPERM, errno.EROFS, errno.EIO}


class OutputExists(AwError):
    """The output is a damaged scene, or was built from something else; it may be replaced on request."""


@dataclass(frozen=True)
class BuildResult:
    """A finished build."""

    scene: Path
    info: SceneRecord
    up_to_date: bool  # the scene was complete already
    seconds: float  # wall time of this call
    reused: tuple[str, ...] = ()  # stages that an earlier, interrupted call had finished

    def __repr__(self) -> str:
        counts = self.info["counts"]
        return f"BuildResult({self.scene}: {counts['train']} train and {counts['test']} test photos)"


def build_scene(
    raw: Path | str | Sequence[Path | str],
    output: Path | str,
    settings: BuildSettings | None = None,
    *,
    masks: Path | str | None = None,
    test_list: Path | str | None = None,
    overwrite: bool = False,
    keep_work: bool = False,
    jobs: int | None = None,
    progress: bool = False,
) -> BuildResult:
    """Build a scene folder from a folder of photos.

    After a kill at any moment the same call continues after the last finished stage and gives the same
    files. The output folder appears complete or not at all.

    Args:
        raw: folder with photos, with images/, with train/ and test/, or with folders of photos; or several
            folders, which become one scene. They are not changed.
        output: the scene folder.
        settings: see `BuildSettings`.
        masks: folder of keep masks (white = keep), used for features and copied to masks/.
        test_list: file with the names of the test photos, one a line.
        overwrite: replace a scene built from other photos or settings.
        keep_work: leave the hidden work folder with every stage and COLMAP's log.
        jobs: threads; None: one per core. The result does not depend on it.
        progress: show bars on standard error.

    Raises:
        AwError: no scene can be built from these photos, masks, lists or settings; the message says why.
    """
    started = time.perf_counter()
    target = Path(os.path.abspath(output))
    settings = settings or BuildSettings()
    if settings.no_test and test_list is not None:
        raise AwError("--no-test and --test-list exclude each other: give one of them")
    if settings.name:
        name = check_name("scene name", settings.name)
    else:
        name = check_name("scene name (the folder's; --name sets another)", target.name)
    settings = replace(settings, name=name)
    for one in [raw] if isinstance(raw, (str, Path)) else raw:
        _check_paths(one, target)
    mask_folder = Path(masks).resolve() if masks is not None else None
    capture = collect(raw, jobs or usable_cores(), mask_folder)
    count = jobs or photo_threads(largest_photo(capture))
    target = check_output(target)
    with folder_lock(target, "aw build-scene"):
        stages = Stages(
            capture,
            settings,
            mask_folder,
            Path(test_list).resolve() if test_list is not None else None,
            target,
            count,
            Bar(progress),
            link=not keep_work,
        )
        work_root = target.parent / f".{target.name}.build"
        finished = _existing(target, stages, overwrite)
        if finished is not None:
            if not keep_work:  # an earlier call was killed after its last rename
                shutil.rmtree(work_root, ignore_errors=True)
            return BuildResult(target, finished, True, time.perf_counter() - started)
        earlier = work_root.exists()
        work = Workspace(work_root)
        for note in capture.notes:
            stages.bar.say(note)
        _run(stages, work, target, started, keep_work, earlier)
    info: SceneRecord = json.loads((target / "scene.json").read_text(encoding="utf-8"))
    reused = tuple(r.name for r in work.results if r.reused)
    return BuildResult(target, info, False, time.perf_counter() - started, reused)


def _check_paths(raw: Path | str, target: Path) -> None:
    """Refuse to write a scene among the photos, and to build from a folder that is a scene already.

    Args:
        raw: the capture folder, as given.
        target: the scene folder, absolute.

    Raises:
        AwError: `target` holds the photos or lies among them, or `raw` is a scene already.
    """
    root, scene = Path(raw).resolve(), target.resolve()
    if root.is_relative_to(scene):
        raise AwError(f"{target} holds the photos themselves; choose another folder for -o")
    if scene.is_relative_to(root):
        raise AwError(
            f"{target} lies inside {raw}, the folder of photos, which must stay as it is; "
            "choose a folder outside it for -o"
        )
    part = next((n for n in ("scene.json", "sparse") if (root / n).exists()), None)
    if part is not None:
        raise AwError(
            f"{raw} is a scene already (it holds {part}): run 'aw bench' on it, or give the folder of the "
            "original photos"
        )


def _existing(target: Path, stages: Stages, overwrite: bool) -> SceneRecord | None:
    """Return scene.json of a scene that is up to date; None if there is work to do.

    Raises:
        AwError: the folder holds something else and may not be replaced.
    """
    if not target.exists():
        return None
    info = read_scene_json(target) if target.is_dir() else None
    if info is None:
        if target.is_dir() and not any(target.iterdir()):
            return None
        raise AwError(f"{target} exists and is no scene of 'aw build-scene'; choose another -o")
    if info.get("build_key") == stages.build_key:
        try:
            verify_files(target, info, quick=True)
        except AwError as error:
            if not overwrite:
                raise OutputExists(str(error)) from error
            refuse_foreign_files(target, {"scene.json", *info.get("files", {})})
            return None
        return cast(SceneRecord, info)
    if not overwrite:
        changed = scene_record.changed_inputs(info.get("inputs", {}), stages.inputs)
        raise OutputExists(
            f"{target} exists, built from other {changed}; pass --overwrite to replace it, or "
            "choose another -o"
        )
    refuse_foreign_files(target, {"scene.json", *info.get("files", {})})
    return None


def _run(
    stages: Stages, work: Workspace, target: Path, started: float, keep_work: bool, earlier: bool
) -> None:
    try:
        scene = stages.run(work, time.perf_counter() - started)
        load_scene(scene, verify=False)  # asks what every reader of the scene will ask
        _publish(scene, target, work)
    except SfmCrash:
        raise
    except OSError as error:
        if error.errno not in _DISK_ERRORS:
            raise
        where = f" ({error.filename})" if error.filename else ""
        raise AwError(
            f"cannot write the scene: {error.strerror}{where}; free space or change the permissions, "
            "then run the same command again: it goes on from the last finished stage"
        ) from error
    except AwError:
        # After the user's mistake a new work folder is deleted; that of an interrupted call stays, even if
        # the next call has a mistyped option.
        if not keep_work and not earlier:
            work.remove()
        raise
    finally:
        stages.bar.finish()
    if not keep_work:
        work.remove()


def _publish(scene: Path, target: Path, work: Workspace) -> None:
    if target.exists():
        os.replace(target, work.root / f"replaced-{time.time_ns()}")
    os.replace(scene, target)
