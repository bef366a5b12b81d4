"""Cameras and scenes."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from ambiguous_wild.core import AwError, Camera, Scene, SparsePoints, View
from ambiguous_wild.core.camera import pose_at, rotation_from_quat


def camera_at(x: float, width: int = 40, height: int = 30) -> Camera:
    return Camera(width, height, 50.0, 52.0, 20.5, 14.0, pose_at(np.array([x, 0, 0]), np.eye(3)))


def project(camera: Camera, point: np.ndarray) -> np.ndarray:
    x, y, z = camera.to_camera(point)
    return np.array([camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy])


def test_resizing_scales_every_projection_per_axis():
    camera, point = camera_at(0.3), np.array([0.2, -0.1, 4.0])
    small = camera.resized(20, 10)
    assert np.allclose(project(small, point), project(camera, point) * [20 / 40, 10 / 30])


def test_points_are_projected_and_those_behind_have_no_pixel():
    camera = camera_at(0.3)
    points = np.array([[0.2, -0.1, 4.0], [0.0, 0.5, 2.0], [0.0, 0.5, -2.0], [0.0, 0.5, 0.0]])
    pixels, depths = camera.project(points)
    assert np.allclose(pixels[:2], [project(camera, point) for point in points[:2]])
    assert np.isnan(pixels[2:]).all() and np.allclose(depths, [4.0, 2.0, -2.0, 0.0])


def test_center_is_where_the_camera_stands():
    assert np.allclose(camera_at(2.5).center, [2.5, 0, 0])
    turned = rotation_from_quat(np.array([0.5, -0.5, 0.5, 1.0]))
    camera = replace(camera_at(0), cam_from_world=pose_at(np.array([1.0, 2.0, 3.0]), turned))
    assert np.allclose(camera.center, [1, 2, 3]) and np.allclose(camera.to_camera(camera.center), 0)
    assert np.allclose(camera.to_camera(camera.center + turned[2]), [0, 0, 1])  # it looks along its third row


def test_the_exact_mask_of_a_photo_has_its_stem_in_the_same_subfolder():
    view = View("left/a.JPG", Path("left/a.JPG"), camera_at(0), "train")
    scene = replace(scene_of([]), root=Path("root"))
    assert scene.truth_file("shadow", view) == Path("root/truth/shadow/left/a.png")


def test_pose_cannot_be_changed_behind_ones_back():
    with pytest.raises(ValueError, match="read-only"):
        camera_at(0).cam_from_world[0, 0] = 2


@pytest.mark.parametrize("bad", [{"width": 0}, {"fx": -1.0}, {"cam_from_world": np.eye(3)}])
def test_impossible_cameras_are_refused(bad):
    good = {"width": 4, "height": 4, "fx": 1.0, "fy": 1.0, "cx": 2.0, "cy": 2.0, "cam_from_world": np.eye(4)}
    with pytest.raises(AwError):
        Camera(**(good | bad))


def scene_of(positions: list[tuple[float, str]], points: np.ndarray | None = None) -> Scene:
    views = tuple(
        View(f"{i}.png", Path(f"{i}.png"), camera_at(x), split)  # type: ignore[arg-type]
        for i, (x, split) in enumerate(positions)
    )
    xyz = np.zeros((0, 3)) if points is None else points
    return Scene(Path(), "s", views, SparsePoints.without_tracks(xyz))


def test_extent_reads_training_cameras_only():
    assert scene_of([(0, "train"), (2, "train"), (100, "test")]).extent == pytest.approx(1.1)


def test_extent_of_a_capture_from_one_spot_is_positive():
    spread = np.array([[0, 0, 5.0], [0, 1, 5.0], [1, 0, 5.0]])
    assert scene_of([(0, "train"), (0, "train")], spread).extent > 1.0
    assert scene_of([(0, "train")]).extent == 1.0


def test_every_observation_has_its_point():
    points = replace(SparsePoints.without_tracks(np.zeros((4, 3))), track_offsets=np.array([0, 2, 2, 3, 3]))
    assert points.owners.tolist() == [0, 0, 2]
