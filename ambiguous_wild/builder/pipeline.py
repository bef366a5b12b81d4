"""From a folder of photos to a scene: the stages in order, each resumable, the scene by one rename."""

from __future__ import annotations

import errno
import json
import os
import shutil
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from ambiguous_wild.builder import report
from ambiguous_wild.builder.collect import Capture, collect
from ambiguous_wild.builder.downsample import auto_factor, downsample
from ambiguous_wild.builder.masks import find_masks, lay_out_masks, mask_hashes
from ambiguous_wild.builder.package import Parts, package
from ambiguous_wild.builder.progress import Bar
from ambiguous_wild.builder.screen import screen
from ambiguous_wild.builder.settings import BuildSettings
from ambiguous_wild.builder.sfm import (
    DATABASE,
    SfmCrash,
    choose_camera,
    choose_matcher,
    extract_features,
    map_scene,
    match,
)
from ambiguous_wild.builder.split import read_test_list, split_photos
from ambiguous_wild.builder.versions import versions
from ambiguous_wild.builder.workspace import StageResult, Workspace, build_lock, content_key
from ambiguous_wild.core.config import to_plain
from ambiguous_wild.core.errors import AwError
from ambiguous_wild.io.colmap_model import Model, read_model
from ambiguous_wild.io.hashing import sha256_file
from ambiguous_wild.io.images import read_png_rgb
from ambiguous_wild.io.scene_folder import read_scene_json, verify_files

# Full disk, quota, rights, read-only disk, broken disk: the user's to mend.
_USERS_DISK = {errno.ENOSPC, errno.EDQUOT, errno.EACCES, errno.EPERM, errno.EROFS, errno.EIO}


@dataclass(frozen=True)
class BuildResult:
    """A finished build."""

    scene: Path
    info: dict[str, Any]  # scene.json
    up_to_date: bool  # nothing had to be done
    seconds: float  # wall time of this call
    reused: tuple[str, ...] = ()  # stages an earlier, interrupted call had finished


