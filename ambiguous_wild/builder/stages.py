"""The stages of a build in order: what each reads, and the inputs that its result is stored under."""

from __future__ import annotations

import difflib
import os
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path, PurePosixPath

from ambiguous_wild.builder import scene_record
from ambiguous_wild.builder.collect import Capture
from ambiguous_wild.builder.diagnosis import check_registered, verified_pairs
from ambiguous_wild.builder.keep_masks import (
    add_fixed,
    alpha_mask,
    find_masks,
    mask_hashes,
    mask_warnings,
    write_colmap_masks,
)
from ambiguous_wild.builder.known_poses import read_known_cameras
from ambiguous_wild.builder.map_drawing import draw_scene_map
from ambiguous_wild.builder.moving_features import write_motion
from ambiguous_wild.builder.pose_hypothesis import TWO_POSES
from ambiguous_wild.builder.progress import Bar
from ambiguous_wild.builder.records import (
    PURE_ROTATION,
    BuildInputs,
    FeatureResult,
    KeyedRecord,
    MappingResult,
    MaskResult,
    MatchResult,
    PackageResult,
    PhotoSplit,
    ScreenedPhoto,
    ScreenResult,
)
from ambiguous_wild.builder.resample import auto_factor, check_factor, resample
from ambiguous_wild.builder.residual_flow import SIDE as FLOW_SIDE
from ambiguous_wild.builder.retrieval import FEW_PHOTOS, RELATIVE_POSES
from ambiguous_wild.builder.scene_package import SceneParts, package
from ambiguous_wild.builder.scene_record import BuildResults
from ambiguous_wild.builder.screen import panorama_warnings, screen, without_copies
from ambiguous_wild.builder.settings import BuildSettings, SfmPlan, plans
from ambiguous_wild.builder.sfm import DATABASE, StructureFromMotion, choose_camera
from ambiguous_wild.builder.workspace import StageResult, Workspace, content_key, versions
from ambiguous_wild.core.config import to_plain
from ambiguous_wild.core.errors import AwError, shortlist
from ambiguous_wild.io.colmap_model import read_model
from ambiguous_wild.io.colmap_records import ColmapModel
from ambiguous_wild.io.files import own_json, sha256_file
from ambiguous_wild.io.motion_points import FILE
from ambiguous_wild.io.scene_folder import ALL_TRAINED, MAP, TEST_EVERY, read_list


@dataclass(frozen=True)
class SfmStages:
    """Results of one attempt at structure from motion."""

    features: StageResult[FeatureResult]
    matches: StageResult[MatchResult]
    mapping: StageResult[MappingResult]

    @property
    def registered(self) -> int:
        """Number of photos in the largest component."""
        return max(map(len, self.mapping.facts["components"]), default=0)

    @property
    def contradicted(self) -> bool:
        """Whether covisible photos give a photo two poses, as where a bent path does not close."""
        return any(reason.startswith(TWO_POSES) for reason in self.mapping.facts["left_out"].values())


