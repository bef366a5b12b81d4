"""Standard deviations of poses are those of many noisy adjustments, whichever photo COLMAP keeps constant."""

import cv2
import numpy as np
import pytest

from ambiguous_wild.builder.bundle_adjustment import bundle_adjustment_options, has_parallax
from ambiguous_wild.builder.pose_covariance import UNSURE, joint_covariance
from ambiguous_wild.io.safe_pycolmap import pycolmap

PHOTOS, WEAK, NOISE_PX = 6, 3, 0.3
POINTS = np.random.default_rng(0).uniform((-4, -2, 4), (4, 2, 8), (120, 3))


def pose(photo: int) -> np.ndarray:
    turn = cv2.Rodrigues(np.radians([3.0 * photo - 5, 4.0 * photo - 10.0, 7.0 * photo]))[0]
    centre = np.array([photo - 2.5, np.sin(2.0 * photo), 0.5 * np.cos(1.3 * photo)])
    return np.column_stack([turn, -turn @ centre])


def adjusted(order: list[int], seed: int):
    """Adjust noisy photos, numbered in this order; the weak one shows few of the points."""
    model, rng = pycolmap.Reconstruction(), np.random.default_rng(seed)
    camera = pycolmap.Camera(
        camera_id=1, model="SIMPLE_PINHOLE", width=640, height=480, params=[400, 320, 240]
    )
    model.add_camera_with_trivial_rig(camera)
    pixels = []
    for photo in range(PHOTOS):
        local = POINTS @ pose(photo)[:, :3].T + pose(photo)[:, 3]
        pixels.append(
            local[:, :2] / local[:, 2:] * 400 + [320, 240] + rng.normal(0, NOISE_PX, (len(POINTS), 2))
        )
    for number, photo in enumerate(order, 1):
        image = pycolmap.Image(name=f"{photo}", keypoints=pixels[photo], camera_id=1, image_id=number)
        model.add_image_with_trivial_frame(image, pycolmap.Rigid3d(pose(photo)))
    for number, xyz in enumerate(POINTS):
        seen = [k for k, photo in enumerate(order, 1) if photo != WEAK or number < 8]
        model.add_point3D(xyz, pycolmap.Track([pycolmap.TrackElement(k, number) for k in seen]))
    options = bundle_adjustment_options(False, PHOTOS, final=True)
    options.ceres.loss_function_type = pycolmap.LossFunctionType.TRIVIAL
    options.refine_focal_length = False
    found = joint_covariance(model, range(1, PHOTOS + 1), options)
    return found, np.array([found.deviations[1 + order.index(photo)] for photo in range(PHOTOS)])


def test_deviations_do_not_depend_on_the_photos_that_colmap_keeps_constant():
    straight, turned = (adjusted(order, 0)[1] for order in ([0, 1, 2, 3, 4, 5], [3, 0, 5, 4, 2, 1]))
    assert np.allclose(straight, turned, rtol=1e-3)
    assert (straight.argmax(axis=0) == WEAK).all()


def test_deviations_are_those_of_many_adjustments():
    centres = np.array([-pose(k)[:, :3].T @ pose(k)[:, 3] for k in range(PHOTOS)])
    middle = centres.mean(axis=0)
    radius = np.linalg.norm(centres - middle, axis=1).max()
    similarities = np.zeros((PHOTOS, 6, 7))  # of poses by a small similarity, by differences
    for column, step in enumerate(1e-3 * np.eye(7)):
        turn = cv2.Rodrigues(step[3:6])[0]
        for k in range(PHOTOS):
            moved = (1 + step[6]) * turn @ (centres[k] - middle) / radius + step[:3]
            similarities[k, :3, column] = (
                cv2.Rodrigues(pose(k)[:, :3] @ turn.T @ pose(k)[:, :3].T)[0][:, 0] / 1e-3
            )
            similarities[k, 3:, column] = (moved - (centres[k] - middle) / radius) / 1e-3
    predicted = adjusted(list(range(PHOTOS)), 0)[1]
    weights = np.repeat(1 / (UNSURE**2 + predicted**2), 3, axis=1).ravel()
    flat, errors = similarities.reshape(-1, 7), []
    for seed in range(200):
        model = adjusted(list(range(PHOTOS)), seed)[0].model
        error = np.zeros((PHOTOS, 6))
        for k in range(PHOTOS):
            found = model.images[k + 1].cam_from_world().matrix()
            error[k, :3] = cv2.Rodrigues(found[:, :3] @ pose(k)[:, :3].T)[0][:, 0]
            error[k, 3:] = (-found[:, :3].T @ found[:, 3] - centres[k]) / radius
        root = np.sqrt(weights)
        fitted = np.linalg.lstsq(root[:, None] * flat, root * error.ravel(), rcond=None)[0]
        errors.append((error.ravel() - flat @ fitted).reshape(PHOTOS, 2, 3))
    spread = np.einsum("spha,sphb->phab", errors, errors) / len(errors)
    measured = np.sqrt(np.linalg.eigvalsh(spread)[..., -1])
    assert np.allclose(measured, NOISE_PX * predicted, rtol=0.2)


@pytest.mark.parametrize(("step_m", "shown"), [(0.03, False), (0.5, True)])
def test_a_camera_that_only_turned_shows_no_depth(step_m, shown):
    """Points 4 to 8 m away, six photos from 15 cm or from 2.5 m."""
    model = pycolmap.Reconstruction()
    camera = pycolmap.Camera(
        camera_id=1, model="SIMPLE_PINHOLE", width=640, height=480, params=[400, 320, 240]
    )
    model.add_camera_with_trivial_rig(camera)
    for photo in range(PHOTOS):
        at = np.column_stack([np.eye(3), [-step_m * photo, 0.0, 0.0]])
        image = pycolmap.Image(
            name=f"{photo}", keypoints=np.zeros((len(POINTS), 2)), camera_id=1, image_id=photo + 1
        )
        model.add_image_with_trivial_frame(image, pycolmap.Rigid3d(at))
    for number, xyz in enumerate(POINTS):
        model.add_point3D(xyz, pycolmap.Track([pycolmap.TrackElement(k + 1, number) for k in range(PHOTOS)]))
    assert has_parallax(model) == shown