def build_scene(
    raw: Path | str,
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

    Killed at any moment, the same call goes on after the last finished stage and ends with the same
    files. The scene appears under its name at the very end, or not at all.

    Args:
        raw: photos directly in it, in images/, or in train/ and test/; nothing in it is changed.
        output: the scene folder.
        settings: see `BuildSettings`.
        masks: folder of keep masks (white = keep), used for features and carried to masks/train.
        test_list: file that names the test photos, one a line.
        overwrite: replace a scene built from other photos or settings.
        keep_work: leave the hidden work folder with COLMAP's log and every stage.
        jobs: threads; None takes every core. The result does not depend on it.
        progress: bars and lines on standard error.

    Raises:
        AwError: photos, masks, lists or settings that cannot become a scene, each with the reason.
    """
    started = time.perf_counter()
    target = Path(os.path.abspath(output))
    settings = settings or BuildSettings()
    settings = replace(settings, name=settings.name or target.name)
    count = jobs or os.cpu_count() or 1
    capture = collect(raw, count)
    if target == capture.root or capture.root.is_relative_to(target):
        raise AwError(f"{target} holds the photos themselves; choose another folder for -o")
    with build_lock(target):
        build = _Build(
            capture,
            settings,
            Path(masks).resolve() if masks is not None else None,
            Path(test_list).resolve() if test_list is not None else None,
            target,
            count,
            Bar(progress),
            keep_work,
        )
        known = build.existing(overwrite)
        if known is not None:
            return BuildResult(target, known, True, time.perf_counter() - started)
        info, reused = build.run(started)
    return BuildResult(target, info, False, time.perf_counter() - started, reused)


@dataclass
class _Build:
    """One build's inputs, and its stages as methods."""

    capture: Capture
    settings: BuildSettings
    mask_folder: Path | None
    test_list: Path | None
    target: Path
    jobs: int
    bar: Bar
    keep_work: bool

    @property
    def work_root(self) -> Path:
        return self.target.parent / f".{self.target.name}.build"

    def inputs(self) -> dict[str, Any]:
        """Everything the scene's files follow from, as plain data."""
        return {
            "photos": [[s.relative, s.stem, s.side, s.sha256] for s in self.capture.sources],
            "masks": _tree(self.mask_folder),
            "truth": _tree(self.capture.truth),
            "test_list": sha256_file(self.test_list) if self.test_list and self.test_list.is_file() else None,
            "settings": to_plain(self.settings),
            "versions": versions(),
        }

    def existing(self, overwrite: bool) -> dict[str, Any] | None:
        """scene.json of a scene that is up to date; None if there is work to do.

        Raises:
            AwError: the folder is taken by something else and may not be replaced.
        """
        if not self.target.exists():
            return None
        info = read_scene_json(self.target) if self.target.is_dir() else None
        if info is None:
            if self.target.is_dir() and not any(self.target.iterdir()):
                return None
            raise AwError(f"{self.target} exists and is no scene of 'aw build-scene'; choose another -o")
        if info.get("build_key") == content_key(self.inputs()):
            try:
                verify_files(self.target, info, quick=True)
            except AwError:
                if not overwrite:
                    raise
                return None
            if self.work_root.is_dir() and not self.keep_work:
                shutil.rmtree(self.work_root, ignore_errors=True)
            return info
        if not overwrite:
            changed = report.what_changed(info.get("inputs", {}), self.inputs())
            raise AwError(
                f"{self.target} exists, built from other {changed}; pass --overwrite to replace it, or "
                "choose another -o"
            )
        return None

    def run(self, started: float) -> tuple[dict[str, Any], tuple[str, ...]]:
        work = Workspace(self.work_root)
        try:
            info = self._stages(work, started)
        except SfmCrash:
            raise
        except OSError as error:
            if error.errno not in _USERS_DISK:
                raise
            where = f" ({error.filename})" if error.filename else ""
            raise AwError(
                f"cannot write the scene: {error.strerror}{where}; make room or mend the rights, then run "
                "the same command again: it goes on from the last finished stage"
            ) from error
        except AwError:
            # What the user must mend first leaves nothing behind; a kill or a crash keeps the work.
            if not self.keep_work:
                work.remove()
            raise
        finally:
            self.bar.finish()
        if not self.keep_work:
            work.remove()
        return info, tuple(r.name for r in work.results if r.reused)

    def _stages(self, work: Workspace, started: float) -> dict[str, Any]:
        capture, settings, bar = self.capture, self.settings, self.bar
        inputs = self.inputs()
        collected = time.perf_counter() - started
        screened = work.run(
            "screen",
            [inputs["versions"], inputs["photos"], settings.strict],
            lambda f: screen(capture, f, strict=settings.strict, jobs=self.jobs, bar=bar),
        )
        facts = screened.facts["photos"]
        tests = read_test_list(self.test_list, facts) if self.test_list else None
        mask_stage = self._masks(work, screened)
        mapping, features, matches = self._sfm(work, screened, mask_stage)
        best, model, others = _models(mapping)
        stems = {f["work_name"]: f["stem"] for f in facts}
        registered = {stems[i.name] for i in model.images.values()}
        train, test, how, split_warnings = split_photos(facts, registered, tests)
        flat = self._undistort(work, screened, mask_stage, mapping, model)
        factor = settings.factor or auto_factor([(f["width"], f["height"]) for f in facts])
        small = flat
        if factor > 1:
            small = work.run(
                "downsample",
                [inputs["versions"], flat.key, factor],
                lambda f: downsample(f, flat.folder, factor, jobs=self.jobs, bar=bar),
            )
        account = report.account(
            settings,
            screened.facts,
            features.facts,
            matches.facts,
            mapping.facts,
            best,
            model,
            others,
            matches.folder / DATABASE,
            train=train,
            test=test,
            how=how,
            factor=factor,
            truth=flat.facts["truth"],
            masks=mask_stage.facts if mask_stage else None,
            warnings=split_warnings,
        )
        account["build_key"] = content_key(inputs)
        account["inputs"] = inputs
        seconds = {"collect": round(collected, 3), **{r.name: r.seconds for r in work.results}}
        truth = capture.truth
        parts = Parts(
            flat.folder,
            small.folder if factor > 1 else None,
            factor,
            train,
            test,
            [p for n in ("cameras.json", "capture.json") if truth and (p := truth / n).is_file()],
        )

        account["seconds"] = seconds
        done = work.run(
            "package",
            [inputs, small.key],
            lambda f: package(f / "scene", parts, account, link=not self.keep_work, jobs=self.jobs),
        )
        self._publish(done.folder / "scene", work)
        return json.loads((self.target / "scene.json").read_text(encoding="utf-8"))

    def _masks(self, work: Workspace, screened: StageResult) -> StageResult | None:
        if self.mask_folder is None:
            return None
        facts = screened.facts["photos"]
        found = find_masks(self.mask_folder, facts, self.settings.masks_missing)
        return work.run("masks", [screened.key, mask_hashes(found)], lambda f: lay_out_masks(f, found, facts))

    def _sfm(
        self, work: Workspace, screened: StageResult, masks: StageResult | None
    ) -> tuple[StageResult, StageResult, StageResult]:
        settings, facts = self.settings, screened.facts["photos"]
        photos = screened.folder / "photos"
        camera = choose_camera(facts, settings.camera)
        matcher = choose_matcher(len(facts), settings.matcher)
        features = work.run(
            "features",
            [
                screened.key,
                masks and masks.key,
                camera,
                settings.max_features,
                settings.max_side,
                settings.seed,
            ],
            lambda f: extract_features(
                f,
                photos,
                facts,
                settings,
                self.jobs,
                camera,
                masks.folder / "masks" if masks else None,
                self.bar,
            ),
        )
        matches = work.run(
            "matches",
            [features.key, matcher, settings.seed],
            lambda f: match(f, features.folder, facts, settings, self.jobs, matcher, self.bar),
        )
        mapping = work.run(
            "mapping",
            [matches.key, settings.mapper, settings.seed],
            lambda f: map_scene(f, matches.folder, photos, len(facts), settings, self.bar),
        )
        from ambiguous_wild.builder.select_model import check_registered

        check_registered(
            mapping.facts["models"],
            len(facts),
            len(screened.facts["skipped"]),
            matches.folder / DATABASE,
            matches.facts,
        )
        return mapping, features, matches

    def _undistort(
        self,
        work: Workspace,
        screened: StageResult,
        masks: StageResult | None,
        mapping: StageResult,
        model: Model,
    ) -> StageResult:
        from ambiguous_wild.builder.undistort import undistort

        photos = screened.folder / "photos"
        read: Callable[[dict[str, Any]], Any] = lambda fact: read_png_rgb(photos / fact["work_name"])  # noqa: E731
        return work.run(
            "undistort",
            [mapping.key, _tree(self.capture.truth)],
            lambda f: undistort(
                f,
                model,
                screened.facts["photos"],
                read,
                masks.folder / "masks" if masks else None,
                self.capture.truth,
                jobs=self.jobs,
                bar=self.bar,
            ),
        )

    def _publish(self, scene: Path, work: Workspace) -> None:
        if self.target.exists():
            os.replace(self.target, work.root / f"replaced-{time.time_ns()}")
        os.replace(scene, self.target)


def _models(mapping: StageResult) -> tuple[int, Model, dict[int, Model]]:
    from ambiguous_wild.builder.select_model import choose_model

    listing = mapping.facts["models"]
    best, model = choose_model(mapping.folder, listing)
    others = {m["model"]: read_model(mapping.folder / str(m["model"])) for m in listing if m["model"] != best}
    return best, model, others


def _tree(folder: Path | None) -> list[list[str]] | None:
    """[path, sha256] of every file below a folder."""
    if folder is None or not folder.is_dir():
        return None
    paths = sorted(p for p in folder.rglob("*") if p.is_file())
    return [[p.relative_to(folder).as_posix(), sha256_file(p)] for p in paths]
