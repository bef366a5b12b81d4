"""Effects: each does what it is for, on photos that call for it."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from ambiguous_wild.core import Scene, SparsePoints, View
from ambiguous_wild.io.scene_folder import load_scene
from ambiguous_wild.splat.effects import with_effects
from ambiguous_wild.splat.effects.tracks import photo_gains
from ambiguous_wild.splat.method_hooks import MethodHooks
from ambiguous_wild.splat.training_loop import train
from tests.splat.scenes import bits, disturbed, shot_of, trainer_for
from tests.splat.scenes import camera as make_camera
from tests.tiny_scene import write_tiny_scene


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    return load_scene(write_tiny_scene(tmp_path_factory.mktemp("data") / "scene", distractors=False))


def brightened(data, gains):
    return replace(data, photos=[(p * g).clamp(0, 1) for p, g in zip(data.photos, gains)])


def psnr_of(trainer, photos, view=False):
    errors = [
        float((trainer.make_step(trainer.iteration, i).rendered.image - p).square().mean())
        for i, p in enumerate(photos)
    ]
    return -10 * np.log10(np.mean(errors))


GAINS = [0.8, 1.05, 0.9, 1.1, 0.75, 1.0]


@pytest.mark.parametrize("name", ["exposure", "appearance"])
def test_colour_effects_explain_drifting_exposure(scene, tmp_path, name):
    drift = lambda data: brightened(data, GAINS)  # noqa: E731
    runs = {
        n: trainer_for(
            scene,
            tmp_path / (n or "none"),
            parts=with_effects(MethodHooks(), [n] if n else []),
            change=drift,
            iterations=200,
        )
        for n in ("", name)
    }
    for run in runs.values():
        train(run)
    photos = runs[""].data.photos
    assert psnr_of(runs[name], photos) > psnr_of(runs[""], photos) + 3
    # a photo of unseen exposure, fitted on its left half, is explained on the right one
    camera, photo = scene.test[0].camera, None
    from ambiguous_wild.io.images import load_image_float

    photo = torch.from_numpy(load_image_float(scene.test[0].image_path)) * 0.7
    keep = torch.zeros(photo.shape[:2])
    keep[:, : photo.shape[1] // 2] = 1
    before = bits(runs[name])
    fitted = runs[name].render_fitted(camera, photo, keep)
    assert bits(runs[name]) == before
    right = slice(photo.shape[1] // 2, None)
    neutral = runs[name].render(camera).image
    errors = [float((image - photo)[:, right].square().mean()) for image in (fitted, neutral)]
    assert errors[0] < 0.25 * errors[1]
    # what lies in the other half is not read
    torn = photo.clone()
    torn[:, right] = 0.5
    assert torch.equal(runs[name].render_fitted(camera, torn, keep), fitted)


def test_poses_return_when_they_were_disturbed(scene, tmp_path):
    rng = np.random.default_rng(0)
    truth = [v.camera for v in scene.train]

    def disturb(data):
        noise = rng.normal(size=(len(truth), 3)) * 0.012
        cameras = [replace(c, cam_from_world=disturbed(c, n, np.zeros(3))) for c, n in zip(truth, noise)]
        return replace(data, cameras=cameras)

    trainer = trainer_for(
        scene, tmp_path, parts=with_effects(MethodHooks(), ("poses",)), change=disturb, iterations=400
    )

    def error(cameras):
        """Px by which a point of the wall moves from photo to photo, but for a turn that all share."""
        turns = [c.cam_from_world[:3, :3] @ t.cam_from_world[:3, :3].T for c, t in zip(cameras, truth)]
        return float(np.std([t[0, 2] for t in turns]) + np.std([t[1, 2] for t in turns])) * truth[0].fx

    before = error(trainer.data.cameras)
    train(trainer)
    after = error([trainer.effects.camera(shot_of(i, c)) for i, c in enumerate(trainer.data.cameras)])
    assert after < 0.6 * before


def test_gains_from_tracks_are_those_put_in():
    rng = np.random.default_rng(0)
    views, points = 5, 200
    gains = np.exp(rng.normal(size=(views, 3)) * 0.15)
    gains /= np.exp(np.log(gains).mean(axis=0))
    cam = make_camera(64, 48)
    base = np.repeat(np.repeat(rng.uniform(0.2, 0.6, (8, 8, 3)), 6, 0), 8, 1)
    photos = [base * g for g in gains]
    photos[2][:20, :20] = 0.9  # something stands before a tenth of the picture
    xy = rng.uniform([4, 4], [60, 44], (points, 2))
    tracks = SparsePoints(
        rng.normal(size=(points, 3)), np.zeros((points, 3), np.uint8), np.zeros(points),
        np.arange(points + 1) * views, np.tile(np.arange(views), points).astype(np.int32),
        np.repeat(xy, views, axis=0).astype(np.float32),
    )  # fmt: skip
    scene = Scene(None, "s", tuple(View(f"{i}", None, cam, "train") for i in range(views)), tracks)
    np.testing.assert_allclose(photo_gains(scene, photos), gains, rtol=0.01)
    # a probe's photos are smaller than those the tracks are in px of
    halves = [photo[::2, ::2] for photo in photos]
    np.testing.assert_allclose(photo_gains(scene, halves), gains, rtol=0.02)
