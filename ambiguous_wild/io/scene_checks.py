"""What every scene is asked when it is opened, whoever opens it: one table of checks."""

from __future__ import annotations

import math
from collections import Counter, defaultdict
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import lru_cache
from hashlib import sha256
from itertools import product
from pathlib import Path

import numpy as np

from ambiguous_wild.core import AwError, Scene, View
from ambiguous_wild.core.errors import counted, shortlist
from ambiguous_wild.core.scene import without_outliers
from ambiguous_wild.io.files import sha256_file
from ambiguous_wild.io.images import decode, load_image_float, read_alpha
from ambiguous_wild.io.mask_files import SPELLINGS

MIN_TRAIN = 2  # photos: one shows no depth
ASPECT = 2.0  # largest ratio of focal lengths; pixels of anamorphic lenses are 2:1
SAME_POSE = 1e-6  # largest difference of two equal poses, relative to the scene's size
SAME_PHOTO = 0.01  # mean difference of equal pictures that were compressed again, of 1
NEAR_POSE = 1e-3  # of two photos whose pictures are compared, relative to the scene's size
NO_BASELINE = 1e-4  # of the points' median distance: cameras, or points, no farther apart are at one place
FEW_POINTS = 10  # fewer are dummies, of scenes that start from a file
FEW_SEEN = 0.05  # share of the points in any training photo, below which poses or points are doubted
MAX_COMPARED = 8  # reduced photos that are compared with their full ones
COMPARED_SIDE = 64  # px, to which both are reduced
SAME_CONTENT = 0.95  # correlation of a reduced photo with its full one, below which it is another picture
MAX_POINTS = 5000  # points that are projected to find out whether photos show any
SHARED = (
    "test photos are training photos ({names}), so their scores say nothing: use each for training or for "
    "testing alone"
)
# Who finds the names of what is at fault -> what is said, with {names}, their {count}, the scene's {root}.
Checks = Mapping[Callable[[Scene], Iterable[str]], str]


def check_scene(scene: Scene) -> list[str]:
    """Return the warnings of a scene.

    Raises:
        AwError: it would give a wrong result.
    """
    for fault in _faults(scene, REFUSED):
        raise AwError(f"{scene.root}: {fault}")
    return list(_faults(scene, WARNED))


def _faults(scene: Scene, checks: Checks) -> Iterator[str]:
    for find, fault in checks.items():
        if names := list(find(scene)):
            yield fault.format(names=shortlist(names), count=len(names), root=scene.root)


def _few_train_photos(scene: Scene) -> list[str]:
    return [view.name for view in scene.train if len(scene.train) < MIN_TRAIN]


def _shared_photos(scene: Scene) -> list[str]:
    pairs = ((test, train) for views in _equal_files(scene) for test in views for train in views)
    equal = {(a.name, b.name) for a, b in pairs if (a.split, b.split) == ("test", "train")}
    return sorted(f"{a} is {b}" for a, b in equal | set(_equal_pixels(scene)))


def _equal_pixels(scene: Scene) -> Iterator[tuple[str, str]]:
    """Test and train photos of equal pixels, as of a PNG that was written again."""
    if not scene.train or not scene.test:
        return
    with ThreadPoolExecutor() as pool:
        hashes = list(pool.map(_small_hash, (view.image_path for view in scene.views)))
    alike = defaultdict(list)
    for view, found in zip(scene.views, hashes, strict=True):
        if found is not None:
            alike[found].append(view)
    for views in alike.values():
        for test, train in product(*([v for v in views if v.split == side] for side in ("test", "train"))):
            first, second = (load_image_float(v.image_path) for v in (test, train))
            if np.array_equal(first, second):
                yield test.name, train.name


def _small_hash(path: Path) -> bytes | None:
    state = path.stat()
    return _small_hash_of(path, state.st_size, state.st_mtime_ns)


@lru_cache(maxsize=16_384)
def _small_hash_of(path: Path, size: int, mtime_ns: int) -> bytes | None:
    """Return the hash of a photo at an eighth of its size, which JPEG decodes fast; None if of one grey."""
    import cv2

    small = decode(np.fromfile(path, np.uint8), cv2.IMREAD_REDUCED_GRAYSCALE_8, str(path))
    if small is None or not np.ptp(small):
        return None
    return sha256(repr(small.shape).encode() + small.tobytes()).digest()


def _repeated_photos(scene: Scene) -> list[str]:
    groups = ([view.name for view in views if view.split == "train"] for views in _equal_files(scene))
    return [" = ".join(names) for names in groups if len(names) > 1]


