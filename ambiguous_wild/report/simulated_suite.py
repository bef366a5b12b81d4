"""Make the captures and the scenes of a simulated suite; what is there already is checked and kept.

SUITE/captures/NAME        by the preset NAME of `aw simulate`
SUITE/scenes/NAME          by `aw build-scene`
SUITE/scenes-truth/NAME    the same with the exact cameras
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any

from ambiguous_wild.builder.progress import Bar
from ambiguous_wild.builder.settings import BuildSettings, Mapper
from ambiguous_wild.core import Scene
from ambiguous_wild.core.config import to_plain
from ambiguous_wild.core.errors import AwError, counted, shortlist
from ambiguous_wild.datasets.capture_hashes import (
    CAPTURES,
    RECORD,
    CheckedCapture,
    check_capture,
    list_lines,
)
from ambiguous_wild.datasets.suites import Simulated, Suite, simulated_suites
from ambiguous_wild.io.files import check_output, folder_lock, is_free, own_json, sweep_siblings
from ambiguous_wild.io.original_photos import capture_folder
from ambiguous_wild.report.board_reproduce import dataset_of
from ambiguous_wild.report.suite import PreparedSuite
from ambiguous_wild.simulate.presets import preset, resized
from ambiguous_wild.simulate.spec import CaptureSpec
from ambiguous_wild.simulate.spec_file import plain_spec

SCENES, EXACT_SCENES = "scenes", "scenes-truth"  # below the suite's folder
Say = Callable[[str], None]


def make_captures(
    suite: Suite, root: Path, *, progress: bool = False, say: Say = lambda text: None
) -> tuple[CheckedCapture, ...]:
    """Simulate the captures of a suite that are not in `root`/captures, and check all.

    Each appears complete or not at all, so an interrupted call goes on with the next one.

    Args:
        suite: a simulated suite.
        root: folder of the suite.
        progress: show a bar.
        say: gets a line on captures that differ from the listed ones, or are in no list.

    Raises:
        AwError: `root` is a folder of something else; a capture is damaged, of other settings, or in work.
    """
    made = _simulated(suite)
    _check_root(suite, root)
    specs = {name: resized(preset(name), None, made.width) for name in suite.scenes}
    folders = {name: root / CAPTURES / name for name in suite.scenes}
    missing = [name for name in suite.scenes if is_free(folders[name])]
    checked = {n: _checked(suite, n, folders[n], specs[n]) for n in suite.scenes if n not in missing}
    bar = Bar(progress)
    if missing:
        photos = sum(specs[name].train_views + specs[name].test_views for name in missing)
        bar.start(f"simulating {counted(len(missing), 'capture')} of {suite.name}", photos)
    try:
        for name in missing:
            _simulate(specs[name], made.seed, folders[name], bar)
            checked[name] = _checked(suite, name, folders[name], specs[name])
    finally:
        bar.finish()
    captures = tuple(checked[name] for name in suite.scenes)
    for line in list_lines(captures):
        say(line)
    return captures


def _simulated(suite: Suite) -> Simulated:
    if suite.simulated is None:
        raise AwError(f"the captures of {suite.name} are photos of a real place, which cannot be simulated")
    return suite.simulated


def _check_root(suite: Suite, root: Path) -> None:
    """Refuse a folder of something else, before anything is written into it."""
    if not is_free(root) and not (root / CAPTURES).is_dir():
        raise AwError(
            f"{root} exists and has no folder {CAPTURES} of {suite.name}: name a new or empty folder, or "
            f"that of an earlier 'aw fetch {suite.name}'; for a scene of your own leave --suite out"
        )
    check_output(root / CAPTURES / "capture")


def _checked(suite: Suite, name: str, folder: Path, spec: CaptureSpec) -> CheckedCapture:
    """Check a capture, also against the present preset."""
    capture = check_capture(folder, name, suite)
    if capture.spec != json.loads(json.dumps(plain_spec(spec))):
        raise AwError(
            f"{folder} was made by another version of the preset {name} ({capture.version}): remove it, and "
            f"the scene that was built from it, then 'aw fetch {suite.name}' makes it again"
        )
    return capture


def _simulate(spec: CaptureSpec, seed: int, folder: Path, bar: Bar) -> None:
    from ambiguous_wild.harness.sheets import write_capture_sheet
    from ambiguous_wild.simulate.capture_writer import simulate

    def stepping(photos: Iterable[Any]) -> Iterator[Any]:
        for photo in photos:
            yield photo
            bar.step()

    with folder_lock(folder, f"aw, which simulates {spec.name}"):
        sweep_siblings(folder)  # left by a killed call
        if not simulate(spec, folder, seed, progress=stepping)["reused"]:
            write_capture_sheet(folder)


def prepare_simulated(
    suite: Suite,
    root: Path,
    *,
    exact_poses: bool = False,
    progress: bool = False,
    say: Say = lambda text: None,
) -> PreparedSuite:
    """Make the captures and scenes of a suite that are not in `root`, and check those that are.

    Args:
        suite: a simulated suite.
        root: folder of the suite.
        exact_poses: build the scenes with the exact cameras, without structure from motion.
        progress: show bars.
        say: gets a line on each step, and on captures that differ from the listed ones.

    Raises:
        AwError: as `make_captures`, or a scene cannot be built or was built from something else.
    """
    from ambiguous_wild.builder.pipeline import OutputExists, build_scene

    make_captures(suite, root, progress=progress, say=say)
    folders = {name: root / (EXACT_SCENES if exact_poses else SCENES) / name for name in suite.scenes}
    settings = _settings(suite, exact_poses)
    for number, (name, scene) in enumerate(folders.items(), 1):
        if not scene.exists():
            say(f"building scene {number} of {len(folders)}: {name}")
        try:
            build_scene(root / CAPTURES / name, scene, settings, progress=progress)
        except OutputExists as error:
            raise AwError(
                f"{scene} is damaged, or was built from another capture, by other settings or versions: "
                "remove it, and the same command builds it again"
            ) from error
        except AwError as error:
            raise AwError(f"{name}: {error}") from error
    return PreparedSuite(suite, folders, (), exact_poses)


def _settings(suite: Suite, exact_poses: bool) -> BuildSettings:
    mapper: Mapper = "truth" if exact_poses else "incremental"
    return BuildSettings(factor=suite.factor, license=suite.license, mapper=mapper)


def difference_from_suite(scene: Scene, dataset: str) -> str:
    """Return why a scene is not what a suite makes of a listed capture; empty if it is.

    Such scenes of two machines differ only in what structure from motion estimated.

    Args:
        scene: the scene, opened at the factor of a run.
        dataset: that of the run on the board.
    """
    info, name = dict(scene.info), scene.name
    suites = [
        (suite, exact)
        for suite in simulated_suites().values()
        for exact in (False, True)
        if name in suite.scenes and dataset_of(suite.dataset, exact) == dataset
    ]
    if not suites:
        return "other photos, split, size or poses"
    suite, exact = suites[0]
    settings, made = info.get("settings"), to_plain(_settings(suite, exact))
    if not isinstance(settings, dict):
        return "'aw build-scene' did not build it"
    if other := [key for key in made if key not in ("name", "license") and settings.get(key) != made[key]]:
        return f"it was built by other settings ({shortlist(other)})"
    if info.get("loaded_factor") != suite.factor:
        return f"the photos were loaded at factor {info.get('loaded_factor')}, not {suite.factor}"
    masks = [v.keep_path.relative_to(scene.root).as_posix() for v in scene.views if v.keep_path is not None]
    if info.get("split") != "folders" or not {*masks} <= {*scene.info["files"]}:
        return "it was given masks, or a list of test photos"
    try:
        folder = capture_folder(scene.root, info)
        capture = check_capture(folder, name, suite)
    except (AwError, OSError, ValueError, RecursionError) as error:  # scene.json may be a stranger's
        return str(error)
    if own_json(folder / RECORD).get("files") != own_json(scene.root / RECORD).get("files"):
        return f"it was not built from {folder}"
    return "" if capture.listed == capture.sha256 else f"{folder} is not the listed capture"
