"""The stages of a build in order: what each reads, and the inputs that its result is stored under.

A reconstruction that holds too few photos or points is refused here, with the likely cause.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np

from ambiguous_wild.builder import scene_record
from ambiguous_wild.builder.collect import Capture, read_test_list, split_photos
from ambiguous_wild.builder.diagnosis import check_registered
from ambiguous_wild.builder.downsample import auto_factor, check_factor, downsample
from ambiguous_wild.builder.keep_masks import (
    add_fixed,
    alphas,
    find_masks,
    lay_out_masks,
    mask_hashes,
    mask_warnings,
)
from ambiguous_wild.builder.map_drawing import FILE as MAP
from ambiguous_wild.builder.map_drawing import draw_built
from ambiguous_wild.builder.moving_features import write_motion
from ambiguous_wild.builder.progress import Bar
from ambiguous_wild.builder.records import (
    BuildInputs,
    FeatureResult,
    KeyedRecord,
    MappingResult,
    MaskResult,
    MatchResult,
    PackageResult,
    ScreenedPhoto,
    ScreenResult,
    UndistortResult,
)
from ambiguous_wild.builder.retrieval import RELATIVE_POSES
from ambiguous_wild.builder.scene_package import SceneParts, package
from ambiguous_wild.builder.screen import panorama_warnings, screen, without_copies
from ambiguous_wild.builder.settings import BuildSettings, SfmPlan, plans
from ambiguous_wild.builder.sfm import (
    DATABASE,
    choose_camera,
    extract_features,
    map_scene,
    match,
)
from ambiguous_wild.builder.workspace import StageResult, Workspace, content_key, versions
from ambiguous_wild.core.config import to_plain
from ambiguous_wild.core.errors import AwError
from ambiguous_wild.io.colmap_model import read_model
from ambiguous_wild.io.colmap_records import ColmapModel
from ambiguous_wild.io.files import sha256_file
from ambiguous_wild.io.images import read_png_rgb
from ambiguous_wild.io.motion_points import FILE


@dataclass(frozen=True)
class SfmStages:
    """One attempt at structure from motion."""

    features: StageResult[FeatureResult]
    matches: StageResult[MatchResult]
    mapping: StageResult[MappingResult]

    @property
    def registered(self) -> int:
        """Number of photos in the largest component."""
        return max(map(len, self.mapping.facts["components"]), default=0)


@dataclass
class Stages:
    """The inputs of one build, and its stages as methods."""

    capture: Capture
    settings: BuildSettings
    mask_folder: Path | None
    test_list: Path | None
    jobs: int
    bar: Bar
    link: bool  # hard-link the stages' files into the scene

    @cached_property
    def inputs(self) -> BuildInputs:
        """Everything that the scene's files depend on."""
        _, copies = without_copies(self.capture)
        return {
            "photos": [
                [s.relative, s.stem, s.side, s.sha256, *["copy"] * (s.relative in copies)]
                for s in self.capture.sources
            ],
            "masks": _file_hashes(self.mask_folder),
            "truth": _file_hashes(self.capture.truth),
            "test_list": sha256_file(self.test_list) if self.test_list and self.test_list.is_file() else None,
            "settings": to_plain(self.settings),
            "versions": versions(),
        }

    @cached_property
    def build_key(self) -> str:
        """Hash of the inputs; a scene with the same key is up to date."""
        return content_key(self.inputs)

    def run(self, work: Workspace, collect_s: float) -> Path:
        """Run the stages that are not finished.

        Args:
            work: holds the finished stages.
            collect_s: seconds spent on listing the photos, for scene.json.

        Returns:
            The scene folder, inside the work folder.
        """
        capture, settings, bar = self.capture, self.settings, self.bar
        inputs = self.inputs
        screened = work.run(
            "screen",
            [inputs["versions"], inputs["photos"], settings.strict],
            lambda f: screen(capture, f, strict=settings.strict, jobs=self.jobs, bar=bar),
        )
        facts = screened.facts["photos"]
        sides = sorted((min(f["width"], f["height"]), f["work_name"]) for f in facts)
        # Before the slow part the larger half of the photos; after it those that are registered.
        check_factor(settings.factor or 1, sides[len(sides) // 2 :])
        tests = read_test_list(self.test_list, facts) if self.test_list else None
        mask_stage = self._masks(work, screened)
        sfm = self._sfm(work, screened, mask_stage)
        mapping, features, matches = sfm.mapping, sfm.features, sfm.matches
        model = read_model(mapping.folder / "0")
        stems = {f["work_name"]: f["stem"] for f in facts}
        registered = {stems[i.name] for i in model.images.values()}
        check_factor(settings.factor or 1, [s for s in sides if stems[s[1]] in registered])
        train, test, how, split_warnings = split_photos(facts, registered, tests)
        mask_stage = self._fixed_masks(work, screened, mask_stage, matches)
        flat = self._undistort(work, screened, mask_stage, mapping, model)
        motion = work.run(
            "motion",
            [flat.key, train],
            lambda f: write_motion(
                f,
                matches.folder / DATABASE,
                mapping.folder / RELATIVE_POSES,
                mapping.folder / "0",
                flat.folder / "sparse" / "0",
                {work_name: f"{stem}.png" for work_name, stem in stems.items() if f"{stem}.png" in train},
            ),
        )
        drawn = work.run(
            "map",
            [inputs["versions"], mapping.key, test],
            lambda f: draw_built(
                f,
                model,
                mapping.facts,
                {fact["work_name"]: fact["source"] for fact in facts},
                [name for name, stem in stems.items() if f"{stem}.png" in test],
            ),
        )
        factor = settings.factor or auto_factor([(f["width"], f["height"]) for f in facts])
        small_key, small_folder = flat.key, None
        if factor > 1:
            small = work.run(
                "downsample",
                [inputs["versions"], flat.key, factor],
                lambda f: downsample(f, flat.folder, factor, jobs=self.jobs, bar=bar),
            )
            small_key, small_folder = small.key, small.folder
        record_of_build = scene_record.scene_record(
            settings,
            screened.facts,
            features.facts,
            matches.facts,
            mapping.facts,
            model,
            train=train,
            test=test,
            how=how,
            factor=factor,
            truth=flat.facts["truth"],
            motion=motion.facts,
            masks=mask_stage.facts if mask_stage else None,
            fixed=matches.facts["fixed"],
            warnings=[
                *mask_warnings(mask_stage.facts if mask_stage else None),
                *split_warnings,
                *scene_record.map_warnings(drawn.facts),
            ],
        )
        record: KeyedRecord = {
            **record_of_build,
            "build_key": self.build_key,
            "inputs": inputs,
            "seconds": {"collect": round(collect_s, 3), **work.seconds()},
        }
        truth_files = [capture.truth / n for n in ("cameras.json", "capture.json")] if capture.truth else []
        parts = SceneParts(
            flat.folder,
            small_folder,
            factor,
            train,
            test,
            [p for p in truth_files if p.is_file()],
            motion.folder / FILE,
            drawn.folder / MAP,
            [n for n in test if mask_stage and n.removesuffix(".png") in mask_stage.facts["kept_share"]],
        )
        return self._package(work, small_key, parts, record)

    def _package(self, work: Workspace, small_key: str, parts: SceneParts, record: KeyedRecord) -> Path:
        def run() -> StageResult[PackageResult]:
            return work.run(
                "package",
                [self.inputs, small_key],
                lambda f: package(f / "scene", parts, record, link=self.link, jobs=self.jobs),
            )

        done = run()
        # An earlier call may have moved the scene to the output, where the user deleted it.
        if not (done.folder / "scene").is_dir():
            work.forget(done)
            done = run()
        return done.folder / "scene"

    def _masks(self, work: Workspace, screened: StageResult[ScreenResult]) -> StageResult[MaskResult] | None:
        facts, mask_files = screened.facts["photos"], {}
        alpha = alphas(self.capture.root, facts)
        if self.mask_folder is not None:
            mask_files = find_masks(self.mask_folder, facts, self.settings.masks_missing)
        elif not alpha:
            return None
        key = [screened.key, mask_hashes(mask_files)]
        return work.run("masks", key, lambda f: lay_out_masks(f, mask_files, facts, alpha))

    def _fixed_masks(
        self,
        work: Workspace,
        screened: StageResult[ScreenResult],
        masks: StageResult[MaskResult] | None,
        matches: StageResult[MatchResult],
    ) -> StageResult[MaskResult] | None:
        """Add what is fixed to the camera to the masks; without it they stay as they are."""
        fixed = matches.facts["fixed"]
        if not fixed:
            return masks
        before, facts = masks.folder / "masks" if masks else None, screened.facts["photos"]
        old: MaskResult = masks.facts if masks else {"kept_share": {}, "alpha": []}

        def add(folder: Path) -> MaskResult:
            shares = add_fixed(folder, facts, matches.folder, fixed, before, old["kept_share"])
            return {"kept_share": shares, "alpha": old["alpha"]}

        return work.run("fixed-masks", [matches.key, masks and masks.key], add)

    def _sfm(
        self,
        work: Workspace,
        screened: StageResult[ScreenResult],
        masks: StageResult[MaskResult] | None,
    ) -> SfmStages:
        facts = screened.facts["photos"]
        attempts: list[SfmStages] = []
        for plan in plans(facts, self.settings):
            registered = max((attempt.registered for attempt in attempts), default=0)
            if registered >= plan.below * len(facts):
                break
            if attempts:
                self.bar.say(f"{registered} of {len(facts)} photos placed: trying harder")
            attempts.append(self._attempt(work, screened, masks, plan, attempts[-1] if attempts else None))
        # Of attempts that register equally many photos the last is taken, which is the most precise.
        best = max(reversed(attempts), key=lambda a: (a.mapping.facts["reliable"], a.registered))
        sources, wanted = {f["work_name"]: f["source"] for f in facts}, self.settings.part
        parts = scene_record.part_lines(best.mapping.facts["components"], sources, wanted)
        if wanted > len(best.mapping.facts["components"]) > 0:
            raise AwError(f"no part {wanted}: {'; '.join(parts) or 'the photos form one part'}; omit --part")
        used = ["masks were used (white = keep): try without them"] if masks is not None else []
        used = mask_warnings(masks.facts if masks else None) or used
        check_registered(
            best.mapping.facts["model"],
            len(facts),
            len(screened.facts["skipped"]),
            best.matches.folder / DATABASE,
            best.matches.facts,
            self.settings.part,
            [
                *panorama_warnings(facts),
                *used,
                *scene_record.fixed_lines(best.matches.facts["fixed"]),
                *parts,
                "'aw screen PHOTOS -o map.png' draws which photos overlap",
            ],
        )
        return best

    def _attempt(
        self,
        work: Workspace,
        screened: StageResult[ScreenResult],
        masks: StageResult[MaskResult] | None,
        plan: SfmPlan,
        before: SfmStages | None,
    ) -> SfmStages:
        settings, facts = self.settings, screened.facts["photos"]
        photos = screened.folder / "photos"
        camera = choose_camera(facts, settings.camera)
        mask_folder = masks.folder / "masks" if masks else None

        features = work.run(
            "features",
            [screened.key, masks and masks.key, camera, plan.max_features, settings.max_side, plan.sift,
             settings.seed],
            lambda f: extract_features(
                f, photos, facts, settings, plan, self.jobs, camera, mask_folder, self.bar
            ),
        )  # fmt: skip
        earlier = before if plan.continues else None
        left_out = (sorted(earlier.mapping.facts["left_out"]) or None) if earlier else None
        matches = work.run(
            "matches",
            [features.key, plan.matcher, plan.ratio, plan.similar, plan.neighbours,
             earlier and earlier.matches.key, left_out, settings.seed],
            lambda f: match(
                f, features.folder, facts, settings, plan, self.jobs, self.bar,
                earlier.matches.folder if earlier else None, left_out, photos=photos,
            ),
        )  # fmt: skip
        mapping = work.run(
            "mapping",
            [matches.key, settings.mapper, settings.part, to_plain(plan), settings.seed],
            lambda f: map_scene(
                f,
                matches.folder,
                photos,
                len(facts),
                matches.facts["connected"],
                settings,
                plan,
                self.jobs,
                self.bar,
            ),
        )
        return SfmStages(features, matches, mapping)

    def _undistort(
        self,
        work: Workspace,
        screened: StageResult[ScreenResult],
        masks: StageResult[MaskResult] | None,
        mapping: StageResult[MappingResult],
        model: ColmapModel,
    ) -> StageResult[UndistortResult]:
        from ambiguous_wild.builder.undistort import undistort

        photos = screened.folder / "photos"

        def read(fact: ScreenedPhoto) -> np.ndarray:
            return read_png_rgb(photos / fact["work_name"])

        return work.run(
            "undistort",
            [mapping.key, _file_hashes(self.capture.truth)],
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


def _file_hashes(folder: Path | None) -> list[list[str]] | None:
    """Return [path, sha256] of every file below a folder; None without a folder."""
    if folder is None or not folder.is_dir():
        return None
    paths = sorted(p for p in folder.rglob("*") if p.is_file())
    return [[p.relative_to(folder).as_posix(), sha256_file(p)] for p in paths]
