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
from ambiguous_wild.core.errors import AwError, counted
from ambiguous_wild.datasets.capture_hashes import (
    CAPTURES,
    CheckedCapture,
    check_capture,
    list_lines,
)
from ambiguous_wild.datasets.suites import Simulated, Suite
from ambiguous_wild.io.files import check_output, folder_lock, is_free, sweep_siblings
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
    mapper: Mapper = "truth" if exact_poses else "incremental"
    for number, (name, scene) in enumerate(folders.items(), 1):
        if not scene.exists():
            say(f"building scene {number} of {len(folders)}: {name}")
        settings = BuildSettings(factor=suite.factor, license=suite.license, mapper=mapper)
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