def _equal_files(scene: Scene) -> list[list[View]]:
    sizes = {view.name: view.image_path.stat().st_size for view in scene.views}
    count, equal = Counter(sizes.values()), defaultdict(list)
    for view in scene.views:
        if count[sizes[view.name]] > 1:
            equal[sha256_file(view.image_path)].append(view)
    # pictures of a single colour are equal anywhere
    return [views for views in equal.values() if len(views) > 1 and _varied(views[0])]


def _varied(view: View) -> bool:
    return bool(np.ptp(load_image_float(view.image_path), axis=(0, 1)).any())


def _alike_photos(scene: Scene) -> Iterator[str]:
    """Photos of one pose and nearly one picture, as after a second compression."""
    if not scene.train or not scene.test:
        return
    train, test = (np.array([_pose(v, scene.extent) for v in views]) for views in (scene.train, scene.test))
    for row, other in zip(test, scene.test):
        for index in np.flatnonzero(np.abs(train - row).max(axis=1) < NEAR_POSE):
            view = scene.train[index]
            first, second = (load_image_float(v.image_path) for v in (view, other))
            if first.shape == second.shape and np.abs(first - second).mean() < SAME_PHOTO:
                yield f"{other.name} and {view.name}"


def _pose(view: View, extent: float) -> np.ndarray:
    camera = view.camera
    return np.concatenate([camera.cam_from_world[:3, :3].ravel(), camera.center / extent])


def _one_pose(scene: Scene) -> list[str]:
    turns = np.array([view.camera.cam_from_world[:3, :3] for view in scene.train])
    one = _one_position(scene) and np.ptp(turns, axis=0).max() < SAME_POSE
    return [view.name for view in scene.train if one]


def _at_one_place(xyz: np.ndarray, scene: Scene) -> bool:
    """Whether positions [N, 3] differ by less than `NO_BASELINE` of the points' median distance."""
    middle = np.median([view.camera.center for view in scene.train], axis=0)
    points = scene.points.xyz
    distance = float(np.median(np.linalg.norm(points - middle, axis=1))) if len(points) else 0.0
    return float(np.ptp(xyz, axis=0).max()) <= NO_BASELINE * distance


def _hidden_test_pixels(scene: Scene) -> Iterator[str]:
    return _with_alpha(scene, scene.test)


def _hidden_train_pixels(scene: Scene) -> list[str]:
    name = next(_with_alpha(scene, scene.train), None)  # the first is enough: each is decoded
    return [name] if name else []


def _with_alpha(scene: Scene, views: Sequence[View]) -> Iterator[str]:
    if "files" not in scene.info:  # else alpha became masks when the scene was made
        yield from (view.name for view in views if read_alpha(view.image_path) is not None)


def _other_reduced(scene: Scene) -> list[str]:
    full = scene.root / "images"
    if "files" in scene.info or scene.info.get("loaded_factor", 1) == 1 or not full.is_dir():
        return []
    pairs = ((view.image_path, full / view.name) for view in scene.views)
    return other_pictures([(small, photo) for small, photo in pairs if photo.is_file()])


