"""What every scene is asked when it is opened, whoever opens it: one table of checks."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ambiguous_wild.core import AwError, Scene, View
from ambiguous_wild.core.errors import counted, shortlist
from ambiguous_wild.core.scene import together
from ambiguous_wild.io.files import sha256_file
from ambiguous_wild.io.images import load_image_float, read_alpha

LEAST_TRAIN = 2  # photos: one shows no depth
ASPECT = 2.0  # largest ratio of focal lengths; pixels of anamorphic lenses are 2:1
SAME_POSE = 1e-6  # largest difference of two equal poses, relative to the scene's size
SAME_PHOTO = 0.01  # mean difference of equal pictures that were compressed again, of 1
MOST_POINTS = 5000  # points that are projected to find out whether photos show any


@dataclass(frozen=True)
class SceneCheck:
    """One question to a scene; an answer is a fault."""

    refuse: bool  # else the user is warned
    answer: Callable[[Scene], str]  # empty: no fault


def check_scene(scene: Scene) -> list[str]:
    """Return the warnings of a scene.

    Raises:
        AwError: it would give a wrong result.
    """
    found = []
    for check in CHECKS:
        if fault := check.answer(scene):
            if check.refuse:
                raise AwError(f"{scene.root}: {fault}")
            found.append(fault)
    return found


def _few_train_photos(scene: Scene) -> str:
    if len(scene.train) >= LEAST_TRAIN:
        return ""
    return "it has one training photo, which shows no depth; give at least two"


def _shared_photos(scene: Scene) -> str:
    pairs = dict(_equal_files(scene))
    if not pairs:
        return ""
    named = shortlist(f"{test} is {train}" for test, train in sorted(pairs.items()))
    return (
        f"test photos are training photos ({named}), so their scores say nothing: take each out of "
        "train_list.txt or of test_list.txt"
    )


def _alike_photos(scene: Scene) -> str:
    named = shortlist(f"{test} and {train}" for test, train in sorted(_equal_views(scene)))
    if not named:
        return ""
    return f"test and training photos of one pose that look alike: {named}; check that no test photo trains"


def _equal_files(scene: Scene) -> Iterator[tuple[str, str]]:
    sizes = {view.image_path.stat().st_size for view in scene.test}
    train = [view for view in scene.train if view.image_path.stat().st_size in sizes]
    known = {sha256_file(view.image_path): view for view in train}
    for test in scene.test if known else ():
        view = known.get(sha256_file(test.image_path))
        if view is not None and _varied(view):  # pictures of a single colour are equal anywhere
            yield test.name, view.name


def _varied(view: View) -> bool:
    return bool(np.ptp(load_image_float(view.image_path), axis=(0, 1)).any())


def _equal_views(scene: Scene) -> Iterator[tuple[str, str]]:
    """Photos of one pose and nearly one picture, as after a second compression."""
    if not scene.train or not scene.test:
        return
    train, test = (np.array([_pose(v, scene.extent) for v in views]) for views in (scene.train, scene.test))
    for row, other in zip(test, scene.test):
        for index in np.flatnonzero(np.abs(train - row).max(axis=1) < SAME_POSE):
            view = scene.train[index]
            first, second = (load_image_float(v.image_path) for v in (view, other))
            if first.shape == second.shape and np.abs(first - second).mean() < SAME_PHOTO:
                yield other.name, view.name


def _pose(view: View, extent: float) -> np.ndarray:
    camera = view.camera
    return np.concatenate([camera.cam_from_world[:3, :3].ravel(), camera.center / extent])


def _one_pose(scene: Scene) -> str:
    poses = np.array([_pose(view, scene.extent) for view in scene.train])
    if len(poses) < LEAST_TRAIN or np.ptp(poses, axis=0).max() >= SAME_POSE:
        return ""
    return (
        f"all {len(poses)} cameras have one pose, so nothing can be learnt of the scene; a capture needs "
        "photos from several positions: check the model's poses"
    )


def _hidden_test_pixels(scene: Scene) -> str:
    names = list(_with_alpha(scene, scene.test))
    if not names:
        return ""
    return (
        f"alpha of {counted(len(names), 'test photo')} hides pixels ({shortlist(names)}), which would be "
        f"measured as if they were visible; 'aw import {scene.root} -o SCENE' makes masks of it"
    )


def _hidden_train_pixels(scene: Scene) -> str:
    name = next(_with_alpha(scene, scene.train), None)  # the first is enough: each is decoded
    return f"alpha of training photos is used as keep masks, as of {name}" if name else ""


def _with_alpha(scene: Scene, views: Sequence[View]) -> Iterator[str]:
    if "files" not in scene.info:  # else alpha became masks when the scene was made
        yield from (view.name for view in views if read_alpha(view.image_path) is not None)


def _far_cameras(scene: Scene) -> str:
    far = {view.name for view in scene.train} - {view.name for view in together(scene.train)}
    if not far:
        return ""
    return (
        f"the cameras of {shortlist(sorted(far))} lie far from all others, so their poses are probably "
        "wrong; the scene's size is measured without them: check them, or take them out of train_list.txt"
    )


def _one_position(scene: Scene) -> str:
    centres = np.array([view.camera.center for view in scene.train])
    if len(centres) < LEAST_TRAIN or np.ptp(centres, axis=0).any():
        return ""
    return "all cameras stand at one place, where photos show no depth: check the poses"


def _odd_principal_points(scene: Scene) -> str:
    cameras = [(view.name, view.camera) for view in scene.train]
    outside = [n for n, c in cameras if not (0 <= c.cx <= c.width and 0 <= c.cy <= c.height)]
    if not outside:
        return ""
    return f"principal points outside of the photos: {shortlist(outside)}; check their cameras"


def _odd_focal_lengths(scene: Scene) -> str:
    odd = [v.name for v in scene.views if not 1 / ASPECT <= v.camera.fx / v.camera.fy <= ASPECT]
    if not odd:
        return ""
    return (
        f"focal lengths of x and y differ more than {ASPECT:g} times: {shortlist(odd)}; check their cameras"
    )


def _one_point(scene: Scene) -> str:
    if len(scene.points.xyz) < 2 or np.ptp(scene.points.xyz, axis=0).any():
        return ""
    return (
        "all points of the sparse model lie at one place, so nothing can be learnt from it: check the model"
    )


def _no_point_in_view(scene: Scene) -> str:
    xyz = scene.points.xyz
    xyz = xyz[:: max(1, len(xyz) // MOST_POINTS)]
    if not len(xyz):
        return ""
    for view in scene.train:
        camera = view.camera
        local = camera.to_camera(xyz)
        x, y, z = local[local[:, 2] > 0].T
        u, v = camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy
        if ((u >= 0) & (u < camera.width) & (v >= 0) & (v < camera.height)).any():
            return ""
    return "no point of the sparse model lies in any training photo: poses and points are of two models"


# A scene that would give a wrong number is refused; what is only unlikely is said.
CHECKS = (
    SceneCheck(True, _shared_photos),
    SceneCheck(True, _one_pose),
    SceneCheck(True, _hidden_test_pixels),
    SceneCheck(True, _one_point),
    SceneCheck(True, _no_point_in_view),
    SceneCheck(False, _alike_photos),
    SceneCheck(False, _few_train_photos),
    SceneCheck(False, _hidden_train_pixels),
    SceneCheck(False, _far_cameras),
    SceneCheck(False, _one_position),
    SceneCheck(False, _odd_principal_points),
    SceneCheck(False, _odd_focal_lengths),
)


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
    cure = "a mask of a.jpg is a.jpg.png or a.png"
    if strange and not used and not tests:
        raise AwError(
            f"{folder} holds {counted(len(files), 'mask')}, none of a photo of the scene ({strange}): "
            f"{cure}; rename them, or move the folder away"
        )
    warnings = [f"masks that belong to no photo: {strange} ({cure})"] if strange else []
    if used:
        without = shortlist(name for name in train if name not in used)
        lacking = f"; without a mask, so all of them trains: {without}" if without else ""
        warnings.append(
            f"keep masks of {len(used)} train photos in {folder} are used{lacking}; "
            "'aw import --no-masks' makes a scene without"
        )
    return warnings
