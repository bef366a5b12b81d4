"""Several photos a step on one device."""

import math

import pytest
import torch

from ambiguous_wild.core import AwError
from ambiguous_wild.io.scene_folder import load_scene
from ambiguous_wild.methods import get_method
from ambiguous_wild.splat.data import load_train_data
from ambiguous_wild.splat.density import DensityConfig
from ambiguous_wild.splat.multi_gpu.batch import BatchTrainer
from ambiguous_wild.splat.pace import TrainConfig
from ambiguous_wild.splat.parts import MaskPolicy, Parts
from ambiguous_wild.splat.watchdog import NonFinite
from tests.tiny_scene import with_points, write_tiny_scene

from . import fake_gsplat
from .test_trainer import trainer_for


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    return with_points(load_scene(write_tiny_scene(tmp_path_factory.mktemp("data") / "scene")), 80)


@pytest.fixture
def fake(monkeypatch):
    with fake_gsplat.installed(monkeypatch):
        yield


def batch(scene, folder, views=2, parts=None, **config):
    data = load_train_data(scene, device=torch.device("cpu"), seed=0, cache_dir=folder / "cache")
    config = TrainConfig(**({"iterations": 40, "probes": 0, "resolution": "full"} | config))
    return BatchTrainer(data, parts or Parts(), config, views=views, folder=folder / "run")


def test_a_step_follows_the_mean_gradient_of_its_photos(scene, tmp_path, fake):
    trainer = batch(scene, tmp_path / "two")
    one = trainer_for(scene, tmp_path / "one", iterations=40, probes=0, resolution="full")
    gradients = []
    for iteration in (1, 2):
        step = one.make_step(iteration, one.pace.view(iteration))
        gradients.append(step.rendered.backward(one._photometric(step, None).d_image))
    before = trainer.gaussians.clone()
    trainer.step()
    assert trainer.iteration == 2
    mean = (gradients[0].sh0 + gradients[1].sh0) / 2
    moved = trainer.gaussians.sh0 - before.sh0
    # the first step of Adam is its rate against the sign of the gradient
    rate = math.sqrt(2) * trainer.pace.learning_rates(0.0)["sh0"]
    clear = mean.abs() > 1e-9
    assert clear.float().mean() > 0.5
    torch.testing.assert_close(moved[clear], -rate * mean[clear].sign(), rtol=1e-2, atol=1e-6)


@pytest.mark.parametrize("views", [2, 4])
def test_it_learns_and_grows_and_iterations_count_photos(scene, tmp_path, fake, views):
    parts = Parts(density_config=DensityConfig(start=0.0, every=1.0, min_every=8, grow_grad=1e-9, resets=()))
    trainer = batch(scene, tmp_path, views, parts, max_gaussians=200)
    first = float(trainer.step())
    while not trainer.done:
        last = float(trainer.step())
    assert trainer.iteration == 40 and last < 0.85 * first
    assert len(trainer.gaussians) > 80
    assert all(bool(torch.isfinite(t).all()) for _, t in trainer.gaussians.items())


def test_it_goes_on_from_its_checkpoint(scene, tmp_path, fake):
    whole = batch(scene, tmp_path / "whole")
    for _ in range(10):
        whole.step()
    part = batch(scene, tmp_path / "part")
    for _ in range(5):
        part.step()
    part.save()
    again = batch(scene, tmp_path / "part")
    assert again.resume() and again.iteration == 10
    assert again.optimiser.betas == pytest.approx((0.8, 0.998))
    for _ in range(5):
        again.step()
    for name, tensor in whole.gaussians.items():
        torch.testing.assert_close(getattr(again.gaussians, name), tensor, rtol=1e-6, atol=1e-7)


class One(MaskPolicy):
    """Keeps nothing of some photos."""

    def __init__(self, bare):
        self.bare = bare

    def keep(self, step):
        return torch.full_like(step.photo[..., 0], float(step.iteration not in self.bare))


def test_a_photo_that_is_all_masked_leaves_the_others(scene, tmp_path, fake):
    trainer = batch(scene, tmp_path, parts=Parts(mask=One({1, 3, 4})))
    before = trainer.gaussians.clone()
    trainer.step()  # one of two
    after = trainer.gaussians.clone()
    assert not torch.equal(before.sh0, after.sh0)
    trainer.step()  # both
    assert torch.equal(trainer.gaussians.sh0, after.sh0)


class Broken(One):
    """Gives weights that are no numbers in some iterations."""

    def keep(self, step):
        return super().keep(step).masked_fill(torch.tensor(step.iteration in self.bare), torch.nan)


def test_what_breaks_is_named(scene, tmp_path, fake):
    trainer = batch(scene, tmp_path, parts=Parts(mask=Broken({3})))
    trainer.watchdog.every = 3
    with pytest.raises(NonFinite, match=r"iteration 3, view"):
        for _ in range(6):
            trainer.step()


def test_what_cannot_be_shared_is_refused(scene, tmp_path, fake, monkeypatch):
    with pytest.raises(AwError, match="2 to 4, got 5"):
        batch(scene, tmp_path, 5)
    entry = get_method("robustsplat")
    with pytest.raises(AwError, match=r"2 views a step, as .*masks of"):
        batch(scene, tmp_path, 2, entry.build(entry.options()))
    with pytest.raises(AwError, match="budget"):
        batch(scene, tmp_path, 2, budget_s=1.0)
    with monkeypatch.context() as patch:  # undone before the stand-in goes
        patch.setattr("ambiguous_wild.splat.device.accelerated", lambda device: False)
        with pytest.raises(AwError, match="of a GPU"):
            batch(scene, tmp_path, 2)
