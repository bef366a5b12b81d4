"""Tile lists of a fixed length: the same pictures, nothing read, a step that is called off if too short."""

import numpy as np
import pytest
import torch

from ambiguous_wild.core import AwError
from ambiguous_wild.io.scene_folder import load_scene
from ambiguous_wild.splat.gpu import options, render, tiles
from ambiguous_wild.splat.gpu.render import render_cuda
from tests.host_reads import moved, no_transfers
from tests.tiny_scene import with_points, write_tiny_scene

from . import fake_gsplat
from .scenes import camera, cotangents, gaussians, given
from .test_trainer import trainer_for


@pytest.fixture
def fake(monkeypatch):
    monkeypatch.setattr(render, "_visits", tiles.Visits())
    monkeypatch.setattr(tiles, "STEP", 2048)  # the stand-in draws every entry at every pixel
    with fake_gsplat.installed(monkeypatch):
        yield


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    return with_points(load_scene(write_tiny_scene(tmp_path_factory.mktemp("data") / "scene")), 80)


def splats(count, seed, width, height):
    rng = np.random.default_rng(seed)
    means = torch.from_numpy((rng.uniform(-0.2, 1.2, (count, 2)) * [width, height]).astype(np.float32))
    radii = torch.from_numpy(rng.integers(0, 30, (count, 2)).astype(np.int32))
    depths = torch.from_numpy(rng.uniform(0.5, 9, count).astype(np.float32))
    return means, radii, depths


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("size", [(64, 48), (97, 33), (16, 16)])
def test_lists_hold_every_splat_of_every_tile_in_order_of_depth(seed, size):
    width, height = size
    means, radii, depths = splats(200, seed, width, height)
    listed = tiles.list_within(means, radii, depths, width, height, 8192)
    columns, rows = -(-width // 16), -(-height // 16)
    starts = [*listed.offsets.flatten().tolist(), 8192]
    low, high = ((means - radii) / 16).floor().tolist(), ((means + radii) / 16).ceil().tolist()
    drawn, depth = (radii > 0).all(1).tolist(), depths.tolist()
    total = 0
    for tile in range(rows * columns):
        y, x = divmod(tile, columns)
        inside = [
            i for i in range(200)
            if drawn[i] and low[i][0] <= x < high[i][0] and low[i][1] <= y < high[i][1]
        ]  # fmt: skip
        expected = sorted(inside, key=depth.__getitem__)
        assert listed.flatten_ids[starts[tile] : starts[tile + 1]].tolist() == expected, tile
        total += len(inside)
    assert listed.count.item() == total and listed.over.item() == 0
    below = np.diff(starts[rows * columns :])  # what is left of the capacity is spread evenly
    assert below.sum() == 8192 - total and below.max() - below.min() <= 1


def test_too_short_a_list_says_so():
    means, radii, depths = splats(200, 1, 64, 48)
    count = tiles.list_within(means, radii, depths, 64, 48, 8192).count.item()
    assert tiles.list_within(means, radii, depths, 64, 48, count).over.item() == 0
    assert tiles.list_within(means, radii, depths, 64, 48, count - 1).over.item() == 1


def test_pictures_and_gradients_are_the_same(fake):
    g, cam = gaussians(3, 80), camera()
    d = cotangents(cam.height, cam.width)
    expected = render_cuda(g, cam, sh_degree=3, background=(0.1, 0.2, 0.3), antialias=False)
    wanted = expected.backward(given(d))
    with options.using(tiles="last-visit"):
        for _ in range(2):  # the first visit counts
            found = render_cuda(g, cam, sh_degree=3, background=(0.1, 0.2, 0.3), antialias=False)
    assert expected.over is None and found.over.item() == 0
    torch.testing.assert_close(found.image, expected.image, rtol=0, atol=1e-6)
    torch.testing.assert_close(found.depth, expected.depth, rtol=1e-6, atol=1e-6)
    grads = found.backward(given(d))
    for name in dict(g.items()):
        a, b = getattr(grads, name), getattr(wanted, name)
        assert (a - b).abs().max() <= 1e-5 * b.abs().max().clamp(min=1e-6), name


def test_the_room_follows_the_model_and_every_camera_has_its_own():
    visits, one, two = tiles.Visits(), camera(), camera()
    assert visits.capacity(one, 100) is None
    visits.note(one, 100, 40_000)
    assert visits.capacity(one, 100) == 2 * tiles.STEP and visits.capacity(two, 100) is None
    assert visits.capacity(one, 300) == 6 * tiles.STEP  # three times as many Gaussians
    visits.note(one, 100, torch.tensor(1))
    assert visits.capacity(one, 100) == tiles.STEP


def test_the_host_waits_only_at_a_cameras_first_visit(scene, tmp_path, fake, monkeypatch):
    calls = []
    sort = render.seam.sort
    monkeypatch.setattr(render.seam, "sort", lambda *a: calls.append(1) or sort(*a))
    trainer = trainer_for(scene, tmp_path, iterations=1000, probes=0)
    with options.using(tiles="last-visit"):
        for _ in range(3 * len(trainer.data.photos)):
            trainer.step()
    assert len(calls) == len(trainer.data.photos)


def test_training_is_that_of_exact_lists(scene, tmp_path, fake):
    models = []
    for name in ("exact", "last-visit"):
        with options.using(tiles=name):
            trainer = trainer_for(scene, tmp_path / name, iterations=1000, probes=0)
            for _ in range(20):
                trainer.step()
        models.append(trainer.gaussians)
    for name in ("means", "sh0", "opacity_logits"):
        apart = (getattr(models[0], name) - getattr(models[1], name)).abs() > 1e-3
        assert float(apart.float().mean()) < 0.02, name


def test_a_step_with_too_short_a_list_changes_nothing(scene, tmp_path, fake, monkeypatch):
    trainer = trainer_for(scene, tmp_path, iterations=1000, probes=0)
    views = len(trainer.data.photos)
    with options.using(tiles="last-visit"):
        for _ in range(views):
            trainer.step()
        before = trainer.gaussians.clone()
        with monkeypatch.context() as patch:
            patch.setattr(tiles.Visits, "capacity", lambda *_: 3)
            trainer.step()
        for name, tensor in trainer.gaussians.items():
            assert torch.equal(tensor, getattr(before, name)), name
        for _ in range(views):  # the next visit has the room
            trainer.step()
    assert not torch.equal(trainer.gaussians.means, before.means)


def test_nothing_is_read_in_a_step(scene, tmp_path, fake):
    with options.using(tiles="last-visit"):
        trainer = trainer_for(scene, tmp_path, iterations=100_000, probes=0)
        trainer.watchdog.every = 10**9
        for _ in range(2 * len(trainer.data.photos)):
            trainer.step()
        counts = {key: int(visit.count) for key, visit in render._visits._of.items()}
        trainer = moved(trainer)
        for _ in range(len(trainer.data.photos)):  # cameras are copied once
            _hold(counts)
            trainer.step()
        with no_transfers():
            for _ in range(3):
                _hold(counts)
                trainer.step()


def _hold(counts):
    """On `meta` a count has no value, elsewhere it was copied to the host meanwhile."""
    for key, visit in render._visits._of.items():
        visit.count = counts[key]


def test_options_are_read_from_one_variable():
    assert options.parse("") == options.Options() and str(options.Options()) == "tiles=exact,harmonics=gsplat"
    assert options.parse(" tiles = last-visit ").tiles == "last-visit"
    for text, said in (
        ("tile=exact", "did you mean 'tiles'"),
        ("tiles=last", "unknown value of tiles"),
        ("tiles", "NAME=VALUE"),
    ):
        with pytest.raises(AwError, match=said):
            options.parse(text)
    with options.using(tiles="last-visit"):
        assert options.current().tiles == "last-visit"
    assert options.current().tiles == "exact"