@dataclass
class Stages:
    """The inputs of one build, and its stages as methods."""

    capture: Capture
    settings: BuildSettings
    mask_folder: Path | None
    test_list: Path | None
    target: Path  # the scene folder to be
    jobs: int
    bar: Bar
    link: bool  # hard-link the stages' files into the scene

    @cached_property
    def inputs(self) -> BuildInputs:
        """Everything that the scene's files depend on."""
        _, copies = without_copies(self.capture)
        return {
            "photos": [
                [s.source, s.stem, s.side, s.sha256, *["copy"] * (s.source in copies)]
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
        capture, settings, inputs = self.capture, self.settings, self.inputs
        screened = work.run(
            "screen",
            [inputs["versions"], inputs["photos"], settings.strict, str(capture.root)],  # it links the photos
            lambda f: screen(capture, f, strict=settings.strict, jobs=self.jobs, bar=self.bar),
        )
        photos = [ScreenedPhoto(**fields) for fields in screened.facts["photos"]]
        sides = sorted((min(photo.size), photo.source, photo.name) for photo in photos)
        # Before the slow part the larger half of the photos; after it those that are registered.
        check_factor(settings.factor or 1, [side[:2] for side in sides[len(sides) // 2 :]])
        tests = read_test_list(self.test_list, photos) if self.test_list else None
        tests = set() if settings.no_test else tests
        masks = self._masks(work, screened, photos)
        sfm = self._sfm(work, screened, photos, masks)
        mapping, matches = sfm.mapping, sfm.matches
        model = read_model(mapping.folder / "0")
        registered = {image.name for image in model.images.values()}
        check_factor(settings.factor or 1, [side[:2] for side in sides if side[2] in registered])
        split = split_photos(photos, registered, tests)
        masks = self._fixed_masks(work, photos, masks, matches)
        factor = settings.factor or auto_factor([photo.size for photo in photos])
        flat = work.run(
            "undistort",
            [mapping.key, inputs["truth"], factor],
            lambda f: resample(
                f,
                model,
                photos,
                screened.folder / "photos",
                masks.folder / "masks" if masks else None,
                capture.truth,
                factor,
                jobs=self.jobs,
                bar=self.bar,
            ),
        )
        large = max(max(photo.size) for photo in photos) >= factor * FLOW_SIDE
        images = f"images_{factor}" if factor > 1 and large else "images"  # read for optical flow
        motion = work.run(
            "motion",
            [mapping.key, split.train, images],
            lambda f: write_motion(
                f,
                matches.folder / DATABASE,
                mapping.folder / RELATIVE_POSES,
                mapping.folder / "0",
                flat.folder / "sparse" / "0",
                flat.folder / images,
                split.train,
                self.jobs,
            ),
        )
        drawn = work.run(
            "map",
            [inputs["versions"], mapping.key, split.test],
            lambda f: draw_scene_map(
                f, model, mapping.facts, {photo.name: photo.source for photo in photos}, split.test
            ),
        )
        results = BuildResults(
            photos,
            screened.facts,
            sfm.features.facts,
            matches.facts,
            mapping.facts,
            masks.facts if masks else None,
            flat.facts,
            motion.facts,
            drawn.facts,
        )
        record: KeyedRecord = {
            **scene_record.scene_record(settings, results, model, split),
            "build_key": self.build_key,
            "inputs": inputs,
            "capture": _relative(capture.root, self.target),
            "seconds": {"collect": round(collect_s, 3), **work.seconds()},
        }
        if capture.truth and own_json(capture.truth / "capture.json").get("evaluation") == {
            "protocol": "half"
        }:
            record["evaluation"] = {"protocol": "half"}
        truth_files = [capture.truth / n for n in ("cameras.json", "capture.json")] if capture.truth else []
        parts = SceneParts(
            flat.folder,
            factor,
            split.train,
            split.test,
            [p for p in truth_files if p.is_file()],
            motion.folder / FILE,
            drawn.folder / MAP,
            [n for n in split.test if masks and n.removesuffix(".png") in masks.facts["kept_share"]],
        )
        return self._package(work, [flat.key, motion.key], parts, record)

    def _package(self, work: Workspace, keys: list[str], parts: SceneParts, record: KeyedRecord) -> Path:
        def run() -> StageResult[PackageResult]:
            return work.run(
                "package",
                [self.inputs, *keys],
                lambda f: package(f / "scene", parts, record, link=self.link, jobs=self.jobs),
            )

        done = run()
        # An earlier call may have moved the scene to the output, where the user deleted it.
        if not (done.folder / "scene").is_dir():
            work.forget(done)
            done = run()
        return done.folder / "scene"

    def _masks(
        self, work: Workspace, screened: StageResult[ScreenResult], photos: Sequence[ScreenedPhoto]
    ) -> StageResult[MaskResult] | None:
        root, mask_files = self.capture.root, {}
        if self.mask_folder is not None:
            mask_files = find_masks(self.mask_folder, photos, self.settings.masks_missing)
        elif all(alpha_mask(root, photo) is None for photo in photos):
            return None
        key = [screened.key, mask_hashes(mask_files)]
        return work.run("masks", key, lambda f: write_colmap_masks(f, mask_files, photos, root))

    def _fixed_masks(
        self,
        work: Workspace,
        photos: Sequence[ScreenedPhoto],
        masks: StageResult[MaskResult] | None,
        matches: StageResult[MatchResult],
    ) -> StageResult[MaskResult] | None:
        """Add what is fixed to the camera to the masks; without it they stay as they are."""
        fixed = matches.facts["fixed"]
        if not fixed:
            return masks
        before = masks.folder / "masks" if masks else None
        old: MaskResult = masks.facts if masks else {"kept_share": {}, "alpha": []}

        def add(folder: Path) -> MaskResult:
            shares = add_fixed(folder, photos, matches.folder, fixed, before, old["kept_share"])
            return {"kept_share": shares, "alpha": old["alpha"]}

        return work.run("fixed-masks", [matches.key, masks and masks.key], add)

    def _sfm(
        self,
        work: Workspace,
        screened: StageResult[ScreenResult],
        photos: Sequence[ScreenedPhoto],
        masks: StageResult[MaskResult] | None,
    ) -> SfmStages:
        attempts: list[SfmStages] = []
        known = read_known_cameras(self.capture.truth, photos) if self.settings.mapper == "truth" else None
        for plan in plans(photos, self.settings):
            registered = max((attempt.registered for attempt in attempts), default=0)
            most = [attempt for attempt in attempts if attempt.registered == registered]
            bent = bool(most) and most[-1].contradicted and len(photos) <= FEW_PHOTOS
            if registered >= plan.below * len(photos) and not bent:
                break
            if attempts:
                self.bar.say(f"{registered} of {len(photos)} photos registered: trying harder")
            before = attempts[-1] if attempts else None
            attempts.append(self._attempt(work, screened, photos, masks, plan, before, known))
        # Of attempts that register as many photos reliably, the last is taken, which is the most precise.
        best = max(reversed(attempts), key=lambda a: (a.mapping.facts["reliable"], a.registered))
        sources, wanted = {photo.name: photo.source for photo in photos}, self.settings.part
        components = best.mapping.facts["components"]
        parts = scene_record.part_lines(components, sources, wanted)
        if wanted > len(components) > 0:
            raise AwError(f"no part {wanted}: {'; '.join(parts) or 'the photos form one part'}; omit --part")
        built = best.mapping.facts["model"] is not None
        turned = set() if built else {PURE_ROTATION} & set(best.mapping.facts["left_out"].values())
        used = ["masks were used (white = keep): try without them"] if masks is not None else []
        used = mask_warnings(masks.facts if masks else None) or used
        check_registered(
            best.mapping.facts["model"],
            len(photos),
            len(screened.facts["skipped"]),
            best.matches.folder / DATABASE,
            best.matches.facts,
            self.settings.part,
            [
                *turned,
                *panorama_warnings(photos),
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
        photos: Sequence[ScreenedPhoto],
        masks: StageResult[MaskResult] | None,
        plan: SfmPlan,
        before: SfmStages | None,
        known: ColmapModel | None,
    ) -> SfmStages:
        """Return the results of a plan; those of the plan before where it finds the same pairs."""
        settings = self.settings
        sfm = StructureFromMotion(photos, screened.folder / "photos", settings, plan, self.jobs, self.bar)
        if known is None:
            camera = choose_camera(photos, settings.camera)
        else:
            camera = "single" if len(known.cameras) == 1 else "per-image"
        mask_folder = masks.folder / "masks" if masks else None
        features = work.run(
            "features",
            [screened.key, masks and masks.key, camera, plan.max_features, settings.max_side, plan.sift,
             settings.seed],
            lambda f: sfm.extract_features(f, camera, mask_folder),
        )  # fmt: skip
        earlier = before if plan.continues else None
        left_out = (sorted(earlier.mapping.facts["left_out"]) or None) if earlier else None
        matches = work.run(
            "matches",
            [features.key, plan.matcher, plan.ratio, plan.similar, plan.neighbours,
             earlier and earlier.matches.key, left_out, settings.seed],
            lambda f: sfm.match(f, features.folder, earlier.matches.folder if earlier else None, left_out),
        )  # fmt: skip
        if earlier and _same_pairs(earlier.matches, matches):
            return earlier  # mapping would end as before
        mapping = work.run(
            "mapping",
            [matches.key, settings.mapper, settings.part, to_plain(plan), settings.seed,
             *([self.inputs["truth"]] if known is not None else [])],
            lambda f: sfm.map(f, matches.folder, matches.facts["connected"], known),
        )  # fmt: skip
        return SfmStages(features, matches, mapping)


def _same_pairs(first: StageResult[MatchResult], second: StageResult[MatchResult]) -> bool:
    """Whether two searches verified the same pairs with as many inliers, and found the same fixed areas."""
    if first.facts["fixed"] != second.facts["fixed"]:
        return False
    return verified_pairs(first.folder / DATABASE) == verified_pairs(second.folder / DATABASE)


def split_photos(photos: Sequence[ScreenedPhoto], registered: set[str], tests: set[str] | None) -> PhotoSplit:
    """Split the registered photos into training and test photos.

    Args:
        photos: of the capture.
        registered: names of those in the model.
        tests: names in the user's test list; empty = train on all; None = by folders, else every 8th.

    Raises:
        AwError: fewer than two training photos, or a test set without a registered photo.
    """
    inside = sorted((photo for photo in photos if photo.name in registered), key=lambda photo: photo.stem)
    warnings = []
    if tests is not None:
        how, test = "list" if tests else ALL_TRAINED, [photo.name for photo in inside if photo.name in tests]
        wanted = len(tests)
    elif any(photo.side for photo in photos):
        how, test = "folders", [photo.name for photo in inside if photo.side == "test"]
        wanted = sum(photo.side == "test" for photo in photos)
    else:
        how, test = f"every-{TEST_EVERY}", [photo.name for photo in inside[::TEST_EVERY]]
        wanted = len(test)
        warnings.append(
            f"{scene_record.NO_TEST_SET}, so every {TEST_EVERY}th photo is a test photo: distractors in it "
            "count as truth in the scores; give clean photos in test/, or --test-list FILE"
        )
    train = [photo.name for photo in inside if photo.name not in test]
    if wanted and not test:
        raise AwError(
            f"none of the {wanted} test photos could be registered to the training photos: they show "
            "another place or too little overlap; take them nearer to the training views"
        )
    if len(train) < 2:
        raise AwError(f"only {len(train)} training photos could be registered; a scene needs at least 2")
    if len(test) < wanted:
        warnings.append(f"{wanted - len(test)} of {wanted} test photos are lost: scores cover {len(test)}")
    return PhotoSplit(train, test, how, warnings)


def read_test_list(path: Path, photos: Sequence[ScreenedPhoto]) -> set[str]:
    """Return the names of the photos in a test list.

    The list names photos by path, by file name or without extension.

    Raises:
        AwError: the file cannot be read or is empty, names an unknown photo, or names all photos.
    """
    try:
        lines = read_list(path)
    except (OSError, UnicodeDecodeError) as error:
        raise AwError(f"cannot read the test list {path}: {error}") from error
    by_line: dict[str, ScreenedPhoto] = {}
    by_ending: dict[str, dict[str, ScreenedPhoto]] = {}  # line -> name -> photo
    for photo in photos:
        source = PurePosixPath(photo.source)
        for key in (str(source), photo.stem, photo.name, *photo.copies):
            by_line.setdefault(key, photo)
        for i in range(len(source.parts)):
            end = PurePosixPath(*source.parts[i:])
            for key in (str(end), str(end.with_suffix(""))):
                by_ending.setdefault(key, {})[photo.name] = photo
    if twice := [line for line in lines if line not in by_line and len(by_ending.get(line, ())) > 1]:
        stems = sorted(photo.stem for photo in by_ending[twice[0]].values())
        raise AwError(
            f"{path}: {shortlist(map(repr, twice), 3)} is the name of several photos "
            f"({shortlist(stems, 3)}); write their folders too"
        )
    by_line = {key: next(iter(found.values())) for key, found in by_ending.items()} | by_line
    unknown = [line for line in lines if line not in by_line]
    if unknown:
        what = "a photo" if len(unknown) == 1 else f"{len(unknown)} photos"
        raise AwError(
            f"{path} names {what} not in the capture: "
            + shortlist((_with_nearest(line, by_line) for line in unknown), 3)
        )
    if not lines:
        raise AwError(f"{path} is empty; list test photos one a line, or leave out --test-list")
    tests = {by_line[line].name for line in lines}
    if len(tests) == len(photos):
        raise AwError(f"{path} names all {len(photos)} photos: no training photo would be left; list fewer")
    return tests


def _with_nearest(line: str, by_line: dict[str, ScreenedPhoto]) -> str:
    """Quote the unknown line and add the photo whose name is nearest to it."""
    near = difflib.get_close_matches(line, by_line, n=1, cutoff=0.5)
    return f"{line!r} (did you mean {by_line[near[0]].source!r}?)" if near else repr(line)


def _relative(folder: Path, base: Path) -> str:
    """Return a path from the scene, so that both can be moved together; on another drive the whole path."""
    try:
        return Path(os.path.relpath(folder, base.resolve())).as_posix()
    except ValueError:
        return folder.as_posix()


def _file_hashes(folder: Path | None) -> list[list[str]] | None:
    """Return [path, sha256] of every file below a folder; None without a folder."""
    if folder is None or not folder.is_dir():
        return None
    paths = sorted(p for p in folder.rglob("*") if p.is_file())
    return [[p.relative_to(folder).as_posix(), sha256_file(p)] for p in paths]