def other_pictures(pairs: Sequence[tuple[Path, Path]]) -> list[str]:
    """Return names of reduced photos that do not show what their full photo shows, of some pairs of both."""
    chosen = pairs[:: max(1, -(-len(pairs) // MAX_COMPARED))]
    return [small.name for small, photo in chosen if _correlation(small, photo) < SAME_CONTENT]


def _correlation(small: Path, photo: Path) -> float:
    """Correlation of two pictures at the size of the smaller; 1 where one of them shows no contrast."""
    import cv2

    flags = cv2.IMREAD_GRAYSCALE | cv2.IMREAD_IGNORE_ORIENTATION
    read = (decode(np.fromfile(path, np.uint8), flags, str(path)) for path in (small, photo))
    grey = [pixels for pixels in read if pixels is not None]
    if len(grey) < 2:
        return 1.0  # reading the photo reports it
    size = [min(COMPARED_SIDE, side) for side in grey[0].shape[::-1]]
    first, second = (cv2.resize(pixels, size, interpolation=cv2.INTER_AREA).astype(float) for pixels in grey)
    first, second = first - first.mean(), second - second.mean()
    scale = math.sqrt(float((first**2).sum() * (second**2).sum()))
    return float((first * second).sum()) / scale if scale > 0 else 1.0


def _far_cameras(scene: Scene) -> list[str]:
    return sorted({view.name for view in scene.train} - {view.name for view in without_outliers(scene.train)})


def _one_position(scene: Scene) -> list[str]:
    centres = np.array([view.camera.center for view in scene.train])
    one = len(centres) >= MIN_TRAIN and _at_one_place(centres, scene)
    return [view.name for view in scene.train if one]


def _odd_principal_points(scene: Scene) -> list[str]:
    cameras = [(view.name, view.camera) for view in scene.train]
    return [n for n, c in cameras if not (0 <= c.cx <= c.width and 0 <= c.cy <= c.height)]


def _odd_focal_lengths(scene: Scene) -> list[str]:
    return [v.name for v in scene.views if not 1 / ASPECT <= v.camera.fx / v.camera.fy <= ASPECT]


def _one_point(scene: Scene) -> list[str]:
    xyz = scene.points.xyz
    return [scene.name] if len(xyz) > 1 and _at_one_place(xyz, scene) else []


def _no_point_in_view(scene: Scene) -> list[str]:
    xyz = scene.points.xyz
    if len(xyz) < FEW_POINTS or _any_share(scene, _some(xyz), 0.0) or _any_share(scene, xyz, 0.0):
        return []
    return [scene.name]


def _few_points_in_view(scene: Scene) -> list[str]:
    xyz = _some(scene.points.xyz)
    return [scene.name] if len(xyz) and not _any_share(scene, xyz, FEW_SEEN) else []


def _some(xyz: np.ndarray) -> np.ndarray:
    return xyz[:: max(1, len(xyz) // MAX_POINTS)]


def _any_share(scene: Scene, xyz: np.ndarray, share: float) -> bool:
    """Whether more than a share of the points [N, 3] lie in any training photo."""
    seen = np.zeros(len(xyz), bool)
    for view in scene.train:
        seen |= view.camera.has(*view.camera.project(xyz))
        if seen.mean() > share:
            return True
    return False


REFUSED: Checks = {  # the scene would give a wrong number
    _shared_photos: SHARED,
    _one_pose: "all {count} cameras have one pose, so nothing can be learnt of the scene; a capture needs "
    "photos from several positions: check the model's poses",
    _hidden_test_pixels: "alpha of test photos hides pixels ({names}), which would be measured as if they "
    "were visible; 'aw import {root} -o SCENE' makes masks of it",
    _other_reduced: "the reduced photos {names} do not show what their full photos in images/ show: remove "
    "them, or 'aw import {root} -o SCENE --factor N' without them",
    _one_point: "all points of the sparse model lie at one place, so nothing can be learnt from it: check "
    "the model",
    _no_point_in_view: "no point of the sparse model lies in any training photo: poses and points are of two "
    "models",
}
WARNED: Checks = {  # it is only unlikely
    _alike_photos: "test and training photos of one pose that look alike: {names}; check that no test photo "
    "trains",
    _repeated_photos: "training photos that are one file count more than others: {names}; keep one",
    _few_train_photos: "it has one training photo, which shows no depth; give at least two",
    _hidden_train_pixels: "alpha of training photos is used as keep masks, as of {names}",
    _far_cameras: "the cameras of {names} lie far from all others, so their poses are probably wrong; the "
    "scene's size is measured without them: check them, or take them out of train_list.txt",
    _one_position: "all cameras stand at one place, where photos show no depth: check the poses",
    _few_points_in_view: f"less than {FEW_SEEN:.0%} of the sparse model's points lie in any training photo: "
    "check that poses and points are of one model",
    _odd_principal_points: "principal points outside of the photos: {names}; check their cameras",
    _odd_focal_lengths: f"focal lengths of x and y differ more than {ASPECT:g} times: {{names}}; check their "
    "cameras",
}


def check_masks(
    folder: Path, files: set[Path], used: Mapping[str, Path], tests: Collection[Path], train: Sequence[str]
) -> list[str]:
    """Return the warnings of a folder of keep masks that lies beside a plain COLMAP scene.

    Args:
        folder: of the masks.
        files: all masks in it.
        used: mask of each train photo that has one.
        tests: masks of test photos, which only measure.
        train: names of the train photos.

    Raises:
        AwError: there are masks, and none is of a photo of the scene.
    """
    strange = shortlist(str(path.relative_to(folder)) for path in sorted(files - {*used.values(), *tests}))
    if strange and not used and not tests:
        raise AwError(
            f"{folder} holds {counted(len(files), 'mask')}, none of a photo of the scene ({strange}): "
            f"{SPELLINGS}; rename them, move the folder away, or 'aw import --no-masks'"
        )
    warnings = [f"masks that belong to no photo: {strange} ({SPELLINGS})"] if strange else []
    if used:
        without = shortlist(name for name in train if name not in used)
        lacking = f"; without a mask, so all of them trains: {without}" if without else ""
        warnings.append(
            f"keep masks of {len(used)} of {len(train)} training photos in {folder} are used{lacking}; "
            "'aw import --no-masks' makes a scene without"
        )
    if tests:
        warnings.append(f"psnr_valid leaves out what keep masks of {counted(len(tests), 'test photo')} hide")
    return warnings
